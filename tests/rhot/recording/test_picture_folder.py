"""Pictures written while a rig runs: the folder is a recording, however the writing ended."""

from __future__ import annotations

from collections.abc import Callable
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


def test_a_rig_that_was_restarted_goes_on_in_the_same_folder(tmp_path: Path) -> None:
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
    assert track(tmp_path / "take").frames.tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("damage", "frames"),
    [
        (lambda left: (left / "000004.jpg").write_bytes(b""), [0, 1, 2, 3]),
        (lambda left: [(left / f"00000{n}.jpg").unlink() for n in (3, 4)], [0, 1, 2]),
        (lambda left: (left / "timestamps.csv").write_bytes((left / "timestamps.csv").read_bytes()[:-9]), [0, 1, 2, 3]),
        (lambda left: (left / "timestamps.csv").write_bytes(b"frame,t_ns\n0,5\n"), [0]),
    ],
)
def test_what_a_power_cut_leaves_is_a_recording(
    tmp_path: Path, damage: Callable[[Path], object], frames: list[int]
) -> None:
    folder = PictureFolder(tmp_path / "take")
    for step in range(5):
        folder.write(picture("left", step, START_NS + step))
    folder.sync()
    damage(tmp_path / "take" / "left")
    assert track(tmp_path / "take").frames.tolist() == frames


def test_a_recording_that_was_ended_must_be_whole(tmp_path: Path) -> None:
    with PictureFolder(tmp_path / "take") as folder:
        for step in range(5):
            folder.write(picture("left", step, START_NS + step))
    (tmp_path / "take" / "left" / "000003.jpg").unlink()
    with pytest.raises(ConfigError, match=r"frame 3 .* has no picture"):
        load_recording(tmp_path / "take")


FOREIGN = ("..", ".", ".hidden", "recording.toml", "left.csv", "right.mp4")


def test_strangers_names_neither_end_a_recording_nor_leave_its_folder(tmp_path: Path) -> None:
    with PictureFolder(tmp_path / "take") as folder:
        for step in range(5):
            for camera in ("left", *FOREIGN, "cam.front.1"):
                folder.write(picture(camera, step, START_NS + step, seq=step))
        for stranger in range(200):
            folder.write(picture(f"x{stranger}", 0, START_NS))
    assert [file.name for file in tmp_path.iterdir()] == ["take"]
    recording = load_recording(tmp_path / "take")
    assert len(recording.cameras) == 64
    assert {"left", "cam.front.1"} < set(recording.cameras)
    assert recording.cameras["cam.front.1"].timing.exposure_s == 0.004
    assert len(track(tmp_path / "take").frames) == 5
    assert folder.refused == 5 * len(FOREIGN) + 200 - 62


def test_a_note_may_hold_anything(tmp_path: Path) -> None:
    note = 'messages: a "take"\\ of \n[cameras.x]'
    with PictureFolder(tmp_path / "take", note) as folder:
        folder.write(picture("left", 0, START_NS))
    assert load_recording(tmp_path / "take").notes == note


@pytest.mark.parametrize("place", range(4))
def test_a_stamp_from_the_future_costs_itself_alone(tmp_path: Path, place: int) -> None:
    with PictureFolder(tmp_path / "take") as folder:
        for step in range(50):
            if step == place:
                folder.write(picture("left", 3, START_NS + 10**15, seq=step), step * 10**7)
            else:
                folder.write(picture("left", step, START_NS + step * 10**7, seq=step), step * 10**7)
    assert len(track(tmp_path / "take").frames) == 49
    assert folder.counts["left"].left_out == 1
    assert folder.counts["left"].lost == 0


def test_pictures_that_are_not_recorded_are_counted(tmp_path: Path) -> None:
    with PictureFolder(tmp_path / "take") as folder:
        for t_ns in (5, 6, 4, 6, 7):
            folder.write(picture("left", 0, START_NS + t_ns))
        folder.write(picture("left", 9, START_NS + 9).model_copy(update={"jpeg": b"no picture"}))
    assert folder.counts["left"].left_out == 3


def test_few_pictures_are_recorded_when_the_recording_ends(tmp_path: Path) -> None:
    with PictureFolder(tmp_path / "take") as folder:
        folder.write(picture("left", 0, START_NS), 0)
        folder.write(picture("left", 1, START_NS + 10**7), 10**7)
        folder.write(picture("right", 1, START_NS + 10**15), 10**7)
        folder.write(picture("right", 0, START_NS), 0)
    assert track(tmp_path / "take").t_ns.tolist() == [START_NS, START_NS + 10**7]
    assert track(tmp_path / "take", "right").t_ns.tolist() == [START_NS]


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
