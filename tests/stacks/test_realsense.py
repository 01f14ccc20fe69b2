"""The depth camera's driver through the RealSense SDK itself.

A software device of the SDK gets our pictures, the SDK records them to a file, and plays the file as a camera that is
plugged in. Nothing of the SDK is replaced. With `RHOT_DEVICE=realsense` the tests that say nothing about the pictures
run on the camera that is plugged in.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from machine.stacks import DEVICE, needs_emulated
from still_feet import FEET, head, picture, positions

from rhot.errors import DeviceError
from rhot.messages import FootPose
from rhot.rig.feet_config import DepthCameraConfig
from rhot_feet.foot_core import FootCore
from rhot_feet.frames import DepthFrame
from rhot_feet.sources.depth_camera.realsense import DepthFiltering, RealSenseSource

rs = pytest.importorskip(
    "pyrealsense2",
    reason="the SDK needs: pip install 'rhot[realsense]' and apt install libusb-1.0-0",
    exc_type=ImportError,
)

RATE_HZ = 30
SERIAL = "000000000001"
MIDDLE_US = 9_000
"""From the middle of the exposure to the sending."""
WITHOUT = DepthFiltering(decimation=1, spatial=False, temporal_alpha=1.0)


@dataclass(frozen=True)
class Taken:
    """A recording of the SDK.

    Attributes:
        path: of the file.
        frames: what was recorded.
        sent_ms: when each was sent, by the SDK's clock.
    """

    path: Path
    frames: Sequence[DepthFrame]
    sent_ms: Sequence[float]


def record(path: Path, frames: Sequence[DepthFrame], domain: Any, *, metadata: bool = True) -> Taken:
    """Let the SDK record pictures that a software device of it sends."""
    height, width = frames[0].color.shape[:2]
    K = frames[0].camera.K
    device = rs.software_device()
    device.register_info(rs.camera_info.name, "Intel RealSense D435 (software)")
    device.register_info(rs.camera_info.serial_number, SERIAL)
    kinds = [("Stereo Module", rs.stream.depth, rs.format.z16, 2), ("RGB Camera", rs.stream.color, rs.format.bgr8, 3)]
    senders = []
    for number, (name, stream, pixel_format, size) in enumerate(kinds):
        sensor = device.add_sensor(name)
        if size == 2:
            sensor.add_read_only_option(rs.option.depth_units, 0.001)
            sensor.add_read_only_option(rs.option.stereo_baseline, 50.0)
        lens = rs.intrinsics()
        lens.width, lens.height = width, height
        lens.fx, lens.fy, lens.ppx, lens.ppy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        lens.model, lens.coeffs = rs.distortion.inverse_brown_conrady, [0.0] * 5
        video = rs.video_stream()
        video.type, video.index, video.uid = stream, 0, number
        video.width, video.height, video.fps, video.bpp, video.fmt = width, height, RATE_HZ, size, pixel_format
        video.intrinsics = lens
        senders.append((sensor, sensor.add_video_stream(video, True), size))
    together = rs.extrinsics()
    together.rotation, together.translation = np.eye(3).ravel().tolist(), [0.0] * 3
    senders[0][1].register_extrinsics_to(senders[1][1], together)
    recorder = rs.recorder(str(path), device)
    queue = rs.frame_queue(64)
    sensors = list(recorder.query_sensors())
    for sensor, (_, profile, _) in zip(sensors, senders, strict=True):
        sensor.open(profile)
        sensor.start(queue)
    begin_ms = 1_700_000_000_000.0
    sent_ms = [begin_ms + 1e3 * number / RATE_HZ for number in range(len(frames))]
    for number, (frame, at_ms) in enumerate(zip(frames, sent_ms, strict=True)):
        for (sensor, profile, size), data in zip(senders, (frame.depth_mm, frame.color), strict=True):
            sent = rs.software_video_frame()
            sent.pixels, sent.stride, sent.bpp = np.ascontiguousarray(data), width * size, size
            sent.timestamp, sent.domain, sent.frame_number = at_ms, domain, number
            sent.profile = profile.as_video_stream_profile()
            if size == 2:
                sent.depth_units = 0.001
            if metadata:
                sensor.set_metadata(rs.frame_metadata_value.frame_timestamp, round(1e3 * at_ms))
                sensor.set_metadata(rs.frame_metadata_value.sensor_timestamp, round(1e3 * at_ms) - MIDDLE_US)
            sensor.on_video_frame(sent)
        # The recorder writes on a thread of its own, and drops what comes faster.
        time.sleep(0.3 / RATE_HZ)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    return Taken(path, frames, sent_ms)


class Plugged:
    """The SDK's module, with recordings plugged in: every context is the same one, to which their devices belong."""

    def __init__(self, *paths: Path) -> None:
        self.context = rs.context()
        self.paths = paths
        self.devices = [self.context.load_device(str(path)) for path in paths]

    def module(self) -> Any:
        return SimpleNamespace(**{**vars(rs), "context": lambda: self.context})

    def unplug(self) -> None:
        for path in self.paths:
            self.context.unload_device(str(path))


