from __future__ import annotations

import gc
import logging
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from devices.fake_picamera2 import PI_CONTROLS

from rhot.errors import ConfigError, DeviceError
from rhot.rig import CameraConfig
from rhot.rig.colors import nominal_colors
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.libcamera import PicameraModules, import_picamera
from rhot_capture.sources.picamera2 import Picamera2Source, choose_mode

MODES = [
    {"size": (640, 480), "bit_depth": 10, "fps": 103.33, "crop_limits": (1000, 752, 1280, 960)},
    {"size": (1640, 1232), "bit_depth": 10, "fps": 41.85, "crop_limits": (0, 0, 3280, 2464)},
    {"size": (1296, 972), "bit_depth": 10, "fps": 80.0, "crop_limits": (0, 0, 2592, 1944)},
    {"size": (3280, 2464), "bit_depth": 10, "fps": 21.19, "crop_limits": (0, 0, 3280, 2464)},
]
BOOT_NS = 9_000_000_000
OFFSET_NS = -1_000_000_000


class FakeRequest:
    def __init__(self, metadata: dict[str, Any]) -> None:
        self.metadata = metadata
        self.pixels = np.zeros((480, 640, 3), np.uint8)
        self.mapped = 0
        self.released = 0

    def get_metadata(self) -> dict[str, Any]:
        return self.metadata

    def release(self) -> None:
        assert self.mapped == 0, "released while still mapped"
        self.released += 1


class FakeMappedArray:
    def __init__(self, request: FakeRequest, stream: str, write: bool) -> None:
        assert (stream, write) == ("main", False)
        self.request = request
        self.array: Any = None

    def __enter__(self) -> FakeMappedArray:
        self.request.mapped += 1
        self.array = self.request.pixels.view()
        return self

    def __exit__(self, *args: object) -> None:
        self.request.mapped -= 1
        self.array = None


class FakeJob:
    def __init__(self, outcome: list[Any]) -> None:
        self.outcome = outcome

    def get_result(self, timeout: float) -> Any:
        item = self.outcome.pop(0) if self.outcome else TimeoutError()
        if isinstance(item, Exception):
            raise item
        return item


class FakePicamera2:
    present: list[dict[str, str]] = [{"Model": "imx219"}]
    created: list[FakePicamera2] = []

    def __init__(self, number: int) -> None:
        self.number = number
        self.sensor_modes = MODES
        self.camera_controls: dict[str, Any] = {
            **dict.fromkeys(PI_CONTROLS),
            "LensPosition": (0.0, 15.0, 1.0),
            "Saturation": (0.0, 32.0, 1.0),
            "Contrast": (0.0, 32.0, 1.0),
            "Brightness": (-1.0, 1.0, 0.0),
        }
        self.outcome: list[Any] = []
        self.controls_set: list[dict[str, Any]] = []
        self.configuration: dict[str, Any] = {}
        self.jobs = 0
        self.calls: list[str] = []
        FakePicamera2.created.append(self)

    @classmethod
    def global_camera_info(cls) -> list[dict[str, str]]:
        return cls.present

    def create_video_configuration(self, **values: Any) -> dict[str, Any]:
        return values

    def configure(self, configuration: dict[str, Any]) -> None:
        self.configuration = configuration

    def camera_configuration(self) -> dict[str, Any]:
        return self.configuration

    def start(self) -> None:
        self.calls.append("start")

    def stop(self) -> None:
        self.calls.append("stop")

    def close(self) -> None:
        self.calls.append("close")

    def cancel_all_and_flush(self) -> None:
        self.calls.append("flush")

    def set_controls(self, controls: dict[str, Any]) -> None:
        self.controls_set.append(controls)

    def capture_request(self, wait: bool) -> FakeJob:
        assert wait is False
        self.jobs += 1
        return FakeJob(self.outcome)


CONTROLS = SimpleNamespace(
    draft=SimpleNamespace(NoiseReductionModeEnum=SimpleNamespace(Off="noise off")),
    AfModeEnum=SimpleNamespace(Manual="manual focus"),
    rpi=SimpleNamespace(SyncModeEnum=SimpleNamespace(Server="server", Client="client")),
)


def opened(camera: CameraConfig, start_ns: int = 0, controls: Any = CONTROLS) -> tuple[Picamera2Source, FakePicamera2]:
    modules = PicameraModules(SimpleNamespace(Picamera2=FakePicamera2, MappedArray=FakeMappedArray), controls)
    source = Picamera2Source("left", camera, lambda: modules, lambda: OFFSET_NS)
    source.open(start_ns)
    return source, FakePicamera2.created[-1]


