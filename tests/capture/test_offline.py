from __future__ import annotations

import shutil
import struct
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
from rhot_calibration.cameras.pictures import read_gray
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


def test_what_a_picture_says_of_its_orientation_changes_nothing(recorded: tuple[Path, Path]) -> None:
    """A phone's EXIF tag; a calibration reads the sensor's rows, too."""
    rig, recording = recorded
    for file in recording.rglob("*.png"):
        image = np.asarray(cv2.imread(str(file)))
        jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
        # APP1 with one entry: orientation (0x0112), SHORT, 6 = turn by 90 degrees to the right.
        exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
        tag = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
        file.with_suffix(".jpg").write_bytes(jpeg[:2] + tag + jpeg[2:])
        turned = cv2.imread(str(file.with_suffix(".jpg")))
        assert turned is not None and turned.shape == (160, 120, 3), "OpenCV obeys the tag unless told otherwise"
        file.unlink()
    first = next(iter(marker_frames(load_rig(rig), load_recording(recording))))
    assert first.markers["ring"].u == pytest.approx(40.25, abs=0.3)
    gray = read_gray(recording / "left" / "000000.jpg")
    assert gray is not None
    assert gray.shape == (120, 160)


def as_videos(recording: Path, suffix: str, frames: int = 12) -> None:
    for name in ("left", "right"):
        image = np.asarray(cv2.imread(str(recording / name / "000000.png")))
        codec = "mp4v" if suffix in (".mp4", ".mov") else "MJPG"
        writer = cv2.VideoWriter(str(recording / f"{name}{suffix}"), cv2.VideoWriter.fourcc(*codec), 50.0, (160, 120))
        for _ in range(frames):
            writer.write(image)
        writer.release()
        rows = "".join(f"{number},{10**9 + 20_000_000 * number}\n" for number in range(frames))
        (recording / f"{name}.csv").write_text(f"frame,t_ns\n{rows}")
        shutil.rmtree(recording / name)


@pytest.mark.parametrize("suffix", [".mov", ".mp4", ".avi", ".mkv"])
def test_a_row_too_many_costs_no_video_its_result(
    recorded: tuple[Path, Path], suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    rig, recording = recorded
    as_videos(recording, suffix)
    with (recording / "left.csv").open("a") as table:
        table.write(f"12,{10**9 + 240_000_000}\n13,{10**9 + 260_000_000}\n")
    frames = marker_frames(load_rig(rig), load_recording(recording))
    first = next(frames)
    assert "left" + suffix in caplog.text, "told before anything is tracked"
    assert "ends after 12 frames, its times go on to frame 13" in caplog.text
    found = [first, *frames]
    assert [sum(frame.camera == name for frame in found) for name in ("left", "right")] == [12, 12]
    assert caplog.text.count("ends after") == 1


def test_what_a_video_says_of_its_orientation_changes_nothing(recorded: tuple[Path, Path]) -> None:
    rig, recording = recorded
    as_videos(recording, ".mp4")
    for file in recording.glob("*.mp4"):
        content = bytearray(file.read_bytes())
        # The matrix of the track header box (ISO 14496-12, 8.3.2): 90 degrees, as a phone held upright writes it.
        at = content.index(b"tkhd") + 4 + 4 + 20 + 8 + 8
        content[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 120 << 16, 0, 1 << 30)
        file.write_bytes(content)
    capture = cv2.VideoCapture(str(recording / "left.mp4"))
    turned = capture.read()[1]
    capture.release()
    assert turned.shape == (160, 120, 3), "OpenCV obeys the matrix unless told otherwise"
    frames = list(marker_frames(load_rig(rig), load_recording(recording)))
    assert len(frames) == 24
    assert frames[0].markers["ring"].u == pytest.approx(40.25, abs=1.0)


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
