from __future__ import annotations

import asyncio
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from wall_clock import in_time

from rhot.errors import DeviceError, HungDeviceError
from rhot.rig.feet_config import DepthCameraConfig
from rhot_feet.service import DepthGrabber
from rhot_feet.sources.depth_camera.realsense import (
    DepthFiltering,
    DepthPipeline,
    RealSenseSource,
    camera_of,
    import_pyrealsense2,
)

SENT_US, MIDDLE_US = 5_009_000, 5_000_000


class Info:
    """A device: what it says about itself, and a colour sensor that can be set."""

    def __init__(self, serial: str, usb: str = "3.2", firmware: str = "5.15.1") -> None:
        self.values = {
            "serial_number": serial,
            "name": "Intel RealSense D435",
            "usb_type_descriptor": usb,
            "firmware_version": firmware,
            "recommended_firmware_version": "5.15.1",
        }
        self.options: dict[str, float] = {}

    def get_info(self, key: str) -> str:
        return self.values[key]

    def supports(self, key: str) -> bool:
        return key in self.values or key in ("global_time_enabled", "auto_exposure_priority")

    def query_sensors(self) -> list[Info]:
        return [self]

    def is_option_read_only(self, key: str) -> bool:
        return False

    def set_option(self, key: str, value: float) -> None:
        self.options[key] = value


class Picture:
    def __init__(self, data: np.ndarray[Any, Any], domain: str = "global_time", metadata: bool = True) -> None:
        self.data, self.domain, self.metadata = data, domain, metadata

    def get_data(self) -> np.ndarray[Any, Any]:
        return self.data

    def get_units(self) -> float:
        return 0.0001

    def get_timestamp(self) -> float:
        return 1_700_000_000_100.0

    def get_frame_timestamp_domain(self) -> str:
        return self.domain

    def supports_frame_metadata(self, key: str) -> bool:
        return self.metadata

    def get_frame_metadata(self, key: str) -> int:
        return {"frame_timestamp": SENT_US, "sensor_timestamp": MIDDLE_US}[key]

    def get_frame_number(self) -> int:
        return 42


class FrameSet:
    def __init__(self, **color: Any) -> None:
        self.color = Picture(np.full((480, 848, 3), 7, np.uint8), **color)
        self.depth = Picture(np.full((480, 848), 12_340, np.uint16))

    def get_color_frame(self) -> Picture:
        return self.color

    def get_depth_frame(self) -> Picture:
        return self.depth

    def as_frameset(self) -> FrameSet:
        return self


class Block:
    def set_option(self, key: str, value: float) -> None:
        pass

    def process(self, frames: FrameSet) -> FrameSet:
        return frames


class Sdk:
    """Stands in for the module `pyrealsense2`."""

    def __init__(self, *devices: Info) -> None:
        self.devices = list(devices)
        self.sets: list[Any] = []
        self.refuses = ""
        self.calls: list[str] = []
        self.streams: list[tuple[Any, ...]] = []
        self.camera_info = Keys()
        self.option = Keys()
        self.frame_metadata_value = Keys()
        self.timestamp_domain = Keys()
        self.stream = Keys()
        self.format = Keys()

    def context(self) -> SimpleNamespace:
        return SimpleNamespace(query_devices=lambda: self.devices)

    def config(self) -> SimpleNamespace:
        return SimpleNamespace(
            enable_device=lambda serial: self.calls.append(f"device {serial}"),
            enable_stream=lambda *values: self.streams.append(values),
        )

    def pipeline(self, context: Any) -> SimpleNamespace:
        return SimpleNamespace(start=self._start, stop=self._stop, try_wait_for_frames=self._wait)

    def _start(self, config: Any) -> Any:
        if self.refuses:
            raise RuntimeError(self.refuses)
        lens = SimpleNamespace(
            width=848, height=480, fx=610.0, fy=611.0, ppx=424.0, ppy=240.0, model="distortion.none", coeffs=[0.0] * 5
        )
        profile = SimpleNamespace(get_intrinsics=lambda: lens)
        return SimpleNamespace(get_stream=lambda kind: SimpleNamespace(as_video_stream_profile=lambda: profile))

    def _stop(self) -> None:
        self.calls.append("stop")

    def _wait(self, timeout_ms: int) -> tuple[bool, Any]:
        item = self.sets.pop(0) if self.sets else None
        if isinstance(item, Exception):
            raise item
        return item is not None, item

    def align(self, stream: str) -> Block:
        return Block()

    def disparity_transform(self, forwards: bool) -> Block:
        return Block()

    decimation_filter = spatial_filter = temporal_filter = Block


