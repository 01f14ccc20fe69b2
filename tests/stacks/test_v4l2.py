"""The driver of USB and other Video4Linux cameras on the kernel itself: its ioctls, buffers, controls and devices.

Cameras are the kernel's virtual ones (vivid), and v4l2loopback fed with our own pictures. With
`RHOT_DEVICE=/dev/video0` the tests that make no camera fail run on that one instead.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from machine.stacks import DEVICE, SHARE, in_guest, live_settings, needs_emulated, read_frames
from running import rig_processes
from running.rig_processes import Processes, next_message, start_rig

from rhot.bus import Bus
from rhot.errors import ConfigError, DeviceError
from rhot.messages import HandPose
from rhot.rig import load_rig
from rhot.rig.config import CameraConfig
from rhot_capture.sources.v4l2 import V4l2Source

pytestmark = pytest.mark.stacks
_PATIENCE_S = 240.0
SIZE = {"width": 640, "height": 360}


def modprobe(*arguments: str) -> None:
    subprocess.run(["modprobe", *arguments], check=True)


def wait_for(path: str, there: bool = True) -> None:
    deadline = time.monotonic() + 20.0
    while Path(path).exists() != there:
        assert time.monotonic() < deadline, f"{path} is {'not there' if there else 'still there'}"
        time.sleep(0.1)


def load_vivid(*arguments: str) -> None:
    # One webcam for each device; nothing else of what vivid can be.
    modprobe("vivid", "node_types=0x1,0x1", "num_inputs=1,1", "input_types=0,0", *arguments)


def unload_vivid() -> None:
    for _ in range(50):
        if subprocess.run(["rmmod", "vivid"], capture_output=True, check=False).returncode == 0:
            return
        time.sleep(0.1)
    pytest.fail("vivid is still in use")


@pytest.fixture
def device() -> Iterator[str]:
    """The path of one camera."""
    if DEVICE:
        yield DEVICE
        return
    in_guest()
    load_vivid("n_devs=1", "vid_cap_nr=0")
    wait_for("/dev/video0")
    yield "/dev/video0"
    unload_vivid()


def camera_of(device: str, **config: Any) -> CameraConfig:
    return CameraConfig.model_validate(
        {"source": "v4l2", "device": device, "rate_hz": 30.0, "exposure_s": 0.004, **SIZE, **config}
    )


@contextlib.contextmanager
def opened(device: str, **config: Any) -> Iterator[V4l2Source]:
    source = V4l2Source("left", camera_of(device, **config))
    source.open(0)
    try:
        yield source
    finally:
        source.close()


def control(device: str, name: str) -> int:
    done = subprocess.run(["v4l2-ctl", "-d", device, "-C", name], capture_output=True, text=True, check=True)
    return int(done.stdout.split(":")[1].split()[0])


def set_control(device: str, name: str, value: int) -> None:
    subprocess.run(["v4l2-ctl", "-d", device, "-c", f"{name}={value}"], check=True)


def test_pictures_come_with_the_drivers_times_and_numbers(device: str) -> None:
    with opened(device) as source:
        begun_ns = time.monotonic_ns()
        frames = read_frames(source, 12)
    assert all(frame.image.shape == (360, 640, 3) and frame.image.dtype == np.uint8 for frame in frames)
    steps_s = 1e-9 * np.diff([frame.t_first_row_ns for frame in frames])
    numbers = np.diff([frame.index for frame in frames])
    assert (numbers >= 1).all()
    # A number is a frame period, also where frames fell out.
    assert abs(np.sum(steps_s) / np.sum(numbers) - 1.0 / 30.0) < 0.003
    assert begun_ns - 2_000_000_000 < frames[0].t_first_row_ns < time.monotonic_ns()


@pytest.mark.parametrize("size", [(320, 180), (640, 360), (1280, 720)])
def test_a_size_that_the_camera_has_is_chosen(device: str, size: tuple[int, int]) -> None:
    needs_emulated("its sizes are not known")
    with opened(device, width=size[0], height=size[1], rate_hz=10.0) as source:
        assert read_frames(source, 1)[0].image.shape == (size[1], size[0], 3)


def test_a_size_that_it_lacks_is_refused_with_the_one_that_it_gives(device: str) -> None:
    needs_emulated("its sizes are not known")
    with pytest.raises(DeviceError, match=r"/dev/video0 delivers \d+x\d+ instead of 800x600; set width and height"):
        V4l2Source("left", camera_of(device, width=800, height=600)).open(0)


def test_a_rate_that_it_lacks_is_said_in_the_status(device: str) -> None:
    needs_emulated("its rates are not known")
    with opened(device, width=1920, height=1080, rate_hz=240.0) as source:
        assert "rate_hz = 240 (driver says " in source.problem


def test_what_cannot_be_locked_is_said_in_the_status(device: str) -> None:
    """vivid speaks no motion JPEG, and has neither exposure nor white balance."""
    needs_emulated("its controls are not known")
    with opened(device) as source:
        assert "pixel format MJPG" in source.problem
        assert "manual exposure, exposure_s = 0.004" in source.problem


def test_picture_settings_arrive_in_the_drivers_units(device: str) -> None:
    """vivid's controls go from 0 to 255, and 128 is neutral."""
    needs_emulated("its ranges are not known")
    with opened(device, brightness=0.5, contrast=1.5, saturation=0.25) as source:
        assert [control(device, name) for name in ("brightness", "contrast", "saturation")] == [192, 192, 32]
        camera = camera_of(device)
        source.apply(live_settings(camera, brightness=-0.5, contrast=0.5))
        assert [control(device, name) for name in ("brightness", "contrast", "saturation")] == [64, 64, 128]
        with pytest.raises(ConfigError, match=r"saturation = 3 \(at most 1\.99\)"):
            source.apply(live_settings(camera, brightness=-0.5, contrast=0.5, saturation=3.0))
        assert [control(device, name) for name in ("brightness", "contrast", "saturation")] == [64, 64, 128]


