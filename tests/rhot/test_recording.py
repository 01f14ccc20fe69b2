from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot.offline import rig_timing
from rhot.recording import MarkerTrack, PictureTrack, VideoTrack, load_camera, load_recording, marker_track_frames
from rhot.rig import Rig, load_rig

HEADER = "frame,t_ns,marker,u,v\n"
THESIS = Path(__file__).parents[3] / "shared" / "data" / "thesis_rig"

RIG = """
[cameras.left]
[cameras.right]
position_m = [0.075, 0.0, 0.0]
[markers.thumb]
joint = "thumb_tip"
[markers.index]
joint = "index_tip"
"""


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    folder = tmp_path / "rig"
    folder.mkdir()
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    return load_rig(folder)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "recording"
    path.mkdir()
    return path


def write(path: Path, text: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def test_pictures_with_times_inside_or_beside_the_folder(folder: Path) -> None:
    for camera, table in (("left", "left/timestamps.csv"), ("right", "right.csv")):
        for frame in (3, 5, 10):
            write(folder / camera / f"{frame:06d}.jpg")
        write(folder / table, "frame,t_ns\n3,100000000\n5,200000000\n10,300000000\n")
    recording = load_recording(folder)
    assert list(recording.cameras) == ["left", "right"]
    assert recording.has_times
    recording.require_times()
    for track in recording.cameras.values():
        assert isinstance(track, PictureTrack)
        assert [file.name for file in track.files] == ["000003.jpg", "000005.jpg", "000010.jpg"]
        assert track.t_ns.tolist() == [100_000_000, 200_000_000, 300_000_000]


@pytest.mark.parametrize(("unit", "per_second"), [("milliseconds", 1_000), ("microseconds", 1_000_000)])
@pytest.mark.parametrize("rate_hz", [15, 30, 60, 120])
def test_times_in_another_unit_are_refused_by_its_name(folder: Path, unit: str, per_second: int, rate_hz: int) -> None:
    rows = "".join(f"{frame},{1_700_000_000 * per_second + frame * per_second // rate_hz}\n" for frame in range(9))
    for frame in range(9):
        write(folder / "left" / f"{frame:06d}.png")
    write(folder / "left" / "timestamps.csv", f"frame,t_ns\n{rows}")
    with pytest.raises(ConfigError, match=f"t_ns seem to be in {unit}: multiply"):
        load_recording(folder).require_times()


@pytest.mark.parametrize(
    "names",
    [("img_1.png", "img_2.png", "img_10.png"), ("1.bmp", "2.BMP", "10.bmp"), ("a-001.tif", "a-002.tiff", "a-010.tif")],
)
def test_pictures_as_other_programs_name_them(folder: Path, names: tuple[str, ...]) -> None:
    for name in names:
        write(folder / "left" / name)
    track = load_recording(folder).cameras["left"]
    assert isinstance(track, PictureTrack)
    assert [file.name for file in track.files] == list(names)
    assert track.frames.tolist() == [1, 2, 10]


def test_still_set_loads_without_times_and_is_refused_where_they_are_needed(folder: Path) -> None:
    write(folder / "left" / "000001.png")
    recording = load_recording(folder)
    assert not recording.has_times
    with pytest.raises(ConfigError, match=r"camera left has no times.*timestamps\.csv"):
        recording.require_times()


def test_video_with_times_and_other_files_ignored(folder: Path) -> None:
    write(folder / "left.mkv")
    write(folder / "left.csv", "frame,t_ns\n0,1000\n1,2000\n")
    write(folder / "masks.csv", "frame,thumb\n")
    write(folder / "notes" / "readme.txt")
    write(folder / ".cache" / "000000.jpg")
    track = load_recording(folder).cameras["left"]
    assert isinstance(track, VideoTrack)
    assert track.frames.tolist() == [0, 1]
    assert list(load_recording(folder).cameras) == ["left"]


def test_settings_reach_the_cameras(folder: Path) -> None:
    write(folder / "left" / "markers.csv", HEADER + "0,1000,thumb,1,2\n")
    write(folder / "recording.toml", 'notes = "desk"\n[cameras.left]\nexposure_s = 0.004\nreadout_s = 0.016\n')
    recording = load_recording(folder)
    assert recording.notes == "desk"
    assert recording.cameras["left"].timing.readout_s == 0.016


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,10,thumb,1,x\n", r"markers\.csv, line 2: v = 'x' is not a number"),
        ("0,10,thumb,nan,1\n", r"line 2: u = nan is not a pixel"),
        ("0,10,thumb,1e9,1\n", r"line 2: u = 1e9 is not a pixel"),
        ("0,1.5,thumb,1,1\n", r"line 2: t_ns = '1\.5' is not an integer"),
        ("0,-4,thumb,1,1\n", r"line 2: t_ns = -4 is out of range"),
        ("0,10,thumb,1\n", r"line 2: 4 values"),
        ("0,10,th umb,1,1\n", r"line 2: marker = 'th umb'"),
        ("0,10,thumb,1,1\n0,10,thumb,1,1\n", r"line 3: marker thumb occurs twice in frame 0"),
        ("1,10,thumb,1,1\n0,20,thumb,1,1\n", r"line 3: frame 0 follows frame 1"),
        ("0,10,thumb,1,1\n1,10,thumb,1,1\n", r"line 3: t_ns 10 is not later than 10"),
        ("0,10,thumb,1,1\n0,11,index,1,1\n", r"line 3: t_ns 11 differs from 10 in the same frame"),
        ("", r"holds a header and no rows"),
    ],
)
def test_wrong_marker_rows_are_named_by_file_and_line(folder: Path, rows: str, message: str) -> None:
    write(folder / "left" / "markers.csv", HEADER + rows)
    with pytest.raises(ConfigError, match=message):
        load_recording(folder)