class Keys:
    def __getattr__(self, name: str) -> str:
        return name


class Clock:
    def __init__(self) -> None:
        self.ns = 1_700_000_000_200_000_000
        self.interrupted_ns = 0
        """What passes before the next reading."""

    def now(self) -> int:
        self.ns += self.interrupted_ns
        self.interrupted_ns = 0
        return self.ns


def opened(sdk: Sdk, clock: Clock, **config: Any) -> RealSenseSource:
    # The rig clock is 3 s ahead of this machine's wall clock.
    source = RealSenseSource(
        DepthCameraConfig(**config), lambda: clock.now() + 3_000_000_000, load=lambda: sdk, wall_ns=clock.now
    )
    source.open(0)
    return source


def test_an_interruption_while_clocks_are_read_moves_no_picture() -> None:
    sdk, clock = Sdk(Info("123")), Clock()
    rig_ns = clock.ns + 3_000_000_000

    def interrupted() -> int:
        clock.interrupted_ns = 12_000_000 if clock.ns + 3_000_000_000 == rig_ns else 0
        return clock.ns + 3_000_000_000

    source = RealSenseSource(DepthCameraConfig(), interrupted, load=lambda: sdk, wall_ns=clock.now)
    source.open(0)
    sdk.sets.append(FrameSet())
    frame = source.read(0.1)
    assert frame is not None
    assert abs(frame.t_ns - (1_700_000_000_091_000_000 + 3_000_000_000)) < 1_000


def test_a_frame_in_millimetres_at_the_middle_of_its_exposure() -> None:
    sdk, clock = Sdk(Info("123")), Clock()
    source = opened(sdk, clock)
    assert sdk.streams == [("depth", 848, 480, "z16", 60), ("color", 848, 480, "bgr8", 60)]
    assert sdk.devices[0].options == {"global_time_enabled": 1.0, "auto_exposure_priority": 0.0}
    sdk.sets.append(FrameSet())
    frame = source.read(0.1)
    assert frame is not None
    assert abs(frame.t_ns - (1_700_000_000_091_000_000 + 3_000_000_000)) < 1_000
    assert frame.depth_mm is not None
    assert int(frame.depth_mm[0, 0]) == 1234
    assert frame.index == 42
    assert frame.camera.K[1, 1] == 611.0
    assert source.read(0.1) is None
    source.close()
    source.close()
    assert sdk.calls == ["device 123", "stop"]
    assert source.read(0.1) is None


def test_without_metadata_pictures_are_timed_when_they_arrive(caplog: pytest.LogCaptureFixture) -> None:
    sdk, clock = Sdk(Info("123")), Clock()
    source = opened(sdk, clock)
    for _ in range(3):
        sdk.sets.append(FrameSet(domain="system_time", metadata=False))
        frame = source.read(0.1)
        assert frame is not None
        assert abs(frame.t_ns - (1_700_000_000_100_000_000 + 3_000_000_000)) < 1_000
    assert caplog.text.count("no times of exposure") == 1


