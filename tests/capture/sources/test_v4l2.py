"""V4L2 cameras: what is locked and what is refused, times, losses, hangs, and closing beside a running read."""

from __future__ import annotations

import ctypes
import logging
import threading
from pathlib import Path
from typing import Any

import cv2
import pytest
from devices.fake_v4l2 import Control, FakeV4l2, Picture

from rhot.errors import ConfigError, DeviceError
from rhot.rig import CameraConfig
from rhot.rig.colors import nominal_colors
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.v4l2 import V4l2Source
from rhot_capture.sources.v4l2.source import V4l2Buffer, stamps_arrival

CAMERA = CameraConfig(source="v4l2", device="2", rate_hz=60.0, exposure_s=0.004, readout_s=0.01)
PERIOD_US = 16_667


def pictures(*sequences: int, first_us: int = 4_990_000) -> list[Picture | None]:
    return [Picture(number, first_us + PERIOD_US * number) for number in sequences]


def source_of(device: FakeV4l2, camera: CameraConfig = CAMERA) -> V4l2Source:
    def now_ns() -> int:
        return max(device.clock_ns(), 1000 * device.stamp_us)

    return V4l2Source("left", camera, device.opencv(), now_ns, device.query)


def opened(device: FakeV4l2, camera: CameraConfig = CAMERA, start_ns: int = 0) -> V4l2Source:
    source = source_of(device, camera)
    source.open(start_ns)
    return source


def settings(**changes: Any) -> CameraSettings:
    return CameraSettings.from_config(CAMERA, nominal_colors({})).changed(changes, 60.0)


def test_everything_automatic_is_off_and_the_rest_is_the_drivers_own(caplog: pytest.LogCaptureFixture) -> None:
    device = FakeV4l2()
    with caplog.at_level(logging.WARNING):
        source = opened(device)
    values = {name: control.value for name, control in device.controls.items()}
    assert (values["AUTO_EXPOSURE"], values["EXPOSURE"], values["AUTO_WB"], values["AUTOFOCUS"]) == (
        1.0,
        40.0,
        0.0,
        0.0,
    )
    # A gain of 4 and a white balance of (1.6, 1.6) are no values of this driver's.
    assert (values["GAIN"], values["WB_TEMPERATURE"], values["FOCUS"]) == (64.0, 4000.0, 30.0)
    assert "gain stays at 64, white_balance_temperature stays at 4000" in caplog.text
    assert "[cameras.left.v4l2_controls]" in caplog.text
    assert source.problem == ""


def test_a_drivers_own_values_are_set_as_such(caplog: pytest.LogCaptureFixture) -> None:
    own = {"gain": 20, "focus_absolute": 51, "white_balance_temperature": 4600}
    camera = CameraConfig.model_validate({**CAMERA.model_dump(), "focus_dioptres": 1.5, "v4l2_controls": own})
    device = FakeV4l2()
    with caplog.at_level(logging.WARNING):
        opened(device, camera)
    values = {name: control.value for name, control in device.controls.items()}
    assert (values["GAIN"], values["FOCUS"], values["WB_TEMPERATURE"]) == (20.0, 51.0, 4600.0)
    assert not caplog.records


def test_what_the_driver_refuses_is_named_and_stays_in_the_status(caplog: pytest.LogCaptureFixture) -> None:
    camera = CAMERA.model_copy(update={"v4l2_controls": {"gain": 400}})
    device = FakeV4l2(forced={"AUTO_EXPOSURE": 3.0, "FPS": 30.0})
    with caplog.at_level(logging.WARNING):
        source = opened(device, camera)
    for words in ("manual exposure", "rate_hz = 60 (driver says 30)", "v4l2_controls.gain = 400 (driver says 255)"):
        assert words in caplog.text
        assert words in source.problem


def test_a_camera_without_these_controls_is_no_fault() -> None:
    device = FakeV4l2(controls={"AUTO_EXPOSURE": Control(3.0, 0.0, 3.0), "EXPOSURE": Control(250.0, 3.0, 2047.0)})
    assert opened(device).problem == ""


def values_of(device: FakeV4l2) -> tuple[float, float, float]:
    return tuple(device.controls[name].value for name in ("SATURATION", "CONTRAST", "BRIGHTNESS"))  # type: ignore[return-value]


