"""Motions read at common moments: the real rate, time 0 at the first pose, and gaps that stay gaps."""

from __future__ import annotations

from pathlib import Path

import c3d
import numpy as np
import pytest
from click.testing import CliRunner
from exported import person
from hand_messages import hand_pose, object_pose

from rhot.errors import ConfigError
from rhot.messages import MeshShape, Message, ObjectPose
from rhot_tools.export.frames import MAX_GAP_S, Frames, frames_of, real_rate_hz, write_c3d
from rhot_tools.export.gltf import mesh_of
from rhot_tools.export.poses import motions
from rhot_tools.export.skeleton_motion import skeleton_motion
from rhot_tools.recordings.export import export

BEGIN_NS = 1_800_000_000_000_000_000


def objects(times_s: list[float], name: str = "cup") -> list[tuple[str, Message]]:
    return [(f"rhot/object/{name}", object_pose(BEGIN_NS + round(t * 1e9), t)) for t in times_s]


def x_of(messages: list[tuple[str, Message]], rate_hz: float | None = None) -> tuple[float, np.ndarray, np.ndarray]:
    frames = frames_of(list(motions(messages).values()), rate_hz)
    return frames.rate_hz, frames.t_s, frames.positions[:, frames.markers.index("object_cup"), 0]


def test_the_rate_is_the_real_one_also_where_a_sample_is_lost() -> None:
    times = [number / 59.94 for number in range(40) if number != 17]
    rate_hz, t_s, x = x_of(objects(times))
    assert rate_hz == pytest.approx(59.94, rel=1e-6)
    assert t_s[0] == 0.0
    assert len(t_s) == 40
    np.testing.assert_allclose(x, t_s, atol=1e-6)


@pytest.mark.parametrize("phase", [0.02, 0.12, 0.31, 0.5])
@pytest.mark.parametrize("cameras", [2, 3])
def test_the_rate_of_cameras_out_of_step_is_that_of_all_of_them(phase: float, cameras: int) -> None:
    shifts = np.array([0.0, phase, 0.8])[:cameras]
    times = (np.arange(200)[:, None] + shifts).ravel() / 60.0
    times = np.delete(times, [17, 90, 211])
    assert real_rate_hz((times * 1e9).astype(np.int64)) == pytest.approx(60.0 * cameras, rel=0.02)


def test_a_pause_is_a_gap_and_what_begins_later_is_absent_before() -> None:
    times = [n / 100.0 for n in range(20)] + [0.2 + MAX_GAP_S + n / 100.0 for n in range(20)]
    messages = [*objects(times), *objects([0.1 + n / 100.0 for n in range(10)], "late")]
    frames = frames_of(list(motions(messages).values()))
    cup = frames.positions[:, frames.markers.index("object_cup"), 0]
    gap = (frames.t_s > 0.191) & (frames.t_s < 0.2 + MAX_GAP_S - 1e-6)
    assert gap.sum() == 10
    assert np.isnan(cup[gap]).all()
    assert not np.isnan(cup[~gap]).any()
    late = frames.positions[:, frames.markers.index("object_late"), 0]
    assert (np.isnan(late) == ((frames.t_s < 0.0999) | (frames.t_s > 0.1901))).all()


def test_a_rate_of_ones_own_reads_between_poses() -> None:
    rate_hz, t_s, x = x_of(objects([n / 60.0 for n in range(61)]), 250.0)
    assert rate_hz == 250.0
    assert t_s[-1] == pytest.approx(1.0)
    np.testing.assert_allclose(x, t_s, atol=1e-6)


@pytest.mark.parametrize("rate_hz", [None, 60.0, 30.0, 59.94])
@pytest.mark.parametrize("poses", [2, 61, 601, 20_001])
def test_the_last_pose_is_kept_at_exact_rates(rate_hz: float | None, poses: int) -> None:
    """Times are whole nanoseconds: 60 of them make a second but for 40 ns."""
    period_ns = int(1e9 / (rate_hz or 60.0))
    at_ns = BEGIN_NS + period_ns * np.arange(poses)
    messages: list[tuple[str, Message]] = [
        ("rhot/object/cup", object_pose(int(t), 0.001 * k)) for k, t in enumerate(at_ns)
    ]
    _, t_s, x = x_of(messages, rate_hz)
    assert len(t_s) == poses
    assert x[-1] == pytest.approx(0.001 * (poses - 1), abs=2e-5)


