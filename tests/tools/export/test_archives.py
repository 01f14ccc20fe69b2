"""Files for archives, read back by libraries that are not ours and compared with the arrays they were made of."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hand_messages import object_pose

import rhot
from rhot.messages import Event, encode, encoding_of
from rhot.recording.mcap.writer import McapWriter
from rhot.recording.messages import RecordedMessages
from rhot.take import Take
from rhot_tools.recordings.export import export


@pytest.fixture(scope="module")
def recording(poses_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The known poses, and two marked moments."""
    file = tmp_path_factory.mktemp("marked") / "poses.mcap"
    messages = list(RecordedMessages(poses_recording))
    begin_ns = min(message.t_ns for key, message in messages if key.startswith("rhot/hand"))
    events = [
        Event(t_ns=begin_ns + ms * 1_000_000, label=label, source="mark") for ms, label in ((100, "go"), (250, "stop"))
    ]
    with McapWriter(file, now_ns=0) as mcap:
        for key, message in [*messages, *(("rhot/event", event) for event in events)]:
            mcap.write(key, encoding_of(type(message)), encode(message), message.t_ns, message.seq, message.t_ns)
    return file


@pytest.fixture(scope="module")
def take(recording: Path) -> Take:
    return rhot.load(recording).in_frame("stage")


def written(recording: Path, *options: str) -> None:
    done = CliRunner().invoke(export, [str(recording), *options])
    assert done.exit_code == 0, done.output


def test_nwb_is_read_by_pynwb(recording: Path, take: Take, tmp_path: Path) -> None:
    pynwb = pytest.importorskip("pynwb")
    pytest.importorskip("ndx_pose")
    file = tmp_path / "x.nwb"
    written(recording, "--nwb", str(file), "--bids-name", "sub-07_task-x")
    assert not pynwb.validate(path=str(file))
    with pynwb.NWBHDF5IO(str(file), "r") as opened:
        nwb = opened.read()
        # Archives refuse a file that does not say who was recorded.
        assert (nwb.subject.subject_id, nwb.subject.species) == ("07", "Homo sapiens")
        behavior = nwb.processing["behavior"]
        assert 1e9 * nwb.session_start_time.timestamp() == pytest.approx(take.start_ns, abs=1e3)
        for side, hand in take.hands.items():
            poses = behavior[f"hand_{side}"]
            assert list(poses.skeleton.nodes[:]) == list(hand.joint_names)
            for index, joint in enumerate(hand.joint_names):
                series = poses.pose_estimation_series[joint]
                np.testing.assert_array_equal(series.data[:], hand.positions[:, index])
                np.testing.assert_array_equal(series.timestamps[:], hand.t)
            np.testing.assert_array_equal(behavior[f"hand_{side}_angles"].data[:], hand.angles)
        events = nwb.get_events_table("events").to_dataframe()
        assert list(events.annotation) == ["go", "stop"]
        assert list(events.source) == [event.source for event in take.events]
        np.testing.assert_allclose(events.timestamp, [1e-9 * (e.t_ns - take.start_ns) for e in take.events])