def test_own_units_of_a_driver_are_set_and_read_back(device: str) -> None:
    needs_emulated("its ranges are not known")
    with opened(device, v4l2_controls={"gain": 77}) as source:
        assert (control(device, "gain_automatic"), control(device, "gain")) == (0, 77)
        assert "gain" not in source.problem


def test_the_gain_is_locked_also_where_none_is_given(device: str) -> None:
    needs_emulated("its controls are not known")
    with opened(device):
        assert control(device, "gain_automatic") == 0


@pytest.mark.parametrize(("stamp", "late_s"), [(0, 0.022), (1, 0.0)])
def test_the_meaning_of_a_timestamp_is_the_drivers_own(device: str, stamp: int, late_s: float) -> None:
    """vivid can stamp the end of a frame, or the start of its exposure; 12 ms of read-out and 10 ms of exposure."""
    needs_emulated("its stamps mean one thing")
    set_control(device, "timestamp_source", stamp)
    with opened(device, readout_s=0.012, exposure_s=0.010) as source:
        reported = []
        for _ in range(5):
            frame = read_frames(source, 1)[0]
            stamp_s = 1e-3 * source._capture.get(cv2.CAP_PROP_POS_MSEC)
            reported.append(stamp_s - 1e-9 * frame.t_first_row_ns)
    assert abs(float(np.median(reported)) - late_s) < 1e-4


def test_lost_frames_leave_a_gap_in_the_numbers(device: str) -> None:
    needs_emulated("it loses none when asked to")
    with opened(device, rate_hz=30.0) as source:
        set_control(device, "percentage_of_dropped_buffers", 40)
        frames = read_frames(source, 15)
        set_control(device, "percentage_of_dropped_buffers", 0)
    numbers, times_s = [frame.index for frame in frames], [1e-9 * frame.t_first_row_ns for frame in frames]
    assert max(np.diff(numbers)) >= 2
    passed = 30.0 * (times_s[-1] - times_s[0])
    assert abs(numbers[-1] - numbers[0] - passed) <= 2.0


