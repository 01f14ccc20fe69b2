"""The driver of a Pi's cameras on libcamera and picamera2 themselves, with the kernel's virtual camera (vimc).

Debian 13 has libcamera 0.4, Raspberry Pi OS a newer one of its own with another pipeline; between them and the driver
stands the same picamera2. vimc has no modes, no exposure and no gain, and draws about one picture a second where the
machine is emulated. With `RHOT_DEVICE=picamera2` the first camera of this Pi is taken instead.
"""

from __future__ import annotations

import itertools
import logging
import os
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from machine.stacks import DEVICE, in_guest, live_settings, needs_emulated, read_frames

from rhot.errors import DeviceError
from rhot.rig.config import CameraConfig
from rhot_capture.sources import picamera2 as driver
from rhot_capture.sources.picamera2 import Picamera2Source

pytestmark = pytest.mark.stacks
CAMERA = CameraConfig(device="0", width=640, height=480, rate_hz=30.0)


@pytest.fixture(scope="module", autouse=True)
def camera() -> None:
    """A camera: vimc, or the Pi's own."""
    if DEVICE == "picamera2":
        return
    in_guest()
    subprocess.run(["modprobe", "vimc"], check=True)
    # picamera2 asks for the heap of a Pi's kernel by name; this kernel's is called otherwise.
    heap = Path("/dev/dma_heap/vidbuf_cached")
    if not heap.exists():
        heap.symlink_to("system")
    deadline = time.monotonic() + 30.0
    while not Path("/dev/media0").exists():
        assert time.monotonic() < deadline, "vimc has made no device"
        time.sleep(0.1)


@pytest.fixture
def source() -> Iterator[Picamera2Source]:
    made = Picamera2Source("left", CAMERA)
    yield made
    made.close()


def test_pictures_come_with_numbers_and_times(source: Picamera2Source) -> None:
    source.open(0)
    begun_ns = time.monotonic_ns()
    frames = read_frames(source, 4)
    for before, after in itertools.pairwise(frames):
        assert after.index > before.index
        assert after.t_first_row_ns > before.t_first_row_ns
    for frame in frames:
        assert frame.image.shape == (480, 640, 3)
        assert frame.image.dtype == np.uint8
        assert begun_ns - 5_000_000_000 < frame.t_first_row_ns <= time.monotonic_ns()
    # Frames are numbered by the time that has passed: what the slow camera left out is a gap.
    passed = 1e-9 * (frames[-1].t_first_row_ns - frames[0].t_first_row_ns) * CAMERA.rate_hz
    assert abs(frames[-1].index - frames[0].index - passed) <= 2


def test_colours_are_blue_green_red(source: Picamera2Source) -> None:
    """vimc draws colour bars: the first ones are white, yellow and cyan, as on every television."""
    needs_emulated("its picture is not known")
    source.open(0)
    image = read_frames(source, 1)[0].image
    row = image[image.shape[0] // 2].astype(int)
    colors = [tuple((color > 100).tolist()) for color in row]
    # Where two bars meet, a few pixels are of neither.
    bars = [color for color, run in itertools.groupby(colors) if len(list(run)) > 10]
    white, yellow, cyan, green, magenta, red, blue = (
        *((True, True, True), (False, True, True), (True, True, False), (False, True, False)),
        *((True, False, True), (False, False, True), (True, False, False)),
    )
    shown = [color for color in bars if color in (white, yellow, cyan, green, magenta, red, blue)]
    assert is_run_of(shown, [white, yellow, cyan, green, magenta, red, blue]), bars


def is_run_of(part: list[Any], whole: list[Any]) -> bool:
    """Return whether a list, of at least three, is found in another one without a gap."""
    return len(part) >= 3 and any(whole[k : k + len(part)] == part for k in range(len(whole)))


def test_a_camera_without_modes_and_exposure_says_what_it_cannot_lock(
    source: Picamera2Source, caplog: pytest.LogCaptureFixture
) -> None:
    needs_emulated("a Pi's camera has all of these")
    caplog.set_level(logging.INFO)
    source.open(0)
    assert "cannot lock exposure, gain, white balance" in source.problem
    assert "sensor mode of its own" in caplog.text


def test_settings_that_the_camera_has_are_taken_while_it_runs(source: Picamera2Source) -> None:
    source.open(0)
    read_frames(source, 1)
    source.apply(live_settings(CAMERA, contrast=1.2))
    read_frames(source, 1)


def test_closing_gives_the_camera_back_and_it_opens_again(source: Picamera2Source) -> None:
    for _ in range(3):
        source.open(0)
        read_frames(source, 1)
        source.close()
    assert source.read() is None


def test_a_second_program_gets_the_reason(source: Picamera2Source) -> None:
    source.open(0)
    read_frames(source, 1)
    other = (
        "from rhot.rig.config import CameraConfig\n"
        "from rhot_capture.sources.picamera2 import Picamera2Source\n"
        "Picamera2Source('right', CameraConfig(device='0', width=640, height=480, rate_hz=30.0)).open(0)\n"
    )
    done = subprocess.run(
        [os.environ.get("RHOT_PYTHON", "python"), "-c", other], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode != 0
    # libcamera shows some cameras to nobody else while they are in use.
    assert "DeviceError: camera right: " in done.stderr
    assert re.search(
        r"(cannot be opened; another program|present: none; check that no other program) uses it", done.stderr
    )


def test_a_size_that_the_camera_lacks_is_refused() -> None:
    """vimc gives any size up to that of its sensor, in even numbers of pixels."""
    large = Picamera2Source("left", CAMERA.model_copy(update={"width": 20000, "height": 20000}))
    with pytest.raises(
        DeviceError, match=r"camera left: (delivers \d+x\d+ instead of|no sensor mode gives) 20000x20000"
    ):
        large.open(0)


def test_no_such_camera_names_those_that_are_there() -> None:
    with pytest.raises(
        DeviceError,
        match=r"no libcamera camera 7; present: 0: .+; check that no other program uses it, the ribbon cable",
    ):
        Picamera2Source("left", CAMERA.model_copy(update={"device": "7"})).open(0)


def test_synchronisation_is_refused_where_there_is_none() -> None:
    needs_emulated("a Pi's camera can be synchronised")
    with pytest.raises(DeviceError, match='sync = "client" needs a Raspberry Pi with libcamera'):
        Picamera2Source("left", CAMERA.model_copy(update={"sync": "client"})).open(0)


def test_a_camera_that_goes_silent_is_an_error(source: Picamera2Source, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel has no picture to give while all buffers are kept."""
    needs_emulated("it would have to be pulled out")
    monkeypatch.setattr(driver, "_SILENCE_S", 2.0)
    source.open(0)
    read_frames(source, 1)
    device = source._device
    kept = [device.capture_request() for _ in range(4)]
    with pytest.raises(DeviceError, match="no frame for 2 s; check the ribbon cable"):
        for _ in range(4):
            source.read()
    for request in kept:
        request.release()