def request(t_ns: int, exposure_us: float = 4000.0, **more: Any) -> FakeRequest:
    metadata = {"SensorTimestamp": t_ns, "ExposureTime": exposure_us, "AnalogueGain": 4.0, "FrameDuration": 16_667}
    return FakeRequest({**metadata, **more})


def test_everything_automatic_is_off() -> None:
    _, device = opened(CameraConfig(focus_dioptres=1.2))
    assert device.configuration["main"] == {"size": (640, 480), "format": "RGB888"}
    assert device.configuration["sensor"] == {"output_size": (1296, 972), "bit_depth": 10}
    assert device.configuration["queue"] is False
    assert device.configuration["buffer_count"] == 4
    assert device.configuration["controls"] == {
        "AeEnable": False,
        "AwbEnable": False,
        "ColourGains": (1.6, 1.6),
        "ExposureTime": 4000,
        "AnalogueGain": 4.0,
        "FrameDurationLimits": (16_667, 16_667),
        "NoiseReductionMode": "noise off",
        "AfMode": "manual focus",
        "LensPosition": 1.2,
        "Saturation": 1.0,
        "Contrast": 1.0,
        "Brightness": 0.0,
    }
    assert device.calls == ["start"]


def test_first_row_begins_one_exposure_before_the_sensors_timestamp() -> None:
    source, device = opened(CameraConfig())
    device.outcome.append(request(BOOT_NS, 3990.0))
    frame = source.read()
    assert frame is not None
    assert frame.t_first_row_ns == BOOT_NS + OFFSET_NS - 3_990_000
    assert frame.exposure_s == pytest.approx(0.00399)
    assert frame.readout_s == pytest.approx(1 / 80.0)


def test_read_out_of_the_rig_goes_before_the_estimate() -> None:
    source, device = opened(CameraConfig(readout_s=0.009))
    device.outcome.append(request(BOOT_NS))
    frame = source.read()
    assert frame is not None
    assert frame.readout_s == 0.009


def test_the_image_is_in_the_cameras_memory_until_it_is_released() -> None:
    source, device = opened(CameraConfig())
    first = request(BOOT_NS)
    device.outcome.append(first)
    frame = source.read()
    assert frame is not None
    assert np.shares_memory(frame.image, first.pixels)
    part = frame.image[10:20]
    del frame
    gc.collect()
    assert (first.mapped, first.released) == (1, 0)
    del part
    gc.collect()
    assert (first.mapped, first.released) == (0, 1)


def test_a_frame_lost_in_the_camera_stack_leaves_a_gap_in_the_count() -> None:
    source, device = opened(CameraConfig())
    device.outcome += [request(BOOT_NS), request(BOOT_NS + 16_700_000), request(BOOT_NS + 50_000_000)]
    frames = [source.read() for _ in range(3)]
    assert [frame.index for frame in frames if frame] == [0, 1, 3]


def test_frames_before_the_start_and_before_synchronisation_go_back_to_the_camera() -> None:
    source, device = opened(CameraConfig(sync="client"), start_ns=BOOT_NS + OFFSET_NS)
    early, unsynchronised, good = (
        request(BOOT_NS, SyncReady=True),
        request(BOOT_NS + 20_000_000, SyncReady=False),
        request(BOOT_NS + 40_000_000, SyncReady=True),
    )
    device.outcome += [early, unsynchronised, good]
    frame = source.read()
    assert frame is not None
    assert frame.t_first_row_ns == BOOT_NS + 40_000_000 + OFFSET_NS - 4_000_000
    assert (early.released, unsynchronised.released, good.released) == (1, 1, 0)
    assert device.configuration["controls"]["SyncMode"] == "client"


def test_old_libcamera_cannot_synchronise() -> None:
    old = SimpleNamespace(draft=CONTROLS.draft, AfModeEnum=CONTROLS.AfModeEnum)
    with pytest.raises(DeviceError, match=r"libcamera 0\.4"):
        opened(CameraConfig(sync="server"), controls=old)
    assert FakePicamera2.created[-1].calls == ["flush", "stop", "close"]


def test_one_job_is_waited_for_in_pieces() -> None:
    source, device = opened(CameraConfig())
    device.outcome += [TimeoutError(), TimeoutError(), request(BOOT_NS)]
    assert source.read() is not None
    assert device.jobs == 1