def test_picture_settings_are_set_in_proportion_and_only_where_asked() -> None:
    device = FakeV4l2()
    source = opened(device, CAMERA.model_copy(update={"saturation": 1.5}))
    assert values_of(device) == (96.0, 32.0, 0.0)
    assert "CONTRAST" not in device.set_values
    source.apply(settings(saturation=1.5, contrast=0.5, brightness=-0.25))
    assert values_of(device) == (96.0, 16.0, -16.0)
    source.apply(settings())
    assert values_of(device) == (64.0, 32.0, 0.0)


def test_a_neutral_picture_goes_back_to_the_drivers_own_values() -> None:
    device = FakeV4l2()
    source = opened(device, CAMERA.model_copy(update={"v4l2_controls": {"saturation": 80}}))
    source.apply(settings(saturation=1.2))
    assert values_of(device)[0] == 77.0
    source.apply(settings())
    assert values_of(device)[0] == 80.0


def test_a_picture_that_the_driver_cannot_make_is_refused() -> None:
    device = FakeV4l2()
    del device.controls["CONTRAST"]
    source = opened(device)
    with pytest.raises(ConfigError, match=r"contrast = 1\.5 \(the driver has no such control\)"):
        source.apply(settings(saturation=1.5, contrast=1.5))
    with pytest.raises(ConfigError, match=r"saturation = 3 \(at most 2\.00\)"):
        source.apply(settings(saturation=3.0))
    assert device.controls["SATURATION"].value == 64.0
    camera = CAMERA.model_copy(update={"contrast": 1.5})
    source = opened(device, camera)
    assert "contrast = 1.5" in source.problem
    source.apply(CameraSettings.from_config(camera, nominal_colors({})).changed({"exposure_s": 0.002}, 60.0))
    assert device.controls["EXPOSURE"].value == 20.0


def test_a_picture_is_not_set_in_two_ways() -> None:
    with pytest.raises(ValueError, match="saturation is set twice"):
        CameraConfig.model_validate({**CAMERA.model_dump(), "saturation": 1.2, "v4l2_controls": {"saturation": 80}})


def test_a_wrong_size_is_an_error_and_frees_the_device() -> None:
    device = FakeV4l2(forced={"FRAME_WIDTH": 1280.0})
    with pytest.raises(DeviceError, match="1280x480 instead of 640x480"):
        opened(device)
    assert device.released


def test_an_absent_device_is_named() -> None:
    with pytest.raises(DeviceError, match=r"/dev/video9.*plugged in"):
        opened(FakeV4l2(present=False), CAMERA.model_copy(update={"device": "/dev/video9"}))


def test_what_opencv_raises_is_a_device_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> bool:
        raise cv2.error("cap_v4l.cpp: assertion failed")

    device = FakeV4l2()
    monkeypatch.setattr(device, "set", fail)
    with pytest.raises(DeviceError, match=r"camera left.*assertion failed"):
        opened(device)
    assert device.released


def test_a_stamp_labelled_start_of_exposure_is_the_start() -> None:
    frame = opened(FakeV4l2(pictures(0))).read()
    assert frame is not None
    assert frame.t_first_row_ns == 4_990_000_000
    assert (frame.exposure_s, frame.readout_s) == (0.004, 0.01)


def test_uvcvideo_without_hardware_stamps_marks_the_first_packet(tmp_path: Path) -> None:
    node, module = tmp_path / "class/video4linux/video2/device", tmp_path / "module/uvcvideo/parameters"
    for folder in (node, module, tmp_path / "bus/usb/drivers/uvcvideo"):
        folder.mkdir(parents=True)
    (node / "driver").symlink_to(tmp_path / "bus/usb/drivers/uvcvideo")
    assert not stamps_arrival("/dev/video2", tmp_path), "nobody says so"
    for value, arrival, late_ns in (("0\n", True, 4_000_000), ("1\n", False, 0)):
        (module / "hwtimestamps").write_text(value)
        assert stamps_arrival("/dev/video2", tmp_path) == arrival
        device = FakeV4l2(pictures(0))
        source = V4l2Source(
            "left", CAMERA, device.opencv(), device.clock_ns, device.query, lambda path: stamps_arrival(path, tmp_path)
        )
        source.open(0)
        frame = source.read()
        assert frame is not None
        assert frame.t_first_row_ns == 4_990_000_000 - late_ns
    assert not stamps_arrival("/dev/video3", tmp_path)


@pytest.mark.parametrize("answers", [True, False])
def test_any_other_stamp_is_the_end_of_the_frame(answers: bool) -> None:
    frame = opened(FakeV4l2(pictures(0), label=0, answers_queries=answers)).read()
    assert frame is not None
    assert frame.t_first_row_ns == 4_990_000_000 - 14_000_000


