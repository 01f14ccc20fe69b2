from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rhot.errors import CalibrationError, ConfigError
from rhot.recording import load_recording
from rhot.rig import load_rig, write_json_model
from rhot.rig.colors import nominal_colors
from rhot_capture.offline import marker_frames

CAMERA = "width = 160\nheight = 120\n"


@pytest.fixture
def recorded(write_rig: Callable[..., Path], scene: Any, shape: Any, paints: Any, tmp_path: Path) -> tuple[Path, Path]:
    """A rig and a recording of two cameras out of step: left at 0, 20 ms, right at 10, 30 ms."""
    rig = write_rig({"left": CAMERA, "right": CAMERA})
    write_json_model(rig / "colors.json", nominal_colors(paints))
    recording = tmp_path / "recording"
    for name, shift, first_ns in (("left", 0, 1_000_000_000), ("right", 30, 1_010_000_000)):
        (recording / name).mkdir(parents=True)
        for number in range(2):
            image = scene([shape("ring", 40.25 + shift + 5 * number, 60.5)], size=(160, 120)).image
            cv2.imwrite(str(recording / name / f"{number:06d}.png"), image)
        rows = "".join(f"{number},{first_ns + 20_000_000 * number}\n" for number in range(2))
        (recording / name / "timestamps.csv").write_text("frame,t_ns\n" + rows)
    (recording / "recording.toml").write_text("[cameras.right]\nexposure_s = 0.004\nreadout_s = 0.0119\n")
    return rig, recording


def test_cameras_are_merged_in_time_and_markers_found(recorded: tuple[Path, Path]) -> None:
    rig, recording = recorded
    done: list[int] = []
    frames = list(marker_frames(load_rig(rig), load_recording(recording), done.append))
    assert [frame.camera for frame in frames] == ["left", "right", "left", "right"]
    assert [frame.frame for frame in frames] == [0, 0, 1, 1]
    assert done == [1, 2, 3, 4]
    for frame, u in zip(frames, (40.25, 70.25, 45.25, 75.25), strict=True):
        assert frame.markers["ring"].u == pytest.approx(u, abs=0.1)
        assert frame.markers["ring"].v == pytest.approx(60.5, abs=0.1)


def test_times_are_those_of_the_rows(recorded: tuple[Path, Path]) -> None:
    rig, recording = recorded
    left, right, *_ = marker_frames(load_rig(rig), load_recording(recording))
    assert (left.t_ns, left.markers["ring"].t_ns) == (1_000_000_000, None)
    assert right.t_ns == 1_010_000_000 + 2_000_000 + 5_950_000
    row_ns = right.markers["ring"].t_ns
    assert row_ns is not None
    assert row_ns - 1_012_000_000 == pytest.approx(100_000 * right.markers["ring"].v, abs=2)


def test_missing_colours_are_an_error(recorded: tuple[Path, Path]) -> None:
    rig, recording = recorded
    (rig / "colors.json").unlink()
    with pytest.raises(CalibrationError, match=r"colors\.json"):
        next(iter(marker_frames(load_rig(rig), load_recording(recording))))


def test_an_unknown_camera_is_an_error(recorded: tuple[Path, Path]) -> None:
    rig, recording = recorded
    (recording / "right").rename(recording / "middle")
    (recording / "recording.toml").unlink()
    with pytest.raises(ConfigError, match=r"camera middle is not in .*left, right"):
        next(iter(marker_frames(load_rig(rig), load_recording(recording))))


def test_pictures_of_another_size_are_an_error(recorded: tuple[Path, Path]) -> None:
    rig, recording = recorded
    cv2.imwrite(str(recording / "left" / "000000.png"), np.zeros((60, 80, 3), np.uint8))
    with pytest.raises(ConfigError, match=r"80x60.*160x120"):
        list(marker_frames(load_rig(rig), load_recording(recording)))