def test_an_unplugged_camera_is_an_error_and_comes_back() -> None:
    sdk, clock = Sdk(Info("123")), Clock()
    source = opened(sdk, clock)
    device = sdk.devices.pop()
    assert source.read(0.1) is None
    clock.ns += 1_500_000_000
    with pytest.raises(DeviceError, match="123 was unplugged"):
        source.read(0.1)
    source.close()
    with pytest.raises(DeviceError, match="no RealSense camera is plugged in"):
        source.open(0)
    sdk.devices.append(device)
    source.open(0)
    sdk.sets.append(FrameSet())
    assert source.read(0.1) is not None


def test_silence_and_errors_of_the_sdk() -> None:
    sdk, clock = Sdk(Info("123")), Clock()
    source = opened(sdk, clock)
    clock.ns += 6_000_000_000
    with pytest.raises(DeviceError, match="sent no picture for 6 s"):
        source.read(0.1)
    sdk.sets.append(RuntimeError("Device disconnected"))
    with pytest.raises(DeviceError, match="Device disconnected"):
        source.read(0.1)


def test_the_right_one_of_several() -> None:
    clock = Clock()
    with pytest.raises(DeviceError, match=r"several.*123.*456.*set serial"):
        opened(Sdk(Info("123"), Info("456")), clock)
    with pytest.raises(DeviceError, match=r"no RealSense with serial 789; there is 123"):
        opened(Sdk(Info("123")), clock, serial="789")
    sdk = Sdk(Info("123"), Info("456"))
    opened(sdk, clock, serial="456")
    assert sdk.calls == ["device 456"]


@pytest.mark.parametrize(
    ("error", "remedy"),
    [
        (ImportError("libusb-1.0.so.0: cannot open shared object file"), "sudo apt install libusb-1.0-0"),
        (ModuleNotFoundError("No module named 'pyrealsense2'"), r"pip install 'rhot\[realsense\]'"),
    ],
)
def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch, error: ImportError, remedy: str) -> None:
    def fails(name: str) -> None:
        raise error

    monkeypatch.setattr("importlib.import_module", fails)
    with pytest.raises(DeviceError, match=f"install what is missing with: {remedy}"):
        import_pyrealsense2()


def test_a_camera_without_a_serial_number_is_passed_over() -> None:
    """One whose firmware is being repaired says its name and nothing else."""
    repaired = Info("")
    del repaired.values["serial_number"]
    sdk = Sdk(repaired, Info("456"))
    opened(sdk, Clock())
    assert sdk.calls == ["device 456"]


def test_refusals_name_usb_2_and_old_firmware(caplog: pytest.LogCaptureFixture) -> None:
    sdk = Sdk(Info("123", usb="2.1", firmware="5.9.2"))
    sdk.refuses = "Couldn't resolve requests"
    with pytest.raises(DeviceError, match=r"848x480 at 60 Hz.*USB 2"):
        opened(sdk, Clock())
    assert "firmware 5.9.2 is older than 5.15.1" in caplog.text
    sdk = Sdk(Info("123"))
    sdk.refuses = "Couldn't resolve requests"
    with pytest.raises(DeviceError, match="rs-enumerate-devices"):
        opened(sdk, Clock())


def test_the_lens_agrees_with_the_sdks_own() -> None:
    sdk = pytest.importorskip("pyrealsense2")
    lens = sdk.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = 848, 480, 610.0, 611.0, 424.0, 240.0
    lens.model, lens.coeffs = sdk.distortion.inverse_brown_conrady, [-0.055, 0.065, -0.0003, 0.0007, -0.02]
    points = np.array([[0.5, 0.3, 1.0], [-0.6, -0.3, 1.0], [0.0, 0.0, 1.0]])
    theirs = np.array([sdk.rs2_project_point_to_pixel(lens, point.tolist()) for point in points])
    np.testing.assert_allclose(camera_of(lens).project(points), theirs, atol=0.02)
    lens.model, lens.coeffs = sdk.distortion.ftheta, [0.1] * 5
    with pytest.raises(DeviceError, match="ftheta"):
        camera_of(lens)