def test_an_impossible_stamp_is_replaced_and_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    device = FakeV4l2([Picture(0, 0), Picture(1, 0)])
    source = opened(device)
    with caplog.at_level(logging.WARNING):
        frames = [source.read(), source.read()]
    assert [frame.t_first_row_ns for frame in frames if frame] == [device.now_ns - 14_000_000] * 2
    assert caplog.text.count("away from the monotonic clock") == 1


@pytest.mark.parametrize("answers", [True, False])
def test_lost_frames_leave_a_gap_in_the_count(answers: bool) -> None:
    device = FakeV4l2(pictures(7, 8, 11, 12), answers_queries=answers)
    source = opened(device)
    frames = [source.read() for _ in range(4)]
    # By the driver's number; by the times between frames where it tells none.
    assert [frame.index for frame in frames if frame] == [0, 1, 4, 5]


def test_frames_before_the_start_are_thrown_away() -> None:
    source = opened(FakeV4l2(pictures(0, 1)), start_ns=5_000_000_000)
    frame = source.read()
    assert frame is not None
    assert frame.t_first_row_ns == 1000 * (4_990_000 + PERIOD_US)


def test_a_hiccup_is_survived() -> None:
    assert opened(FakeV4l2([None, *pictures(0)])).read() is not None


def test_a_hang_is_noticed_after_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", raising=False)
    device = FakeV4l2()
    source = opened(device)
    begun_ns = device.now_ns
    with pytest.raises(DeviceError, match=r"stopped delivering 3\.0 s ago"):
        source.read()
    assert device.now_ns - begun_ns <= 3_000_000_000


def test_a_camera_that_is_pulled_out_is_noticed_at_once() -> None:
    device = FakeV4l2()
    source = opened(device)
    device.present = False
    with pytest.raises(DeviceError, match=r"unplugged"):
        source.read()


def test_the_exposure_changes_while_running_and_with_it_the_times() -> None:
    device = FakeV4l2(pictures(0), label=0)
    source = source_of(device)
    with pytest.raises(DeviceError, match="not open"):
        source.apply(settings(exposure_s=0.002))
    source.open(0)
    source.apply(settings(exposure_s=0.002))
    assert device.controls["EXPOSURE"].value == 20.0
    frame = source.read()
    assert frame is not None
    assert frame.exposure_s == pytest.approx(0.002)
    assert frame.t_first_row_ns == 4_990_000_000 - 12_000_000


@pytest.mark.parametrize("change", [{"gain": 2.0}, {"white_balance": (2.0, 1.2)}, {"focus_dioptres": 2.0}])
def test_what_v4l2_has_no_unit_for_is_refused_and_nothing_changes(change: dict[str, Any]) -> None:
    device = FakeV4l2()
    source = opened(device)
    before = dict(device.controls)
    with pytest.raises(ConfigError, match=r"mean nothing to a V4L2 driver.*cameras\.left\.v4l2_controls"):
        source.apply(settings(exposure_s=0.002, **change))
    assert device.controls == before
    assert device.controls["EXPOSURE"].value == 40.0


def test_an_exposure_that_the_driver_refuses_is_refused() -> None:
    device = FakeV4l2()
    source = opened(device)
    with pytest.raises(ConfigError, match=r"refuses exposure_s = 0\.0001 \(driver says 3\)"):
        source.apply(settings(exposure_s=0.0001))
    assert device.controls["EXPOSURE"].value == 40.0


def test_closing_waits_for_the_read_that_is_under_way() -> None:
    device = FakeV4l2(pictures(0), hang=threading.Event())
    source = opened(device)
    reader = threading.Thread(target=source.read)
    reader.start()
    assert device.grabbing.wait(10.0)
    closer = threading.Thread(target=source.close)
    closer.start()
    closer.join(0.1)
    assert not device.is_released()
    assert device.hang is not None
    device.hang.set()
    reader.join(10.0)
    closer.join(10.0)
    assert device.is_released()
    assert device.misuse == []


def test_after_close_there_is_nothing() -> None:
    device = FakeV4l2(pictures(0))
    source = opened(device)
    source.close()
    source.close()
    assert device.released
    assert source.read() is None


def test_the_kernels_buffer_has_its_size() -> None:
    # The size is part of the number of VIDIOC_QUERYBUF.
    assert ctypes.sizeof(V4l2Buffer) == 88
    offsets = {name: getattr(V4l2Buffer, name).offset for name in ("flags", "seconds", "sequence")}
    assert offsets == {"flags": 12, "seconds": 24, "sequence": 56}
