"""Pictures written while a rig runs: the folder is a recording, however the writing ended."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot.messages import decode, encode
from rhot.recording import PictureTrack, load_recording
from rhot.recording.camera_picture import CameraPicture
from rhot.recording.picture_folder import PictureFolder

JPEG = bytes(cv2.imencode(".jpg", np.zeros((4, 6, 3), np.uint8))[1])
START_NS = 1_700_000_000_000_000_000


def picture(camera: str, frame: int, t_ns: int, seq: int = 0) -> CameraPicture:
    return CameraPicture(t_ns=t_ns, seq=seq, camera=camera, frame=frame, exposure_s=0.004, readout_s=0.012, jpeg=JPEG)


def track(path: Path, camera: str = "left") -> PictureTrack:
    found = load_recording(path).cameras[camera]
    assert isinstance(found, PictureTrack)
    return found


def test_what_is_written_is_a_recording(tmp_path: Path) -> None:
    with PictureFolder(tmp_path / "take", "a note") as folder:
        assert not (tmp_path / "take").exists()
        for step, frame in enumerate((7, 8, 11)):
            folder.write(picture("left", frame, START_NS + step, seq=step))
        folder.write(picture("right", 3, START_NS, seq=5))
        folder.write(picture("right", 4, START_NS + 1, seq=7))
    recording = load_recording(tmp_path / "take")
    assert recording.notes == "a note"
    assert track(tmp_path / "take").frames.tolist() == [7, 8, 11]
    assert track(tmp_path / "take").t_ns.tolist() == [START_NS, START_NS + 1, START_NS + 2]
    assert track(tmp_path / "take", "right").timing.readout_s == 0.012
    assert [file.read_bytes() for file in track(tmp_path / "take").files] == [JPEG] * 3
    assert {name: (count.messages, count.lost) for name, count in folder.counts.items()} == {
        "left": (3, 0),
        "right": (2, 1),
    }


def test_a_rig_that_was_started_anew_goes_on_in_the_same_folder(tmp_path: Path) -> None:
    with PictureFolder(tmp_path / "take") as folder:
        for t_ns, frame in enumerate((100, 101, 0, 1, 5)):
            folder.write(picture("left", frame, START_NS + t_ns))
        folder.write(picture("left", 6, START_NS + 1))
    assert track(tmp_path / "take").frames.tolist() == [100, 101, 102, 103, 107]


def test_a_recorder_that_was_killed_leaves_a_recording(tmp_path: Path) -> None:
    folder = PictureFolder(tmp_path / "take")
    for step in range(3):
        folder.write(picture("left", step, START_NS + step))
    (tmp_path / "take" / "left" / "000003.jpg").write_bytes(JPEG)
    assert track(tmp_path / "take").frames.tolist() == [0, 1, 2]
    (tmp_path / "take" / "left" / "000004.jpg").write_bytes(JPEG)
    with pytest.raises(ConfigError, match=r"no row for .*000003\.jpg"):
        load_recording(tmp_path / "take")


def test_nothing_is_overwritten_and_a_full_disk_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="exists already"):
        PictureFolder(tmp_path)
    (tmp_path / "file").write_text("in the way")
    folder = PictureFolder(tmp_path / "file" / "take")
    with pytest.raises(ConfigError, match=r"cannot be written any more.*another disk"):
        folder.write(picture("left", 0, START_NS))


def test_a_picture_travels_whole() -> None:
    one = picture("left", 3, START_NS)
    assert decode(encode(one), CameraPicture) == one
    assert CameraPicture.model_validate_json(one.model_dump_json()) == one
