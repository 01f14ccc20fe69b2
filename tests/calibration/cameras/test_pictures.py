from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from boards.pictures import board_picture

from rhot.errors import CalibrationError, ConfigError
from rhot_calibration.cameras.board.grid import parse_board
from rhot_calibration.cameras.calibration import refuse_other_board
from rhot_calibration.cameras.pictures import read_pictures

BOARD = parse_board("9x6", 0.025)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two cameras with three pictures each; the third shows nothing."""
    folder = tmp_path / "recording"
    for camera, turn in (("left", 0.0), ("right", 20.0)):
        (folder / camera).mkdir(parents=True)
        for number in (1, 2):
            picture, _ = board_picture(BOARD, tilt_deg=(5.0 * number, 10.0, turn))
            cv2.imwrite(str(folder / camera / f"{number:06d}.png"), picture)
        cv2.imwrite(str(folder / camera / "000003.png"), np.full((480, 640), 60, np.uint8))
    return folder


def test_views_by_camera_and_number(recording: Path) -> None:
    heard: list[tuple[int, int]] = []
    reading = read_pictures(recording, BOARD, ("right", "left"), lambda done, total: heard.append((done, total)))
    assert list(reading.views.sizes.items()) == [("right", (640, 480)), ("left", (640, 480))]
    assert sorted(reading.views.views) == [("left", 1), ("left", 2), ("right", 1), ("right", 2)]
    assert reading.views.empty == ("right/000003.png", "left/000003.png")
    assert reading.problems == {"right/000003.png": "board not found", "left/000003.png": "board not found"}
    assert heard == [(done, 6) for done in range(1, 7)]


@pytest.mark.parametrize("harm", ["empty", "cut", "text"])
def test_a_broken_file_is_left_out_by_name(recording: Path, harm: str) -> None:
    file = recording / "left" / "000002.png"
    data = file.read_bytes()
    file.write_bytes({"empty": b"", "cut": data[: len(data) // 2], "text": b"not a picture"}[harm])
    reading = read_pictures(recording, BOARD, ("left", "right"))
    assert ("left", 2) not in reading.views.views
    assert ("left", 2) in reading.views.labels
    assert "damaged" in reading.problems["left/000002.png"]


def test_a_cut_off_jpeg_is_left_out(recording: Path, shared_data: Path) -> None:
    data = (shared_data / "thesis_rig" / "chessboard" / "left" / "000001.jpg").read_bytes()
    (recording / "left" / "000009.jpg").write_bytes(data[: int(0.9 * len(data))])
    reading = read_pictures(recording, BOARD, ("left", "right"))
    assert "damaged" in reading.problems["left/000009.jpg"]


def test_unusable_recordings_are_refused(recording: Path) -> None:
    with pytest.raises(CalibrationError, match="no camera left, only middle, right"):
        read_pictures(recording, BOARD, ("middle", "right"))
    with pytest.raises(CalibrationError, match="no pictures of camera third"):
        read_pictures(recording, BOARD, ("left", "right", "third"))
    with pytest.raises(CalibrationError, match=r"640x480 pixels, rig\.toml says 1280x720"):
        read_pictures(recording, BOARD, ("left", "right"), sizes={"left": (1280, 720)})
    with pytest.raises(ConfigError, match="no such recording"):
        read_pictures(recording / "nowhere", BOARD, ("left", "right"))
    cv2.imwrite(str(recording / "left" / "000004.png"), np.zeros((240, 320), np.uint8))
    with pytest.raises(CalibrationError, match=r"left/000004\.png is 320x240 pixels, other pictures .* 640x480"):
        read_pictures(recording, BOARD, ("left", "right"))
    for file in (recording / "left").iterdir():
        file.write_bytes(b"")
    with pytest.raises(CalibrationError, match="not one picture of camera left"):
        read_pictures(recording, BOARD, ("left", "right"))


def test_a_large_set_without_the_board_warns_early(tmp_path: Path) -> None:
    nothing = np.full((480, 640), 60, np.uint8)
    for camera in ("left", "right"):
        (tmp_path / camera).mkdir()
        for number in range(40):
            cv2.imwrite(str(tmp_path / camera / f"{number:06d}.png"), nothing)
    done, warnings = [0], []
    read_pictures(
        tmp_path,
        BOARD,
        ("left", "right"),
        lambda number, _: done.append(number),
        warn=lambda text: warnings.append((done[-1], text)),
    )
    assert done[-1] == 80
    ((at, text),) = warnings
    assert at <= 24
    assert "do not show chessboard of 9x6" in text
    assert "--board CxR" in text


def test_a_board_late_in_the_set_is_found_without_a_warning(tmp_path: Path) -> None:
    shown, _ = board_picture(BOARD, tilt_deg=(5.0, 10.0, 0.0))
    for camera in ("left", "right"):
        (tmp_path / camera).mkdir()
        for number in range(40):
            picture = shown if camera == "right" and number >= 30 else np.full_like(shown, 60)
            cv2.imwrite(str(tmp_path / camera / f"{number:06d}.png"), picture)
    reading = read_pictures(tmp_path, BOARD, ("left", "right"), warn=pytest.fail)
    assert list(reading.views.views) == [("right", number) for number in range(30, 40)]
    assert next(iter(reading.problems)) == "left/000000.png"


def test_marker_tracks_are_refused(shared_data: Path) -> None:
    with pytest.raises(ConfigError, match="2D marker tracks"):
        read_pictures(shared_data / "thesis_rig" / "recordings" / "hand_recovered", BOARD, ("left", "right"))


def test_a_wrong_count_is_explained(recording: Path) -> None:
    reading = read_pictures(recording, parse_board("8x6", 0.025), ("left", "right"))
    assert not reading.views.views
    assert reading.likely_count == (9, 6)
    assert "shows 9x6 inner corners, not 8x6" in " ".join(reading.problems.values())


@pytest.mark.parametrize(
    ("shown", "stated", "says"),
    [
        (("9x6", 0.018, "5X5_100"), ("9x6", 0.018, "4X4_50"), "--dictionary DICT_5X5_"),
        (
            ("9x6", 0.018, "5X5_100"),
            ("9x6", 0.015, "5X5_100"),
            r"measure about 1[78]\.\d mm.*call again with --marker-mm",
        ),
        (
            ("9x6", 0.015, "5X5_100"),
            ("9x6", 0.018, "5X5_100"),
            r"measure about 1[45]\.\d mm.*call again with --marker-mm",
        ),
        (("9x6", 0.018, "4X4_50"), ("7x5", None, "4X4_50"), "--dictionary DICT_4X4_50 and --marker-mm"),
    ],
)
def test_options_of_a_charuco_board_are_named_within_seconds(
    tmp_path: Path, shown: tuple[str, float, str], stated: tuple[str, float | None, str], says: str
) -> None:
    """Two hundred pictures, of which a few tell."""
    picture, _ = board_picture(parse_board(shown[0], 0.025, *shown[1:]))
    content = cv2.imencode(".png", picture)[1].tobytes()
    for camera in ("left", "right"):
        (tmp_path / camera).mkdir()
        for number in range(100):
            (tmp_path / camera / f"{number:06d}.png").write_bytes(content)
    begun = time.process_time()
    reading = read_pictures(tmp_path, parse_board(stated[0], 0.025, *stated[1:]), ("left", "right"))
    assert time.process_time() - begun < 15.0
    with pytest.raises(CalibrationError, match=says):
        refuse_other_board(reading)


def test_a_charuco_board_that_is_stated_right_needs_no_hint(tmp_path: Path) -> None:
    board = parse_board("9x6", 0.025, 0.018)
    for camera in ("left", "right"):
        (tmp_path / camera).mkdir()
        picture, _ = board_picture(board, tilt_deg=(25.0, -20.0, 10.0))
        cv2.imwrite(str(tmp_path / camera / "000000.png"), picture)
    assert read_pictures(tmp_path, board, ("left", "right")).hint == ""


def test_a_mirrored_charuco_picture_is_named(recording: Path) -> None:
    board = parse_board("9x6", 0.025, 0.018)
    picture, _ = board_picture(board)
    for file in recording.rglob("*.png"):
        cv2.imwrite(str(file), picture if file.parent.name == "left" else np.ascontiguousarray(picture[:, ::-1]))
    reading = read_pictures(recording, board, ("left", "right"))
    assert {camera for camera, _ in reading.views.views} == {"left"}
    assert reading.mirrored == tuple(f"right/{number:06d}.png" for number in (1, 2, 3))


def test_videos_are_sampled_at_the_same_frames(tmp_path: Path) -> None:
    picture, _ = board_picture(BOARD)
    colour = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    blank = np.full_like(colour, 60)
    for camera, length in (("left", 70), ("right", 68)):
        writer = cv2.VideoWriter(str(tmp_path / f"{camera}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (640, 480))
        for number in range(length):
            writer.write(colour if number in (8, 9, 64) else blank)
        writer.release()
    reading = read_pictures(tmp_path, BOARD, ("left", "right"))
    assert sorted(reading.views.views) == [("left", 8), ("left", 64), ("right", 8), ("right", 64)]
    (tmp_path / "left.avi").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"left\.avi: cannot be read as a video"):
        read_pictures(tmp_path, BOARD, ("left", "right"))