def test_a_camera_that_another_program_uses_is_refused(device: str) -> None:
    holder = subprocess.Popen(
        ["v4l2-ctl", "-d", device, "--stream-mmap", "--stream-count=100000"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        time.sleep(2.0)
        reason = r"camera left: .*(in use by another program|another program uses it)"
        with pytest.raises(DeviceError, match=reason), opened(device) as source:
            read_frames(source, 1)
    finally:
        holder.kill()
        holder.wait()
    with opened(device) as source:
        read_frames(source, 2)


def test_an_unplugged_camera_is_noticed_and_found_under_another_number() -> None:
    needs_emulated("somebody would have to pull it out")
    in_guest()
    load_vivid("n_devs=1", "vid_cap_nr=0")
    wait_for("/dev/video0")
    by_name = Path("/dev/rhot-left")
    by_name.unlink(missing_ok=True)
    by_name.symlink_to("/dev/video0")
    source = V4l2Source("left", camera_of(str(by_name)))
    source.open(0)
    read_frames(source, 2)
    set_control("/dev/video0", "disconnect", 1)
    with pytest.raises(DeviceError, match=r"stopped delivering \d\.\d s ago; unplugged"):
        read_frames(source, 200)
    source.close()
    unload_vivid()
    with pytest.raises(DeviceError, match="is it plugged in"):
        source.open(0)
    load_vivid("n_devs=1", "vid_cap_nr=6")
    wait_for("/dev/video6")
    by_name.unlink()
    by_name.symlink_to("/dev/video6")
    source.open(0)
    read_frames(source, 2)
    source.close()
    unload_vivid()


def test_two_cameras_stream_at_once() -> None:
    needs_emulated("one device was named")
    in_guest()
    load_vivid("n_devs=2", "vid_cap_nr=0,1")
    wait_for("/dev/video1")
    with opened("/dev/video0", rate_hz=10.0) as left, opened("/dev/video1", rate_hz=10.0) as right:
        both = [(read_frames(left, 1)[0], read_frames(right, 1)[0]) for _ in range(5)]
    assert all(a.t_first_row_ns > b.t_first_row_ns for (b, _), (a, _) in itertools.pairwise(both))
    unload_vivid()


FEEDER = """
import sys, time
import numpy as np
pictures = np.load(sys.argv[1])
outputs = {name: open(path, 'wb', buffering=0) for name, path in (('left', sys.argv[2]), ('right', sys.argv[3]))}
while True:
    for name, output in outputs.items():
        output.write(pictures[name].tobytes())
    time.sleep(float(sys.argv[4]))
"""


@pytest.fixture
def fed() -> Iterator[None]:
    """Two cameras that show our own pictures, five times a second."""
    needs_emulated("its pictures are not known")
    in_guest()
    modprobe("v4l2loopback", "video_nr=20,21", "card_label=left,right", "exclusive_caps=1,1")
    pictures = SHARE / "played" / "pictures.npz"
    with np.load(pictures) as file:
        height, width = file["left"].shape[:2]
    for device in ("/dev/video20", "/dev/video21"):
        wait_for(device)
        wanted = f"width={width},height={height},pixelformat=YUYV"
        subprocess.run(["v4l2-ctl", "-d", device, f"--set-fmt-video-out={wanted}"], check=True)
    with subprocess.Popen([sys.executable, "-c", FEEDER, pictures, "/dev/video20", "/dev/video21", "0.2"]) as feeder:
        yield
        feeder.kill()
    subprocess.run(["rmmod", "v4l2loopback"], check=True)


@pytest.mark.usefixtures("fed")
async def test_from_two_video_devices_to_a_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Our own pictures through two v4l2loopback cameras, and every service as a process of its own."""
    # Five interpreters that start on an emulated machine take their time.
    monkeypatch.setattr(rig_processes, "PATIENCE_S", _PATIENCE_S)
    rig = load_rig(SHARE / "played" / "rig")
    processes = Processes(rig.path, tmp_path)
    try:
        for name in ("router", "capture left", "capture right", "fusion", "ik"):
            await processes.start(name)
        hand = await measured_hand(rig.config.bus, processes)
    finally:
        await processes.supervisor.stop()
    truth = json.loads((SHARE / "played" / "truth.json").read_text())
    off_mm = [
        1e3 * float(np.linalg.norm(np.array(hand.joints[joint].position) - position))
        for joint, position in truth.items()
        if joint.endswith("_tip")
    ]
    assert len(off_mm) == 5
    assert max(off_mm) < 8.0, off_mm


async def measured_hand(config: Any, processes: Processes) -> HandPose:
    """Start the rig and wait for a hand of which no finger is predicted."""

    def complete(message: Any) -> bool:
        return message.state == "measured" and "predicted" not in message.fingers.values()

    try:
        client = config.model_copy(update={"listen": (), "mode": "client"})
        async with await Bus.open(client, timeout_s=_PATIENCE_S) as bus:
            await start_rig(bus, _PATIENCE_S)
            found = await next_message(bus, "rhot/hand/right", HandPose, complete)
    except Exception as error:
        raise AssertionError(f"no hand: {error!r}\n{processes.logs()}") from error
    assert isinstance(found, HandPose)
    return found
