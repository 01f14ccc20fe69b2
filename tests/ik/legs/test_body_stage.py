"""`rhot/body` from heads and feet as they come over the bus."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rhot.messages import BodyPose, FootPose, HeadPose, Side, decode, encode
from rhot.rig import load_rig
from rhot_ik.legs.body_stage import BodyStage

MS = 1_000_000
FEET = """
[feet]
[feet.left]
marker_id = 1
ankle_m = [0.0, -0.03, 0.08]
[feet.right]
marker_id = 2
"""


@pytest.fixture
def stage(rig_folder: Path) -> BodyStage:
    rig_file = rig_folder / "rig.toml"
    rig_file.write_text(rig_file.read_text() + FEET)
    return BodyStage(load_rig(rig_folder))


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


def bodies(stage: BodyStage, *messages: HeadPose | FootPose) -> list[BodyPose]:
    found = []
    for message in messages:
        for key, body in stage.feed(message):
            assert key == "rhot/body"
            assert isinstance(body, BodyPose)
            found.append(decode(encode(body), BodyPose))
    return found


def test_both_feet_give_one_body_with_both_legs(stage: BodyStage) -> None:
    poses = bodies(stage, head(100 * MS), foot("left", 100 * MS), foot("right", 100 * MS))
    last = poses[-1]
    assert set(last.joints) == {"hips"} | {
        f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle", "foot")
    }
    assert last.state == "measured"
    assert last.joints["left_ankle"].position == pytest.approx((-0.1, 0.08, 0.0), abs=0.002)
    later = bodies(stage, foot("left", 117 * MS), foot("right", 117 * MS))
    assert [pose.t_ns for pose in later] == [117 * MS], "one body for each moment"
    assert later[0].angles["right"].knee_flexion >= 0.0


def test_the_tilt_of_a_marker_on_its_instep_is_learnt_while_the_foot_stands(stage: BodyStage) -> None:
    tilt_rad = np.radians(18.0)
    orientation = (-float(np.sin(tilt_rad / 2)), 0.0, 0.0, float(np.cos(tilt_rad / 2)))
    found: list[BodyPose] = []
    for step in range(1, 200):
        t_ns = step * 17 * MS
        change = {"orientation": orientation, "stationary": True}
        stands = [foot(side, t_ns).model_copy(update=change) for side in ("left", "right")]
        found += bodies(stage, head(t_ns), *stands)
    last = found[-1]
    for side in ("left", "right"):
        real_part = abs(last.joints[f"{side}_foot"].orientation[3])
        assert 2.0 * np.degrees(np.arccos(min(real_part, 1.0))) < 1.0, "the sole is level"
    drop_m = last.joints["left_ankle"].position[1] - last.joints["left_foot"].position[1]
    assert 0.0 < drop_m < 0.06, "the ball is a little lower than the ankle"


def test_a_foot_that_is_gone_takes_its_leg_along(stage: BodyStage) -> None:
    bodies(stage, head(100 * MS), foot("left", 100 * MS), foot("right", 100 * MS))
    poses = bodies(stage, head(600 * MS), foot("right", 600 * MS))
    assert list(poses[-1].legs) == ["right"]
    assert "left_knee" not in poses[-1].joints


def test_a_late_foot_is_carried_on_by_its_velocity(stage: BodyStage) -> None:
    bodies(stage, head(100 * MS), foot("left", 100 * MS, velocity_m_s=0.5), foot("right", 100 * MS))
    (body,) = bodies(stage, foot("right", 180 * MS))
    moved_m = body.joints["left_ankle"].position[1] - 0.08
    assert moved_m == pytest.approx(0.5 * 0.060, abs=1e-6)


def test_without_a_head_there_is_no_body(stage: BodyStage) -> None:
    assert bodies(stage, foot("left", 100 * MS), foot("right", 100 * MS)) == []
    assert bodies(stage, head(100 * MS), foot("left", 900 * MS), foot("right", 900 * MS)) == []
    assert stage.counts["no_head"] > 0


def test_wild_poses_never_break_it(stage: BodyStage) -> None:
    rng = np.random.default_rng(3)
    t_ns = 0
    count = 0
    for _ in range(300):
        t_ns += int(rng.integers(1, 40)) * MS
        quaternion = rng.normal(size=4)
        orientation = tuple((quaternion / np.linalg.norm(quaternion)).tolist())
        side: Side = "left" if rng.random() < 0.5 else "right"
        place = tuple(rng.normal(scale=2.0, size=3).tolist())
        messages: list[HeadPose | FootPose] = [
            head(t_ns).model_copy(update={"position": place, "orientation": orientation}),
            foot(side, t_ns).model_copy(update={"position": place[::-1], "orientation": orientation}),
        ]
        for body in bodies(stage, *messages):
            count += 1
            assert all(leg.knee_flexion >= 0.0 for leg in body.angles.values())
    assert count > 100