def test_silence_is_an_error() -> None:
    source, _ = opened(CameraConfig())
    with pytest.raises(DeviceError, match="no frame for 5 s"):
        source.read()


def test_a_camera_that_does_otherwise_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    source, device = opened(CameraConfig())
    device.outcome += [request(BOOT_NS + 16_667_000 * number, 9000.0) for number in range(20)]
    with caplog.at_level(logging.WARNING):
        for _ in range(20):
            source.read()
    assert caplog.text.count("ExposureTime 9000 instead of 4000") == 1
    assert "AnalogueGain" not in caplog.text


def test_live_settings_reach_the_camera() -> None:
    source, device = opened(CameraConfig())
    settings = CameraSettings.from_config(CameraConfig(), nominal_colors({}))
    source.apply(settings.changed({"exposure_s": 0.001, "gain": 8.0}, 60.0))
    assert device.controls_set[0]["ExposureTime"] == 1000
    assert device.controls_set[0]["AnalogueGain"] == 8.0
    source.close()
    with pytest.raises(DeviceError, match="not open"):
        source.apply(settings)


def test_picture_settings_reach_the_camera_at_the_start_and_live() -> None:
    camera = CameraConfig(saturation=1.4)
    source, device = opened(camera)
    start = device.configuration["controls"]
    assert (start["Saturation"], start["Contrast"], start["Brightness"]) == (1.4, 1.0, 0.0)
    settings = CameraSettings.from_config(camera, nominal_colors({}))
    source.apply(settings.changed({"contrast": 1.2, "brightness": -0.1}, 60.0))
    live = device.controls_set[0]
    assert (live["Saturation"], live["Contrast"], live["Brightness"]) == (1.4, 1.2, -0.1)
    assert source.problem == ""


def test_a_picture_setting_that_the_camera_has_not_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    made = FakePicamera2.__init__

    def grey(self: FakePicamera2, number: int) -> None:
        made(self, number)
        del self.camera_controls["Saturation"]

    monkeypatch.setattr(FakePicamera2, "__init__", grey)
    source, device = opened(CameraConfig())
    assert "Saturation" not in device.configuration["controls"]
    settings = CameraSettings.from_config(CameraConfig(), nominal_colors({}))
    with pytest.raises(ConfigError, match=r"camera left has no control for saturation = 1\.5"):
        source.apply(settings.changed({"saturation": 1.5}, 60.0))
    assert not device.controls_set
    # In rig.toml it is a problem that stays in the status, and no reason to refuse everything else.
    source, device = opened(CameraConfig(saturation=1.5))
    assert "saturation = 1.5" in source.problem
    asked = CameraSettings.from_config(CameraConfig(saturation=1.5), nominal_colors({}))
    source.apply(asked.changed({"gain": 8.0}, 60.0))
    assert device.controls_set[0]["AnalogueGain"] == 8.0


def test_close_frees_the_camera_and_ends_reading() -> None:
    source, device = opened(CameraConfig())
    source.close()
    source.close()
    assert device.calls == ["start", "flush", "stop", "close"]
    assert source.read() is None


def test_a_missing_camera_is_named_with_those_present() -> None:
    with pytest.raises(DeviceError, match="no libcamera camera 1; present: 0: imx219"):
        opened(CameraConfig(device=1))
    with pytest.raises(DeviceError, match="no libcamera index"):
        opened(CameraConfig(device="/dev/video0"))


def test_missing_picamera2_says_how_to_install_it() -> None:
    with pytest.raises(DeviceError, match="apt install -y python3-picamera2"):
        import_picamera()


@pytest.mark.parametrize(
    ("camera", "size"),
    [
        (CameraConfig(rate_hz=30), (1640, 1232)),
        (CameraConfig(rate_hz=60), (1296, 972)),
        (CameraConfig(rate_hz=90), (640, 480)),
        (CameraConfig(rate_hz=80, sync="server"), (640, 480)),
    ],
)
def test_the_widest_mode_that_is_fast_enough(camera: CameraConfig, size: tuple[int, int]) -> None:
    mode = choose_mode(MODES, camera, "left")
    assert mode is not None
    assert mode["size"] == size


def test_a_camera_that_lists_formats_instead_of_modes_leaves_no_choice() -> None:
    assert choose_mode([{"format": "BGR888"}], CameraConfig(), "left") is None


def test_no_mode_is_fast_enough() -> None:
    with pytest.raises(DeviceError, match=r"640x480 at 120 Hz; it has 640x480 at 103\.3 Hz"):
        choose_mode(MODES, CameraConfig(rate_hz=120), "left")
