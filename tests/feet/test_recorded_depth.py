from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot_feet.sources.depth_camera.recorded_frames import RecordedDepthSource, load_depth_recording

LENS = {"width": 64, "height": 48, "K": [[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]], "distortion": []}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three frames, 10 ms apart; the second has no depth."""
    path = tmp_path / "feet"
    (path / "color").mkdir(parents=True)
    (path / "depth").mkdir()
    for number in (4, 5, 7):
        cv2.imwrite(str(path / "color" / f"{number:06d}.png"), np.full((48, 64, 3), number, np.uint8))
    for number in (4, 7):
        cv2.imwrite(str(path / "depth" / f"{number:06d}.png"), np.full((48, 64), 1000 + number, np.uint16))
    (path / "timestamps.csv").write_text("frame,t_ns\n4,1000000000\n5,1010000000\n7,1020000000\n")
    (path / "intrinsics.json").write_text(json.dumps(LENS))
    return path


def test_frames_with_and_without_depth(folder: Path) -> None:
    recording = load_depth_recording(folder)
    frames = list(recording.frames())
    assert [frame.index for frame in frames] == [4, 5, 7]
    assert [frame.t_ns for frame in frames] == [1_000_000_000, 1_010_000_000, 1_020_000_000]
    assert [frame.color[0, 0, 0] for frame in frames] == [4, 5, 7]
    assert [None if frame.depth_mm is None else int(frame.depth_mm[0, 0]) for frame in frames] == [1004, None, 1007]
    assert frames[0].camera.K[0, 0] == 60.0


def test_times_and_lens_may_come_from_the_caller(folder: Path) -> None:
    camera = load_depth_recording(folder).camera
    (folder / "timestamps.csv").unlink()
    (folder / "intrinsics.json").unlink()
    with pytest.raises(ConfigError, match=r"timestamps\.csv"):
        load_depth_recording(folder, camera=camera)
    with pytest.raises(ConfigError, match=r"intrinsics\.json"):
        load_depth_recording(folder, rate_hz=30.0)
    recording = load_depth_recording(folder, camera=camera, rate_hz=100.0)
    assert recording.t_ns.tolist() == [0, 10_000_000, 30_000_000]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda path: (path / "color" / "000005.png").write_bytes(b"no picture"),
            "000005.png: empty, damaged or no picture",
        ),
        (lambda path: (path / "depth" / "000004.png").write_bytes(b""), "000004.png: empty, damaged or no picture"),
        (
            lambda path: cv2.imwrite(str(path / "depth" / "000004.png"), np.zeros((48, 64), np.uint8)),
            "16 bits.*uint8",
        ),
        (
            lambda path: cv2.imwrite(str(path / "depth" / "000004.png"), np.zeros((24, 32), np.uint16)),
            "32x24 pixels.*64x48",
        ),
        (
            lambda path: cv2.imwrite(str(path / "depth" / "000099.png"), np.zeros((48, 64), np.uint16)),
            "000099.png: has no picture",
        ),
        (lambda path: (path / "color" / "notes.png").write_bytes(b""), "notes.png: a picture's name"),
        (lambda path: (path / "color" / "5.jpg").write_bytes(b""), "frame 5 is there twice"),
        (lambda path: (path / "timestamps.csv").write_text("frame,t_ns\n4,1\n5,2\n"), "no row for frame 7"),
        (
            lambda path: (path / "timestamps.csv").write_text("frame,t_ns\n4,1\n5,2\n6,3\n7,4\n"),
            "frame 6 has no picture",
        ),
        (lambda path: (path / "intrinsics.json").write_text("{"), "not JSON"),
        (lambda path: (path / "intrinsics.json").write_bytes(b"\xff\xff"), "cannot be read"),
        (
            lambda path: (path / "intrinsics.json").write_text(json.dumps(LENS | {"distortion": [0.1]})),
            "14 coefficients, not 1",
        ),
        (
            lambda path: (path / "intrinsics.json").write_text(json.dumps(LENS | {"K": [[0, 0, 1]] * 3})),
            "positive focal lengths",
        ),
    ],
)
def test_a_wrong_recording_is_named(folder: Path, change: Callable[[Path], object], message: str) -> None:
    change(folder)
    with pytest.raises(ConfigError, match=message):
        list(load_depth_recording(folder).frames())


def test_no_folder_and_no_pictures(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such folder"):
        load_depth_recording(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="holds no numbered pictures"):
        load_depth_recording(tmp_path)


class Clock:
    def __init__(self) -> None:
        self.ns = 0

    def now(self) -> int:
        return self.ns


def test_replay_keeps_the_recordings_pace_and_leaves_out_what_is_late(folder: Path) -> None:
    clock = Clock()
    source = RecordedDepthSource(lambda: load_depth_recording(folder), clock.now)
    source.open(5_000_000_000)
    assert source.read(0.0) is None
    clock.ns = 5_000_000_000
    first = source.read(0.0)
    assert first is not None
    assert (first.t_ns, first.index) == (5_000_000_000, 0)
    assert source.read(0.0) is None
    clock.ns = 5_025_000_000
    last = source.read(0.0)
    assert last is not None
    assert (last.t_ns, last.index) == (5_020_000_000, 2)
    assert source.finished
    assert source.read(0.0) is None
    source.close()
    source.close()


def test_replay_goes_round(folder: Path) -> None:
    clock = Clock()
    source = RecordedDepthSource(lambda: load_depth_recording(folder), clock.now, loop=True)
    source.open(0)
    times = []
    for clock.ns in range(0, 95_000_000, 5_000_000):
        frame = source.read(0.0)
        if frame is not None:
            times.append((frame.index, frame.t_ns))
    assert times == [(number, number * 10_000_000) for number in range(10)]
    assert not source.finished
