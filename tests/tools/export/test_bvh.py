"""The animation, read by a parser that shares nothing with the writer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from exported.bvh_reader import read_bvh_file, world_positions
from hand_messages import LEFT_MODEL, MODEL, hand_pose
from numpy.typing import NDArray

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import CHAINS, JOINTS
from rhot.errors import ConfigError
from rhot.geometry.rotations import rotation_from_vector, rotation_x, rotation_y, rotation_z
from rhot.messages import Message
from rhot_tools.export.bvh import bvh_text, euler_zyx_deg
from rhot_tools.export.poses import ExportedMotion, hand_motion
from rhot_tools.export.skeleton_motion import skeleton_motion
from rhot_tools.recordings.export import export

BEGIN_NS = 1_800_000_000_000_000_000


def stream(model: HandModel, frames: int = 120, rate_hz: float = 60.0) -> list[tuple[str, Message]]:
    return [
        (f"rhot/hand/{model.side}", hand_pose(frame / rate_hz, BEGIN_NS + round(frame / rate_hz * 1e9), model))
        for frame in range(frames)
    ]


def errors_mm(text: str, motion: ExportedMotion) -> NDArray[np.float64]:
    root, _, frames = read_bvh_file(text)
    assert len(frames) == len(motion.t_ns)
    tips = {f"{chain[-2]} end": chain[-1] for chain in CHAINS.values()}
    errors = []
    for frame, recorded in zip(frames, motion.positions, strict=True):
        found = {tips.get(name, name): p for name, p in world_positions(root, frame).items()}
        in_rig = np.array([found[name] for name in JOINTS]) * (0.01, -0.01, -0.01)
        errors.append(1e3 * np.linalg.norm(in_rig - recorded, axis=1))
    return np.array(errors)


@pytest.mark.parametrize("model", [MODEL, LEFT_MODEL], ids=["right", "left"])
def test_an_independent_parser_finds_every_joint_within_a_tenth_of_a_millimetre(model: HandModel) -> None:
    motion = hand_motion(stream(model), None)
    text = bvh_text(skeleton_motion(motion))
    assert errors_mm(text, motion).max() < 0.001
    root, frame_s, frames = read_bvh_file(text)
    assert root.name == "wrist"
    assert root.channels[:3] == ["Xposition", "Yposition", "Zposition"]
    assert frame_s == pytest.approx(1.0 / 60.0, abs=1e-8)
    # A frame apart no curve jumps: what looks smooth in the recording does so between frames, too.
    assert np.abs(np.diff(frames[:, 6:], axis=0)).max() < 45.0


def test_axes_that_do_not_follow_the_bones_are_turned_until_they_do() -> None:
    """Another program's hand: the same places, each finger joint's axes off by some fixed or changing turn."""
    motion = hand_motion(stream(MODEL), None)
    rng = np.random.default_rng(7)
    rotations = motion.rotations.copy()
    for joint in range(2, len(JOINTS)):
        for frame in range(len(rotations)):
            rotations[frame, joint] = rotations[frame, joint] @ rotation_from_vector(rng.normal(0.0, 0.1, 3))
    turned = replace(motion, rotations=rotations)
    errors = errors_mm(bvh_text(skeleton_motion(turned)), turned)
    assert errors.max() < 0.1


def test_frames_at_a_steady_rate_lie_between_uneven_poses() -> None:
    rng = np.random.default_rng(2)
    t_s = np.sort(rng.uniform(0.0, 2.0, 240))
    messages: list[tuple[str, Message]] = [
        ("rhot/hand/right", hand_pose(float(t), BEGIN_NS + round(float(t) * 1e9))) for t in t_s
    ]
    motion = hand_motion(messages, "right")
    skeleton = skeleton_motion(motion, 100.0)
    at_s = (motion.t_ns[0] - BEGIN_NS) / 1e9 + np.arange(len(skeleton.root)) / 100.0
    truth = hand_motion([("rhot/hand/right", hand_pose(float(t), round(float(t) * 1e9))) for t in at_s], "right")
    errors = 1e3 * np.linalg.norm(skeleton.positions() - truth.positions, axis=-1)
    assert skeleton.interval_s == 0.01
    # Between poses 8 ms apart a hand that turns by 2 rad/s leaves the straight way by fractions of a millimetre.
    assert np.median(errors) < 0.05
    assert errors.max() < 2.0


def test_angles_rebuild_any_rotation_even_where_two_axes_fall_together() -> None:
    rng = np.random.default_rng(4)
    rotations = [rotation_from_vector(vector) for vector in rng.normal(0.0, 2.0, (200, 3))]
    rotations += [rotation_z(0.3) @ rotation_y(sign * np.pi / 2.0) @ rotation_x(1.1) for sign in (1.0, -1.0)]
    angles = np.radians(euler_zyx_deg(np.array(rotations)))
    for R, (z, y, x) in zip(rotations, angles, strict=True):
        np.testing.assert_allclose(rotation_z(z) @ rotation_y(y) @ rotation_x(x), R, atol=1e-7)


def write_lines(file: Path, messages: list[tuple[str, Message]]) -> None:
    file.write_text("".join(f'{{"key": "{key}", "value": {message.model_dump_json()}}}\n' for key, message in messages))


def test_the_command_asks_which_hand_and_tells_how_well_it_fits(tmp_path: Path) -> None:
    source, target = tmp_path / "x.jsonl", tmp_path / "x.bvh"
    both = stream(MODEL, 20) + stream(LEFT_MODEL, 20)
    write_lines(source, both)
    result = CliRunner().invoke(export, [str(source), "--bvh", str(target)])
    assert isinstance(result.exception, ConfigError)
    assert "--hand left or --hand right" in str(result.exception)
    result = CliRunner().invoke(export, [str(source), "--bvh", str(target), "--hand", "left"])
    assert result.exit_code == 0, result.output
    assert "20 frames" in result.output
    assert errors_mm(target.read_text(), hand_motion(both, "left")).max() < 0.001


def test_no_hand_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "x.jsonl").write_text("")
    result = CliRunner().invoke(export, [str(tmp_path / "x.jsonl"), "--bvh", str(tmp_path / "x.bvh")])
    assert isinstance(result.exception, ConfigError)
    assert "no complete pose" in str(result.exception)
    assert not (tmp_path / "x.bvh").exists()


def test_one_pose_is_a_motion_of_one_frame() -> None:
    motion = hand_motion(stream(MODEL, 1), None)
    assert errors_mm(bvh_text(skeleton_motion(motion)), motion).max() < 0.001
    assert len(skeleton_motion(motion, 60.0).root) == 1
