"""`rhot.load`: what messages say, as arrays; every number compared with the message itself."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hand_messages import hand_pose, marker_frame, object_pose, point_set

import rhot
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.errors import ConfigError
from rhot.messages import BodyPose, Event, FootPose, HandPose, Message, Space, encode, encoding_of
from rhot.messages.tracked import BodyJoint, BoxShape
from rhot.recording.mcap.writer import McapWriter, rig_files
from rhot.recording.messages import RecordedMessages
from rhot.take.payloads import PayloadColumns
from rhot.take.reading import take_of

START_NS = 1_790_000_000_123_456_789
STEP_NS = 8_333_333
COUNT = 40
BOX = BoxShape(size=(0.1, 0.06, 0.065))


def foot(t_ns: int, **changes: Any) -> FootPose:
    values = {
        "side": "left",
        "frame": "rig",
        "position": (0.1, 0.2, 0.3),
        "orientation": (0.0, 0.0, 0.0, 1.0),
        "velocity": (0.5, 0.0, -0.5),
        "sigma": 0.004,
        "stage": "marker",
        "state": "measured",
    }
    return FootPose.model_validate({"t_ns": t_ns, **values, **changes})


def body(t_ns: int) -> BodyPose:
    joint = BodyJoint(position=(0.0, 1.0, 0.1), orientation=(0.0, 0.0, 0.0, 1.0))
    return BodyPose(
        t_ns=t_ns, frame="rig", joints={"hips": joint, "left_knee": joint}, angles={}, legs={}, state="measured"
    )


def session() -> list[tuple[str, Message]]:
    """A second of a rig: a hand of which a finger comes and goes, and everything else."""
    messages: list[tuple[str, Message]] = []
    T = ((0.0, -1.0, 0.0, 0.5), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1.0), (0.0, 0.0, 0.0, 1.0))
    messages.append(("rhot/space/stage", Space(t_ns=START_NS, T_rig_space=T, source="desk board")))
    for index in range(COUNT):
        t_ns = START_NS + index * STEP_NS
        hand = hand_pose(0.1 * index, t_ns)
        fingers = dict(hand.fingers)
        if index % 3 == 0:
            fingers["ring"] = "predicted"
        sigma = {"index_tip": 0.001 * index} if index >= 5 else {}
        hand = hand.model_copy(update={"seq": index, "fingers": fingers, "sigma": sigma})
        points = point_set(t_ns, *(("index", "thumb") if index % 2 else ("index",)))
        messages += [
            ("rhot/hand/right", hand),
            ("rhot/points", points.model_copy(update={"seq": index})),
            ("rhot/object/cube", object_pose(t_ns, 0.1).model_copy(update={"shape": BOX})),
            ("rhot/foot/left", foot(t_ns, stage="inertial" if index > 20 else "marker")),
            ("rhot/body", body(t_ns)),
            ("rhot/markers/left", marker_frame("left", t_ns)),
        ]
    messages.append(("rhot/event", Event(t_ns=START_NS + 5 * STEP_NS, label="grasp", source="mark")))
    return messages


def write_mcap(file: Path, messages: Sequence[tuple[str, Message]], rig: Path | None = None) -> Path:
    with McapWriter(file, now_ns=START_NS, attachments=None if rig is None else rig_files(rig)) as mcap:
        for key, message in messages:
            mcap.write(key, encoding_of(type(message)), encode(message), message.t_ns, message.seq, message.t_ns)
    return file


def write_lines(file: Path, messages: Sequence[tuple[str, Message]]) -> Path:
    lines = [json.dumps({"key": key, "value": json.loads(m.model_dump_json(exclude_none=True))}) for key, m in messages]
    file.write_text("\n".join(lines) + "\n")
    return file


@pytest.mark.parametrize("kind", ["mcap", "jsonl"])
def test_every_number_is_that_of_the_message(tmp_path: Path, kind: str) -> None:
    messages = session()
    file = tmp_path / f"take.{kind}"
    take = rhot.load((write_mcap if kind == "mcap" else write_lines)(file, messages))
    hand = take.hands["right"]
    hands = [message for _, message in messages if isinstance(message, HandPose)]
    assert hand.t_ns.tolist() == [message.t_ns for message in hands]
    assert hand.joint_names == JOINTS
    for row, message in enumerate(hands):
        for column, name in enumerate(JOINTS):
            joint = message.joints[name]
            assert tuple(hand.positions[row, column]) == joint.position
            assert tuple(hand.orientations[row, column]) == joint.orientation
            assert hand.radii[row, column] == joint.radius
        assert hand.angle("thumb_ip_flexion")[row] == message.angles["thumb"].dip_flexion
        assert hand.angle("index_mcp_abduction")[row] == message.angles["index"].mcp_abduction
        assert hand.finger_states[row].tolist() == [message.fingers[finger] for finger in FINGERS]
        assert hand.residuals[row, 1] == message.residual["index"]
        np.testing.assert_equal(hand.sigma[row, JOINTS.index("index_tip")], message.sigma.get("index_tip", np.nan))
    assert np.isnan(hand.residuals[:, 0]).all()
    assert set(hand.state) == {"measured"}
    thumb = take.points["thumb"]
    assert len(thumb) == COUNT
    assert np.isnan(thumb.positions[::2]).all()
    assert (thumb.positions[1::2] == (0.01, -0.02, 0.6)).all()
    assert thumb.state[:2].tolist() == ["", "measured"]
    assert thumb.views[:2].tolist() == [0, 2]
    assert take.objects["cube"].shape == BOX
    assert take.feet["left"].stage[[20, 21]].tolist() == ["marker", "inertial"]
    assert take.feet["left"].velocities[0].tolist() == [0.5, 0.0, -0.5]
    assert take.body is not None
    assert take.body.joint_names == ("hips", "left_knee")
    assert take.head is None
    assert [(event.label, event.t_ns) for event in take.events] == [("grasp", START_NS + 5 * STEP_NS)]
    left = take.markers["left"]
    assert left.marker_names == ("index", "thumb")
    assert (left.uv == (320.25, 240.5)).all()
    assert take.invalid == 0


def test_times_count_from_the_first_sample_of_anything(tmp_path: Path) -> None:
    messages = [("rhot/points", point_set(START_NS)), ("rhot/hand/right", hand_pose(0.0, START_NS + 10**9))]
    take = rhot.load(write_mcap(tmp_path / "take.mcap", messages))
    assert take.hands["right"].t.tolist() == [1.0]


def test_arrays_cannot_be_written(tmp_path: Path) -> None:
    take = rhot.load(write_mcap(tmp_path / "take.mcap", session()))
    with pytest.raises(ValueError, match="read-only"):
        take.hands["right"].positions[0] = 0.0


def test_a_take_prints_as_a_summary_and_compares(tmp_path: Path) -> None:
    file = write_mcap(tmp_path / "take.mcap", session())
    take, again = rhot.load(file), rhot.load(file)
    lines = repr(take).splitlines()
    assert lines[0] == f"<Take in frame rig, {len(take.events)} events>"
    assert lines[1].startswith("  <HandTrack hand/right: 40 samples in 0.3 s, ")
    assert len(lines) == 1 + len(take.tracks)
    assert repr(take.hands["right"]) in repr(take)
    assert len({take, again, take}) == 2
    assert take.hands["right"] != again.hands["right"]


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(tmp_path: Path, rate_hz: float) -> None:
    take = rhot.load(write_mcap(tmp_path / "take.mcap", session()))
    with pytest.raises(ValueError, match="rate_hz must be a positive number"):
        take.resampled(rate_hz)


def test_more_samples_than_fit_are_told_instead_of_filling_the_memory(tmp_path: Path) -> None:
    take = rhot.load(write_mcap(tmp_path / "take.mcap", session()))
    with pytest.raises(ConfigError, match=r"\d+ frames at 1000000000\.0 Hz; 5000000 are the most"):
        take.resampled(1e9)
    late = [("rhot/object/cup", object_pose(START_NS + year * 30_000_000_000_000_000, 0.1)) for year in (0, 1)]
    with pytest.raises(ConfigError, match=r"8333\.3 h apart"):
        rhot.load(write_mcap(tmp_path / "late.mcap", late)).resampled(100.0)


def test_a_take_comes_from_another_process_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "a.mcap"
    write_mcap(file, session())
    take = rhot.load(file)
    again = pickle.loads(pickle.dumps(take))
    np.testing.assert_array_equal(again.hands["right"].positions, take.hands["right"].positions)
    assert again.markers.keys() == take.markers.keys()
    assert (again.rig is None) == (take.rig is None)
    with pytest.raises(ValueError, match="read-only"):
        again.hands["right"].positions[0] = 0.0
    assert pickle.loads(pickle.dumps(take_of(iter(RecordedMessages(file))))).markers.keys() == take.markers.keys()


def test_of_one_moment_the_last_message_counts_and_order_is_that_of_time(tmp_path: Path) -> None:
    late, early = hand_pose(0.2, START_NS + 100), hand_pose(0.1, START_NS)
    again = hand_pose(0.3, START_NS)
    messages = [("rhot/hand/right", message) for message in (late, early, again)]
    hand = rhot.load(write_mcap(tmp_path / "take.mcap", messages)).hands["right"]
    assert hand.t_ns.tolist() == [START_NS, START_NS + 100]
    assert tuple(hand.joint("wrist")[0]) == again.joints["wrist"].position


def test_another_frame_and_back(tmp_path: Path) -> None:
    take = rhot.load(write_mcap(tmp_path / "take.mcap", session()))
    stage = take.in_frame("stage")
    here, there = take.hands["right"], stage.hands["right"]
    # T_rig_stage of `session`: a quarter turn about z, and an offset.
    np.testing.assert_allclose(there.positions[..., 0], here.positions[..., 1], atol=1e-12)
    np.testing.assert_allclose(there.positions[..., 1], 0.5 - here.positions[..., 0], atol=1e-12)
    np.testing.assert_allclose(there.positions[..., 2], here.positions[..., 2] - 1.0, atol=1e-12)
    np.testing.assert_allclose(stage.feet["left"].velocities[0], [0.0, -0.5, -0.5], atol=1e-12)
    back = stage.in_frame("rig")
    np.testing.assert_allclose(back.hands["right"].positions, here.positions, atol=1e-12)
    np.testing.assert_allclose(
        np.abs(np.sum(back.hands["right"].orientations * here.orientations, axis=-1)), 1.0, atol=1e-12
    )
    with pytest.raises(ConfigError, match="no frame 'webxr'; the recording knows rig, stage"):
        take.in_frame("webxr")


def test_resampling_goes_through_the_samples_and_leaves_gaps(tmp_path: Path) -> None:
    times_ms = [0, 10, 20, 30, 500, 510]
    messages = [("rhot/hand/right", hand_pose(1e-3 * ms, START_NS + ms * 1_000_000)) for ms in times_ms]
    take = rhot.load(write_mcap(tmp_path / "take.mcap", messages))
    hand = take.resampled(200.0).hands["right"]
    assert np.allclose(np.diff(hand.t), 0.005)
    truth = take.hands["right"].positions
    np.testing.assert_allclose(hand.positions[[0, 2, 4, 6, 100, 102]], truth, atol=1e-9)
    np.testing.assert_allclose(hand.positions[1], 0.5 * (truth[0] + truth[1]), atol=1e-9)
    assert np.isnan(hand.positions[7:100]).all()
    assert hand.state[7] == ""
    np.testing.assert_allclose(np.linalg.norm(hand.orientations[1], axis=-1), 1.0)


@pytest.mark.parametrize("t_ns", [100.0, np.array([0.1, 0.2]), np.array([2, 1]), np.array([[1, 2]])])
def test_a_track_is_resampled_at_moments_alone(tmp_path: Path, t_ns: Any) -> None:
    hand = rhot.load(write_mcap(tmp_path / "take.mcap", session())).hands["right"]
    with pytest.raises(ValueError, match=r"whole numbers that increase; Take\.resampled takes a rate"):
        hand.resampled(t_ns)


def test_tables_of_pandas_and_xarray(tmp_path: Path) -> None:
    take = rhot.load(write_mcap(tmp_path / "take.mcap", session()))
    frame = take.to_dataframe("hand/right")
    assert frame.index.name == "t"
    np.testing.assert_array_equal(frame["index_tip_x"], take.hands["right"].joint("index_tip")[:, 0])
    data = take.to_xarray()
    assert data.position.dims == ("time", "space", "keypoints", "individuals")
    tip = data.position.sel(keypoints="index_tip", individuals="right", space="x")
    np.testing.assert_array_equal(tip, take.hands["right"].joint("index_tip")[:, 0])
    assert take.to_xarray("points").sizes["keypoints"] == 2
    for name in take.tracks:
        assert len(take.to_dataframe(name)) == COUNT
    with pytest.raises(KeyError, match=r"no track 'hand/left'; there are hand/right"):
        take.to_dataframe("hand/left")


def test_damaged_messages_are_counted_and_left_out(tmp_path: Path) -> None:
    hand = hand_pose(0.0, START_NS)
    file = tmp_path / "take.mcap"
    with McapWriter(file, now_ns=START_NS) as mcap:
        for number, payload in enumerate((encode(hand), b"\x81", b"", encode(hand)[:-9] + 8 * b"\xff" + b"d")):
            mcap.write("rhot/hand/right", encoding_of(HandPose), payload, START_NS + number, number, START_NS + number)
    take = rhot.load(file)
    assert (len(take.hands["right"]), take.invalid) == (1, 3)


def test_numbers_that_are_not_finite_are_refused_as_the_model_does() -> None:
    columns = PayloadColumns(FootPose)
    good = encode(foot(START_NS))
    place = good.index(bytes.fromhex("cb3f70624dd2f1a9fc"))
    columns.add(good)
    columns.add(good[: place + 1] + b"\x7f\xf8" + 6 * b"\0" + good[place + 9 :])
    assert [len(group.rows) for group in columns.groups()] == [1]
    assert columns.invalid == 1


def test_a_folder_means_the_file_in_it_or_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "grasp"
    folder.mkdir()
    with pytest.raises(ConfigError, match="no tracked file; name the file, or track the folder: rhot process"):
        rhot.load(folder)
    write_mcap(tmp_path / "grasp.mcap", session())
    assert len(rhot.load(folder).hands["right"]) == COUNT
    monkeypatch.chdir(folder)
    assert len(rhot.load(".").hands["right"]) == COUNT
    write_mcap(folder / "a.mcap", session())
    write_mcap(folder / "b.mcap", session())
    with pytest.raises(ConfigError, match=r"several tracked files: a\.mcap, b\.mcap"):
        rhot.load(folder)


@pytest.mark.parametrize("text", ["", "nonsense\n", '{"key": 3}\n'])
def test_what_is_no_recording_says_so(tmp_path: Path, text: str) -> None:
    file = tmp_path / "x.jsonl"
    file.write_text(text)
    if not text:
        assert rhot.load(file).tracks == {}
        return
    with pytest.raises(ConfigError, match="line 1: neither an MCAP file"):
        rhot.load(file)


@pytest.mark.parametrize("value", [str(1 << 70), '"\\ud800"'])
def test_what_no_message_can_hold_names_its_line(tmp_path: Path, value: str) -> None:
    file = tmp_path / "x.jsonl"
    file.write_text(f'{{"key": "rhot/points", "value": {{"t_ns": {value}}}}}\n')
    with pytest.raises(ConfigError, match=r"x\.jsonl, line 1: rhot/points: not a message"):
        rhot.load(file)


def test_importing_rhot_loads_nothing_heavy() -> None:
    heavy = ["numpy", "zenoh", "pydantic", "pandas", "xarray", "cv2", "mcap"]
    script = f"import sys, rhot; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    script = (
        f"import sys, rhot; rhot.load; print([m for m in {['pandas', 'xarray', 'cv2', 'zenoh']} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_events_of_one_label_keep_what_is_their_own(tmp_path: Path) -> None:
    events = [
        Event(t_ns=START_NS + n, seq=n, label="grasp", source="mark", uncertainty_s=0.001 * (n + 1)) for n in range(3)
    ]
    messages = [("rhot/hand/right", hand_pose(0.0, START_NS)), *(("rhot/event", event) for event in events)]
    for take in (
        rhot.load(write_mcap(tmp_path / "take.mcap", messages)),
        rhot.load(write_lines(tmp_path / "t.jsonl", messages)),
    ):
        assert take.events == tuple(events)