def test_a_file_in_place_of_a_folder_is_told_apart(tmp_path: Path) -> None:
    for name, says in (("take.mcap", "rhot record --frames"), ("left.mp4", "one folder or video per camera")):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(ConfigError, match=says):
            load_recording(tmp_path / name)


@pytest.mark.parametrize("header", ["", "frame,t_ns,marker,x,y\n", "0,1,thumb,2,3\n"])
def test_wrong_header_is_line_1(folder: Path, header: str) -> None:
    write(folder / "left" / "markers.csv", header)
    with pytest.raises(ConfigError, match=r"line 1: the header must be frame,t_ns,marker,u,v"):
        load_recording(folder)


def test_binary_table_is_an_error_not_a_crash(folder: Path) -> None:
    (folder / "left").mkdir()
    (folder / "left" / "markers.csv").write_bytes(b"\xff\xfd\x00\x01" * 20)
    with pytest.raises(ConfigError, match="cannot be read"):
        load_recording(folder)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "holds no camera"),
        ({"left/timestamps.csv": "frame,t_ns\n0,1\n"}, "neither numbered pictures"),
        ({"left/IMG_one.jpg": ""}, "a picture's name ends in its frame number"),
        ({"left/a_1.jpg": "", "left/b_1.jpg": ""}, "frame 1 is there twice"),
        ({"left/1.jpg": "", "left/001.png": ""}, "frame 1 is there twice"),
        ({"left/1.jpg": "", "left.mp4": ""}, "camera left is there twice"),
        ({"left/1.jpg": "", "left/markers.csv": HEADER}, "both pictures and"),
        ({"left/1.jpg": "", "left.csv": "frame,t_ns\n1,5\n", "left/timestamps.csv": "frame,t_ns\n1,5\n"}, "keep one"),
        ({"left/1.jpg": "", "left/timestamps.csv": "frame,t_ns\n2,5\n"}, r"no row for .*1\.jpg"),
        ({"left/1.jpg": "", "left/timestamps.csv": "frame,t_ns\n1,5\n2,6\n"}, "frame 2 .* has no picture"),
        ({"left/1.jpg": "", "left/timestamps.csv": "frame,t_ns\n1,5\n1,6\n"}, "line 3: frame 1 follows frame 1"),
        ({"left/1.jpg": "", "recording.toml": "[cameras.lft]\n"}, r"cameras\.lft is not in this recording"),
        ({"left/1.jpg": "", "recording.toml": "[cameras.left]\nreadout_s = -1\n"}, r"cameras\.left\.readout_s"),
        ({"left/1.jpg": "", "recording.toml": "notes = \n"}, "not TOML"),
    ],
)
def test_wrong_folders_say_what_is_wrong(folder: Path, files: dict[str, str], message: str) -> None:
    for name, text in files.items():
        write(folder / name, text)
    with pytest.raises(ConfigError, match=message):
        load_recording(folder)


def test_missing_folder_and_missing_camera(folder: Path) -> None:
    with pytest.raises(ConfigError, match="no such recording folder"):
        load_recording(folder / "absent")
    with pytest.raises(ConfigError, match="camera left needs a folder of pictures or a video"):
        load_camera(folder / "absent", "left")