def test_the_real_filters_bring_depth_onto_the_colour_picture() -> None:
    """Frames of a software device through the SDK's own decimation, smoothing and alignment."""
    sdk = pytest.importorskip("pyrealsense2")
    frames = software_frames(sdk, depth_mm=1500)
    result = DepthPipeline(sdk, DepthFiltering()).process(frames)
    depth = np.asanyarray(result.get_depth_frame().get_data())
    color = np.asanyarray(result.get_color_frame().get_data())
    assert depth.shape == (480, 848)
    assert color.shape == (480, 848, 3)
    inner = depth[100:380, 200:640]
    assert (inner > 0).mean() > 0.95
    assert abs(float(np.median(inner[inner > 0])) - 1500.0) <= 3.0


def software_frames(sdk: Any, depth_mm: int) -> Any:
    device = sdk.software_device()
    made = []
    for number, (name, kind, pixel_format, depth) in enumerate(
        [("Depth", sdk.stream.depth, sdk.format.z16, True), ("Color", sdk.stream.color, sdk.format.bgr8, False)]
    ):
        sensor = device.add_sensor(name)
        stream = sdk.video_stream()
        stream.type, stream.index, stream.uid = kind, 0, number
        stream.width, stream.height, stream.fps = 848, 480, 60
        stream.bpp, stream.fmt = (2, pixel_format) if depth else (3, pixel_format)
        lens = sdk.intrinsics()
        lens.width, lens.height, lens.ppx, lens.ppy = 848, 480, 424.0, 240.0
        lens.fx = lens.fy = 424.0 if depth else 613.0
        lens.model, lens.coeffs = sdk.distortion.none, [0.0] * 5
        stream.intrinsics = lens
        profile = sensor.add_video_stream(stream)
        if depth:
            sensor.add_read_only_option(sdk.option.depth_units, 0.001)
            sensor.add_read_only_option(sdk.option.stereo_baseline, 50.0)
        made.append((sensor, profile, depth))
    near = sdk.extrinsics()
    near.rotation, near.translation = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], [0.015, 0.0, 0.0]
    made[0][1].register_extrinsics_to(made[1][1], near)
    device.create_matcher(sdk.matchers.default)
    queue = sdk.syncer()
    for sensor, profile, _ in made:
        sensor.open(profile)
        sensor.start(queue)
    for number in range(1, 6):
        for sensor, profile, depth in made:
            frame = sdk.software_video_frame()
            frame.pixels = np.full((480, 848), depth_mm, np.uint16) if depth else np.full((480, 848, 3), 90, np.uint8)
            frame.stride, frame.bpp = (848 * 2, 2) if depth else (848 * 3, 3)
            frame.timestamp, frame.frame_number = 16.0 * number, number
            frame.domain, frame.profile = sdk.timestamp_domain.hardware_clock, profile.as_video_stream_profile()
            if depth:
                frame.depth_units = 0.001
            sensor.on_video_frame(frame)
    for _ in range(8):
        frames = queue.wait_for_frames()
        if frames.get_depth_frame() and frames.get_color_frame():
            return frames
    pytest.fail("the software device gave no complete set of frames")


@pytest.mark.real_time
async def test_a_stop_that_hangs_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """`rs2::pipeline::stop` may never return, as for a silent camera (librealsense issues 9184 and 6301)."""
    sdk, released = Sdk(Info("a")), threading.Event()
    monkeypatch.setattr(sdk, "_stop", released.wait)
    source = RealSenseSource(DepthCameraConfig(), lambda: 0, load=lambda: sdk)
    grabber = DepthGrabber(source)
    await grabber.open(lambda: source.open(0))
    grabber.start()
    begun = time.monotonic()
    with pytest.raises(HungDeviceError, match=r"depth camera: close: its driver has not returned for 0\.3 s"):
        await asyncio.wait_for(grabber.stop(limit_s=0.3), 20.0)
    in_time(time.monotonic() - begun, 1.5, "giving up a driver that hangs")
    released.set()