def source_of(plugged: Plugged, filtering: DepthFiltering = WITHOUT, **config: Any) -> RealSenseSource:
    settings = {"width": 848, "height": 480, "rate_hz": RATE_HZ, **config}
    return RealSenseSource(
        DepthCameraConfig(**settings), time.time_ns, filtering=filtering, load=plugged.module, wall_ns=time.time_ns
    )


def read_all(source: RealSenseSource) -> list[DepthFrame]:
    """Read until nothing has come for half a second."""
    frames = []
    while (frame := source.read(0.5)) is not None:
        frames.append(frame)
    return frames


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Taken:
    """Feet that stand still, drawn with their markers."""
    needs_emulated("it knows what the pictures show")
    frames = [picture(number, number) for number in range(30)]
    return record(tmp_path_factory.mktemp("rs") / "still.db3", frames, rs.timestamp_domain.global_time)


@pytest.fixture
def plugged(still: Taken) -> Plugged:
    return Plugged(still.path)


def test_pictures_lens_numbers_and_times_arrive_as_they_were_taken(still: Taken, plugged: Plugged) -> None:
    source = source_of(plugged)
    source.open(0)
    frames = read_all(source)
    source.close()
    assert len(frames) >= 25
    for frame in frames:
        taken = still.frames[frame.index]
        np.testing.assert_array_equal(frame.color, taken.color)
        assert frame.depth_mm is not None
        # Also with both lenses the same, the SDK's `align` takes the nearest of neighbouring pixels.
        assert taken.depth_mm is not None
        both = (frame.depth_mm > 0) & (taken.depth_mm > 0)
        assert both.mean() > 0.9 * (taken.depth_mm > 0).mean()
        assert np.median(np.abs(frame.depth_mm[both].astype(int) - taken.depth_mm[both])) <= 15.0
        np.testing.assert_allclose(frame.camera.K, taken.camera.K, atol=1e-3)
        # Rig time is the wall clock here.
        assert abs(frame.t_ns - 1e6 * still.sent_ms[frame.index] + 1e3 * MIDDLE_US) < 2e6


def test_the_sdks_filters_keep_the_depth(still: Taken, plugged: Plugged) -> None:
    source = source_of(plugged, DepthFiltering())
    source.open(0)
    frames = read_all(source)
    source.close()
    last = frames[-1]
    taken = still.frames[last.index].depth_mm
    assert last.depth_mm is not None
    assert taken is not None
    both = (last.depth_mm > 0) & (taken > 0)
    assert both.mean() > 0.8 * (taken > 0).mean()
    off_mm = np.abs(last.depth_mm[both].astype(int) - taken[both])
    assert float(np.median(off_mm)) <= 10.0


def test_feet_are_found_in_what_the_sdk_plays(still: Taken, plugged: Plugged) -> None:
    source, core = source_of(plugged, DepthFiltering()), FootCore(FEET)
    source.open(0)
    frames = read_all(source)
    source.close()
    for frame in frames:
        for late_ns in (-5_000_000, 5_000_000):
            core.add_head_pose(head(frame.t_ns + late_ns))
        core.process(frame)
    poses = [pose for _, pose in core.poses(frames[-1].t_ns) if isinstance(pose, FootPose)]
    assert {pose.side for pose in poses} == {"left", "right"}
    for pose in poses:
        assert pose.state == "measured"
        assert 1e3 * float(np.linalg.norm(np.array(pose.position) - positions()[pose.side])) < 4.0


@pytest.mark.parametrize("domain", ["system_time", "hardware_clock"])
def test_without_times_of_exposure_pictures_are_timed_when_they_arrive(
    still: Taken, tmp_path: Path, domain: str, caplog: pytest.LogCaptureFixture
) -> None:
    taken = record(tmp_path / "plain.db3", still.frames[:12], getattr(rs.timestamp_domain, domain), metadata=False)
    source = source_of(Plugged(taken.path))
    source.open(0)
    frame = source.read(2.0)
    now_ns = time.time_ns()
    source.close()
    assert frame is not None
    if domain == "system_time":
        # The SDK's time of arrival, which it recorded.
        assert abs(frame.t_ns - 1e6 * taken.sent_ms[frame.index]) < 2e6
    else:
        assert 0 <= now_ns - frame.t_ns < 500_000_000
    assert caplog.text.count("no times of exposure") == 1