def test_marker_frames_come_merged_in_time_order(rig: Rig, folder: Path) -> None:
    write(folder / "left" / "markers.csv", HEADER + "0,1000,thumb,10,20\n0,1000,index,11.5,21\n2,3000,thumb,12,22\n")
    write(folder / "right" / "markers.csv", HEADER + "0,2000,thumb,5,20\n")
    frames = list(marker_track_frames(rig, load_recording(folder)))
    assert [(frame.camera, frame.t_ns, frame.frame, frame.seq) for frame in frames] == [
        ("left", 1000, 0, 0),
        ("right", 2000, 0, 0),
        ("left", 3000, 2, 1),
    ]
    assert (frames[0].markers["index"].u, frames[0].markers["index"].v) == (11.5, 21.0)
    assert (frames[0].width, frames[0].height) == (640, 480)
    assert frames[0].markers["thumb"].t_ns is None


def test_positions_outside_the_picture_are_no_measurements(rig: Rig, folder: Path) -> None:
    write(folder / "left" / "markers.csv", HEADER + "0,1000,thumb,-3,20\n0,1000,index,639.4,0\n1,2000,thumb,10,480\n")
    frames = marker_track_frames(rig, load_recording(folder))
    assert [sorted(frame.markers) for frame in frames] == [["index"], []]
    assert frames.outside == {"left": 2}


def test_rows_of_a_rolling_shutter_have_their_own_times(rig: Rig, folder: Path) -> None:
    write(folder / "left" / "markers.csv", HEADER + "0,1000000,thumb,10,0\n0,1000000,index,10,240\n")
    write(folder / "recording.toml", "[cameras.left]\nexposure_s = 0.004\nreadout_s = 0.016\n")
    (frame,) = marker_track_frames(rig, load_recording(folder))
    assert frame.markers["thumb"].t_ns == 1_000_000 + 2_000_000
    assert frame.markers["index"].t_ns == 1_000_000 + 8_000_000 + 2_000_000
    assert frame.t_ns == 1_000_000 + 8_000_000 + 2_000_000


def test_a_recording_that_states_no_timing_has_its_rig_s(folder: Path) -> None:
    timed = RIG.replace("[cameras.left]", "[cameras.left]\nexposure_s = 0.004\nreadout_s = 0.016")
    write(folder / "rig" / "rig.toml", timed)
    rig = load_rig(folder / "rig")
    write(folder / "take" / "left" / "markers.csv", HEADER + "0,1000000,thumb,10,240\n")
    (frame,) = marker_track_frames(rig, load_recording(folder / "take", rig_timing(rig)))
    assert frame.markers["thumb"].t_ns == 1_000_000 + 8_000_000 + 2_000_000
    write(folder / "take" / "recording.toml", "[cameras.left]\nexposure_s = 0.002\nreadout_s = 0.0\n")
    (frame,) = marker_track_frames(rig, load_recording(folder / "take", rig_timing(rig)))
    assert frame.t_ns == 1_000_000 + 1_000_000


@pytest.mark.parametrize(
    ("name", "rows", "message"),
    [
        ("left", "0,1,pinky,1,1\n", r"marker pinky is not in .*rig\.toml"),
        ("middle", "0,1,thumb,1,1\n", r"camera middle is not in .*rig\.toml"),
    ],
)
def test_names_that_the_rig_does_not_know(rig: Rig, folder: Path, name: str, rows: str, message: str) -> None:
    write(folder / name / "markers.csv", HEADER + rows)
    with pytest.raises(ConfigError, match=message):
        marker_track_frames(rig, load_recording(folder))


def test_pictures_are_not_marker_tracks(rig: Rig, folder: Path) -> None:
    write(folder / "left" / "000000.jpg")
    with pytest.raises(ConfigError, match="holds pictures, not marker tracks"):
        marker_track_frames(rig, load_recording(folder))


@pytest.mark.skipif(not THESIS.is_dir(), reason=f"real recordings are absent: {THESIS}")
def test_real_recordings_load_whole() -> None:
    recording = load_recording(THESIS / "recordings" / "hand_recovered")
    assert recording.holds_markers
    left = recording.cameras["left"]
    assert isinstance(left, MarkerTrack)
    assert len(left.uv) > 28_000
    assert set(left.markers) == {"thumb", "index", "middle", "ring", "little", "base"}
    # Nominal 30 frames a second, lost frames apart.
    assert np.median(np.diff(np.unique(left.t_ns))) == pytest.approx(1e9 / 30, rel=1e-3)
    boards = load_recording(THESIS / "chessboard")
    assert not boards.has_times
    assert isinstance(boards.cameras["left"], PictureTrack)
    assert len(boards.cameras["left"].files) == 15
