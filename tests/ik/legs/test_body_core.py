"""`rhot/body` from heads and feet as they come over the bus."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.messages import (
    BodyPose,
    FootPose,
    HandPose,
    HeadPose,
    Joint,
    Position,
    Quaternion,
    Side,
    State,
    decode,
    encode,
)
from rhot.messages.base import wire_position, wire_quaternion
from rhot.rig import BodyConfig, load_rig
from rhot_ik.body_core import BodyCore
from rhot_sim.walker.person import person_of
from rhot_sim.walker.world import WalkerWorld

MS = 1_000_000
START_NS = 1_700_000_000 * 1_000 * MS
PLAIN_FEET = """
[feet]
[feet.left]
marker_id = 1
[feet.right]
marker_id = 2
"""
FEET = """
[feet]
[feet.left]
marker_id = 1
ankle_m = [0.0, -0.03, 0.08]
[feet.right]
marker_id = 2
"""


@pytest.fixture
def core(rig_folder: Path) -> BodyCore:
    return make_core(rig_folder, FEET)


def make_core(rig_folder: Path, feet: str) -> BodyCore:
    rig_file = rig_folder / "rig.toml"
    rig_file.write_text(rig_file.read_text() + feet)
    return BodyCore(load_rig(rig_folder))


def head(t_ns: int) -> HeadPose:
    return HeadPose(
        t_ns=t_ns, frame="rig", position=(0.0, 1.62, -0.09), orientation=(0.0, 0.0, 0.0, 1.0), state="measured"
    )


def foot(side: Side, t_ns: int, *, velocity_m_s: float = 0.0) -> FootPose:
    return FootPose(
        t_ns=t_ns,
        side=side,
        frame="rig",
        position=(0.1 if side == "right" else -0.1, 0.11, -0.08),
        orientation=(0.0, 0.0, 0.0, 1.0),
        velocity=(0.0, velocity_m_s, 0.0),
        sigma=0.002,
        stage="marker",
        state="measured",
    )


def hand(side: Side, t_ns: int, wrist: Position, *, frame: str = "rig", state: State = "measured") -> HandPose:
    joint = Joint(position=wrist, orientation=(0.0, 0.0, 0.0, 1.0), radius=0.02)
    return HandPose(
        t_ns=t_ns, side=side, frame=frame, joints={"wrist": joint}, angles={}, residual={}, fingers={}, state=state
    )


def bodies(core: BodyCore, *messages: HeadPose | FootPose | HandPose) -> list[BodyPose]:
    found = []
    for message in messages:
        for key, body in core.feed(message):
            assert key == "rhot/body"
            assert isinstance(body, BodyPose)
            found.append(decode(encode(body), BodyPose))
    return found


def walk(rig_folder: Path, seed: int, *, lost_s: float = 0.0) -> FloatArray:
    """Return how far each knee is off (N,), metres, of a person who walks for eight seconds.

    A foot is lost for `lost_s` whenever it lifts off.
    """
    core = make_core(rig_folder, PLAIN_FEET)
    person = person_of(BodyModel.from_config(BodyConfig()), seed)
    world = WalkerWorld(seed, person, "walk")
    t_s = np.arange(0.0, 8.0, 0.04)
    heads, poses, ahead, joints = world.head(t_s), world.feet(t_s), world.feet(t_s + 1e-3), world.joints(t_s)
    flat = {side: world.flat(side, t_s) for side in poses}
    lifted_s = dict.fromkeys(poses, -np.inf)
    errors_m: list[float] = []
    for k in range(len(t_s)):
        t_ns = START_NS + round(1e9 * t_s[k])
        position, orientation = wire(heads[k])
        messages: list[HeadPose | FootPose] = [
            head(t_ns).model_copy(update={"position": position, "orientation": orientation})
        ]
        for side, T in poses.items():
            if k and flat[side][k - 1] and not flat[side][k]:
                lifted_s[side] = t_s[k]
            if t_s[k] - lifted_s[side] < lost_s:
                continue
            position, orientation = wire(T[k])
            change = {
                "position": position,
                "orientation": orientation,
                "velocity": wire_position((ahead[side][k] - T[k])[:3, 3] / 1e-3),
                "stationary": bool(flat[side][k]),
            }
            messages.append(foot(side, t_ns).model_copy(update=change))
        for body in bodies(core, *messages)[-1:]:
            for side in body.legs:
                off = np.array(body.joints[f"{side}_knee"].position) - joints[f"{side}_knee"][k, :3, 3]
                errors_m.append(float(np.linalg.norm(off)))
    return np.array(errors_m)


def wire(T: FloatArray) -> tuple[Position, Quaternion]:
    return wire_position(T[:3, 3]), wire_quaternion(quaternion_from_rotation(T[:3, :3]))


def test_both_feet_give_one_body_with_both_legs(core: BodyCore) -> None:
    poses = bodies(core, head(100 * MS), foot("left", 100 * MS), foot("right", 100 * MS))
    last = poses[-1]
    assert set(last.joints) == {"hips", "spine_lower", "chest", "neck", "head"} | {
        f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle", "foot")
    }
    assert last.state == "measured"
    assert last.joints["left_ankle"].position == pytest.approx((-0.1, 0.08, 0.0), abs=0.002)
    later = bodies(core, foot("left", 117 * MS), foot("right", 117 * MS))
    assert [pose.t_ns for pose in later] == [117 * MS], "one body for each moment"
    assert later[0].angles["right"].knee_flexion >= 0.0


def test_the_tilt_of_a_marker_on_its_instep_is_learned_while_the_foot_stands(core: BodyCore) -> None:
    tilt_rad = np.radians(18.0)
    orientation = (-float(np.sin(tilt_rad / 2)), 0.0, 0.0, float(np.cos(tilt_rad / 2)))
    found: list[BodyPose] = []
    for step in range(1, 200):
        t_ns = step * 17 * MS
        change = {"orientation": orientation, "stationary": True}
        stands = [foot(side, t_ns).model_copy(update=change) for side in ("left", "right")]
        found += bodies(core, head(t_ns), *stands)
    last = found[-1]
    for side in ("left", "right"):
        real_part = abs(last.joints[f"{side}_foot"].orientation[3])
        assert 2.0 * np.degrees(np.arccos(min(real_part, 1.0))) < 1.0, "the sole is level"
    drop_m = last.joints["left_ankle"].position[1] - last.joints["left_foot"].position[1]
    assert 0.0 < drop_m < 0.06, "the ball is a little lower than the ankle"


def test_a_marker_that_sits_higher_bends_no_knee_of_who_stands(core: BodyCore) -> None:
    found: list[BodyPose] = []
    for step in range(1, 120):
        left, right = (foot(side, step * 25 * MS).model_copy(update={"stationary": True}) for side in ("left", "right"))
        x, y, z = right.position
        # The left ankle is at 80 mm.
        raised = right.model_copy(update={"position": (x, y - 0.01, z)})
        tall = head(step * 25 * MS).model_copy(update={"position": (0.0, 1.66, -0.09)})
        found += bodies(core, tall, left, raised)
    bends = {
        name: np.degrees([pose.angles[side].knee_flexion for side in ("left", "right")])
        for name, pose in (("first", found[1]), ("last", found[-1]))
    }
    assert abs(np.diff(bends["first"])) > 10.0
    assert abs(np.diff(bends["last"])) < 4.0
    assert bends["last"].max() < 15.0


def test_a_foot_that_is_gone_takes_its_leg_along(core: BodyCore) -> None:
    bodies(core, head(100 * MS), foot("left", 100 * MS), foot("right", 100 * MS))
    poses = bodies(core, head(600 * MS), foot("right", 600 * MS))
    assert list(poses[-1].legs) == ["right"]
    assert "left_knee" not in poses[-1].joints


def test_a_late_foot_is_carried_on_by_its_velocity(core: BodyCore) -> None:
    bodies(core, head(100 * MS), foot("left", 100 * MS, velocity_m_s=0.5), foot("right", 100 * MS))
    (body,) = bodies(core, foot("right", 170 * MS))
    moved_m = body.joints["left_ankle"].position[1] - 0.08
    # Some of it is the pendulum's already, which comes down again.
    assert 0.6 * 0.5 * 0.070 < moved_m < 0.5 * 0.070
    assert body.legs == {"left": "predicted", "right": "measured"}


@pytest.mark.parametrize("seed", [3, 5])
def test_knees_of_a_person_with_lengths_of_their_own(rig_folder: Path, seed: int) -> None:
    # With the average lengths of their height it is 42 and 58 mm.
    assert walk(rig_folder, seed).mean() < 0.037


def test_knees_of_feet_that_are_lost_at_every_step(rig_folder: Path) -> None:
    errors_m = walk(rig_folder, 2, lost_s=0.35)
    assert errors_m.mean() < 0.030
    # 140 mm if a lost foot kept its velocity, 108 if it stayed where it was, 120 if a found one were believed at once.
    assert errors_m.max() < 0.100


def test_without_a_head_there_is_no_body(core: BodyCore) -> None:
    assert bodies(core, foot("left", 100 * MS), foot("right", 100 * MS)) == []
    assert bodies(core, head(100 * MS), foot("left", 900 * MS), foot("right", 900 * MS)) == []
    assert core.counts["no_head"] > 0


def test_wild_poses_never_break_it(core: BodyCore) -> None:
    rng = np.random.default_rng(3)
    t_ns = 0
    count = 0
    for _ in range(300):
        t_ns += int(rng.integers(1, 40)) * MS
        quaternion = rng.normal(size=4)
        orientation = tuple((quaternion / np.linalg.norm(quaternion)).tolist())
        side: Side = "left" if rng.random() < 0.5 else "right"
        position = tuple(rng.normal(scale=2.0, size=3).tolist())
        messages: list[HeadPose | FootPose] = [
            head(t_ns).model_copy(update={"position": position, "orientation": orientation}),
            foot(side, t_ns).model_copy(update={"position": position[::-1], "orientation": orientation}),
        ]
        for body in bodies(core, *messages):
            count += 1
            assert all(leg.knee_flexion >= 0.0 for leg in body.angles.values())
    assert count > 100


def test_tracked_hands_get_arms_and_the_message_says_what_is_inferred(core: BodyCore) -> None:
    hands = [hand("right", 95 * MS, (0.25, 1.1, -0.4)), hand("left", 95 * MS, (-0.25, 1.1, -0.4), state="predicted")]
    body = bodies(core, head(100 * MS), *hands, foot("left", 100 * MS), foot("right", 100 * MS))[-1]
    assert body.arms == {"left": "predicted", "right": "measured"}
    assert body.joints["right_wrist"].position == pytest.approx((0.25, 1.1, -0.4), abs=1e-3)
    elbow = np.array(body.joints["right_elbow"].position)
    assert elbow[1] < 1.25, "below the line from the shoulder to the wrist"
    measured = set(body.joints) - set(body.inferred)
    assert measured == {"head"} | {f"{side}_{end}" for side in ("left", "right") for end in ("ankle", "foot", "wrist")}


@pytest.mark.parametrize(
    "away",
    [
        hand("right", 95 * MS, (0.25, 1.1, -0.4)),
        hand("right", 995 * MS, (0.25, 1.1, -0.4), frame="elsewhere"),
        hand("right", 995 * MS, (0.3, 1.1, -1.4)),
    ],
    ids=["old", "other frame", "out of reach"],
)
def test_a_hand_that_says_nothing_gives_no_arm(core: BodyCore, away: HandPose) -> None:
    body = bodies(core, head(1000 * MS), away, foot("left", 1000 * MS), foot("right", 1000 * MS))[-1]
    assert body.arms == {}
    assert "right_elbow" not in body.joints
    assert "chest" in body.joints