def test_bids_has_the_numbers(recording: Path, take: Take, tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    for run in ("1", "2"):
        written(recording, "--bids", str(folder), "--bids-name", f"sub-07_ses-a_task-pose_run-{run}", "--fps", "50")
    motion = folder / "sub-07/ses-a/motion"
    stem = "sub-07_ses-a_task-pose_tracksys-RHOT_run-1"
    channels = [line.split("\t") for line in (motion / f"{stem}_channels.tsv").read_text().splitlines()]
    table = np.genfromtxt(motion / f"{stem}_motion.tsv", delimiter="\t", missing_values="n/a")
    names = [row[0] for row in channels[1:]]
    assert table.shape == (len(take.resampled(50.0).hands["left"]), len(names))
    tip = take.resampled(50.0).hands["left"].joint("index_tip")
    column = names.index("hand_left_index_tip_POS_x")
    np.testing.assert_allclose(table[:, column : column + 3], tip, rtol=1e-8, atol=1e-9, equal_nan=True)
    about = json.loads((motion / f"{stem}_motion.json").read_text())
    assert about["SamplingFrequency"] == 50.0
    assert about["MotionChannelCount"] == len(names)
    again = CliRunner().invoke(
        export, [str(recording), "--bids", str(folder), "--bids-name", "sub-07_ses-a_task-pose_run-1"]
    )
    assert "is there already" in str(again.exception)
    for option in ("--bids", "--nwb"):
        wrong = CliRunner().invoke(export, [str(recording), option, str(tmp_path / "wrong"), "--bids-name", "grasp"])
        assert "--bids-name grasp: write sub-01_task-grasp" in str(wrong.exception)
        assert not (tmp_path / "wrong").exists()


def test_mat_is_read_by_scipy(recording: Path, take: Take, tmp_path: Path) -> None:
    scipy_io = pytest.importorskip("scipy.io")
    file = tmp_path / "x.mat"
    written(recording, "--mat", str(file))
    found: Any = scipy_io.loadmat(file, squeeze_me=True, struct_as_record=False)
    for side, hand in take.hands.items():
        struct = getattr(found["hand"], side)
        np.testing.assert_array_equal(struct.positions, hand.positions)
        np.testing.assert_array_equal(struct.angles, hand.angles)
        assert list(struct.joint_names) == list(hand.joint_names)
        assert list(struct.state) == list(hand.state)
    assert list(found["events"].label) == ["go", "stop"]
    assert found["start_ns"] == take.start_ns


def test_netcdf_is_read_by_xarray(recording: Path, take: Take, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    file = tmp_path / "x.nc"
    written(recording, "--netcdf", str(file))
    with xarray.open_dataset(file, group="hands", engine="h5netcdf") as data:
        for side, hand in take.hands.items():
            found = data.position.sel(individuals=side, keypoints="little_tip").values
            rows = np.searchsorted(data.t_ns.values, hand.t_ns)
            np.testing.assert_array_equal(found[rows], hand.joint("little_tip"))


@pytest.mark.parametrize("option", ["--mat", "--bids"])
def test_an_empty_recording_has_nothing_for_archives(tmp_path: Path, option: str) -> None:
    file = tmp_path / "empty.jsonl"
    file.write_text("")
    done = CliRunner().invoke(export, [str(file), option, str(tmp_path / "x")])
    assert f"{option}: the recording holds no hand, point, object, foot or body" in str(done.exception)


def test_a_time_of_another_year_is_told_instead_of_filling_the_memory(tmp_path: Path) -> None:
    file = tmp_path / "late.mcap"
    with McapWriter(file, now_ns=0) as writer:
        for t_ns in (10**18, 10**18 + 30_000_000_000_000_000):
            pose = object_pose(t_ns, 0.1)
            writer.write("rhot/object/cup", encoding_of(type(pose)), encode(pose), t_ns, 0, t_ns)
    done = CliRunner().invoke(export, [str(file), "--bids", str(tmp_path / "d"), "--fps", "50"])
    assert "8333.3 h apart, 1500000001 frames at 50.0 Hz; 5000000 are the most" in str(done.exception)
    assert not (tmp_path / "d").exists()


def test_c3d_has_the_events(recording: Path, take: Take, tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    file = tmp_path / "x.c3d"
    written(recording, "--c3d", str(file))
    events = ezc3d.c3d(str(file))["parameters"]["EVENT"]
    assert events["LABELS"]["value"] == ["go", "stop"]
    assert events["USED"]["value"].tolist() == [2]
    first_ns = min(int(track.t_ns[0]) for track in take.tracks.values())
    seconds = [1e-9 * (event.t_ns - first_ns) for event in take.events]
    np.testing.assert_allclose(60.0 * events["TIMES"]["value"][0] + events["TIMES"]["value"][1], seconds, atol=1e-4)