def test_a_take_longer_than_c3d_can_number_goes_into_several_files(tmp_path: Path) -> None:
    count = 65_000 + 1_234
    frames = Frames(
        60.0, np.arange(count) / 60.0, ("a",), np.linspace(0.0, 1.0, 3 * count).reshape(count, 1, 3), angles={}
    )
    files = write_c3d(tmp_path / "long.c3d", frames, y_up=True)
    assert [file.name for file in files] == ["long-001.c3d", "long-002.c3d"]
    assert not (tmp_path / "long.c3d").exists()
    read = []
    for file in files:
        with file.open("rb") as stream:
            read += [points[0, 0] for _, points, _ in c3d.Reader(stream).read_frames()]
    np.testing.assert_allclose(read, 1e3 * frames.positions[:, 0, 0], atol=1e-3)


def test_a_time_of_another_year_is_told_instead_of_filling_the_memory() -> None:
    late: Message = object_pose(BEGIN_NS + 30_000_000_000_000_000, 0.0)
    messages = [*objects([0.0, 0.01, 0.02]), ("rhot/object/cup", late)]
    with pytest.raises(ConfigError, match=r"8333\.3 h apart, \d+ frames at 100\.0 Hz; 5000000 are the most"):
        frames_of(list(motions(messages).values()))
    with pytest.raises(ConfigError, match="apart"):
        skeleton_motion(motions(messages)["object_cup"], 60.0)


def test_planes_that_enclose_nothing_are_drawn_as_their_box() -> None:
    shape = MeshShape(file="a.glb", size=(0.1, 0.2, 0.3), planes=((1.0, 0.0, 0.0, 0.1),) * 4)
    assert np.ptp(mesh_of(shape).corners, axis=0) == pytest.approx((0.1, 0.2, 0.3))


def test_what_was_only_predicted_can_be_left_out() -> None:
    messages = objects([n / 100.0 for n in range(30)])
    kept = {"state": "predicted"}
    predicted = [
        (key, message.model_copy(update=kept if 10 < n < 25 else {})) for n, (key, message) in enumerate(messages)
    ]
    assert len(motions(predicted)["object_cup"].t_ns) == 30
    assert len(motions(predicted, measured=True)["object_cup"].t_ns) == 16


@pytest.mark.parametrize(("without", "kept"), [(2, True), (15, False)])
def test_an_arm_counts_where_it_is_hardly_ever_missing(without: int, kept: bool) -> None:
    messages: list[tuple[str, Message]] = []
    for number in range(20):
        body = person.body_message(BEGIN_NS + 10_000_000 * number, np.eye(4))
        arm = [name for name in body.joints if name.startswith("right_") and name.endswith(("er", "ow", "st"))]
        if number < without:
            body = body.model_copy(update={"joints": {k: v for k, v in body.joints.items() if k not in arm}})
        messages.append(("rhot/body", body))
    motion = motions(messages)["body"]
    assert ("right_elbow" in motion.joints) is kept
    assert len(motion.t_ns) == (20 - without if kept else 20)
    assert motion.incomplete == (without if kept else 0)
    assert motion.joints[motion.parents[motion.joints.index("neck")]] == "chest"


def test_nothing_that_moves_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "x.jsonl").write_text("")
    done = CliRunner().invoke(export, [str(tmp_path / "x.jsonl"), "--trc", str(tmp_path / "x.trc")])
    assert "no hand, body, foot, object or head" in str(done.exception)
    message = object_pose(BEGIN_NS, 0.0)
    assert isinstance(message, ObjectPose)
    (tmp_path / "x.jsonl").write_text(f'{{"key": "rhot/object/cup", "value": {message.model_dump_json()}}}\n')
    done = CliRunner().invoke(export, [str(tmp_path / "x.jsonl"), "--mot", str(tmp_path / "x.mot")])
    assert "no joint angles" in str(done.exception)


def test_without_a_floor_the_rigs_own_axes_are_told(tmp_path: Path) -> None:
    hand = hand_pose(0.0, BEGIN_NS)
    (tmp_path / "x.jsonl").write_text(f'{{"key": "rhot/hand/right", "value": {hand.model_dump_json()}}}\n')
    done = CliRunner().invoke(export, [str(tmp_path / "x.jsonl"), "--trc", str(tmp_path / "x.trc")])
    assert done.exit_code == 0
    assert "no floor is known" in done.output
    row = (tmp_path / "x.trc").read_text().splitlines()[-1].split("\t")
    np.testing.assert_allclose([float(cell) for cell in row[2:5]], hand.joints["palm"].position, atol=1e-6)