def test_frames_before_the_session_are_thrown_away(still: Taken, plugged: Plugged) -> None:
    source = source_of(plugged)
    source.open(round(1e6 * still.sent_ms[20]))
    frames = []
    for _ in range(len(still.frames) + 5):
        frame = source.read(0.2)
        frames += [] if frame is None else [frame.index]
    source.close()
    assert frames
    assert min(frames) > 20


def test_a_camera_that_goes_is_noticed_and_found_again(still: Taken) -> None:
    plugged = Plugged(still.path)
    source = source_of(plugged)
    source.open(0)
    assert source.read(2.0) is not None
    plugged.unplug()
    with pytest.raises(DeviceError, match=rf"RealSense {SERIAL} was unplugged; plug it in again|{SERIAL}: .*again"):
        read_until_gone(source)
    source.close()
    with pytest.raises(DeviceError, match="no RealSense camera is plugged in"):
        source.open(0)
    plugged.devices.append(plugged.context.load_device(str(still.path)))
    source.open(0)
    assert source.read(2.0) is not None
    source.close()


def read_until_gone(source: RealSenseSource) -> None:
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        source.read(0.2)
    pytest.fail("the camera went, and the driver did not notice")


def test_a_silent_camera_is_an_error(plugged: Plugged, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording that has ended stays plugged in and sends nothing."""
    monkeypatch.setattr("rhot_feet.sources.depth_camera.realsense._STALLED_AFTER_S", 1.2)
    source = source_of(plugged)
    source.open(0)
    with pytest.raises(DeviceError, match=rf"RealSense {SERIAL} is there but sent no picture for [12] s"):
        read_until_gone(source)
    source.close()


@pytest.mark.parametrize("config", [{"width": 1280, "height": 720}, {"rate_hz": 90}])
def test_a_mode_that_the_camera_lacks_is_refused_by_name(plugged: Plugged, config: dict[str, Any]) -> None:
    source = source_of(plugged, **config)
    asked = {"width": 848, "height": 480, "rate_hz": RATE_HZ, **config}
    wanted = rf"refuses {asked['width']}x{asked['height']} at {asked['rate_hz']} Hz \(.*rs-enumerate-devices"
    with pytest.raises(DeviceError, match=wanted):
        source.open(0)
    source.close()


def test_only_the_asked_one_is_taken(still: Taken, plugged: Plugged) -> None:
    with pytest.raises(DeviceError, match=rf"no RealSense with serial 7; there is {SERIAL} \(Intel RealSense D435"):
        source_of(plugged, serial="7").open(0)
    source = source_of(plugged, serial=SERIAL)
    source.open(0)
    assert source.read(2.0) is not None
    source.close()


def test_no_camera_is_an_error_that_says_what_to_look_at() -> None:
    needs_emulated("one is plugged in")
    with pytest.raises(DeviceError, match="no RealSense camera is plugged in; on Linux it also needs the SDK's udev"):
        RealSenseSource(DepthCameraConfig(), time.time_ns).open(0)


def test_a_camera_keeps_its_rate_for_five_seconds(still_or_device: Callable[[], RealSenseSource]) -> None:
    source = still_or_device()
    source.open(0)
    frames = []
    deadline = time.monotonic() + (5.0 if DEVICE else 0.9)
    while time.monotonic() < deadline:
        frame = source.read(1.0)
        frames += [] if frame is None else [frame]
    source.close()
    steps_s = 1e-9 * np.diff([frame.t_ns for frame in frames])
    assert abs(float(np.median(steps_s)) * RATE_HZ - 1.0) < 0.05
    assert all(frame.depth_mm is not None and frame.depth_mm.shape == frame.color.shape[:2] for frame in frames)
    assert np.all(np.diff([frame.index for frame in frames]) >= 1)


@pytest.fixture
def still_or_device(request: pytest.FixtureRequest) -> Callable[[], RealSenseSource]:
    if DEVICE == "realsense":
        return lambda: RealSenseSource(DepthCameraConfig(rate_hz=RATE_HZ), time.time_ns)
    plugged = Plugged(request.getfixturevalue("still").path)
    return lambda: source_of(plugged)
