"""Arms between shoulder and wrist: where elbows are, limits, no jumps."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rigid
from rhot.messages import Side
from rhot_ik.legs.upper_body import LONGEST, hand_axes, solve_arm

SIDES: tuple[Side, Side] = ("left", "right")
OUT = {"left": -1.0, "right": 1.0}
UPPER_M, FOREARM_M = 0.33, 0.26
SHOULDER = np.array([0.1, 1.4, 0.3])


def arm(side: Side, offset: FloatArray, R_wrist: FloatArray | None = None) -> dict[str, FloatArray] | None:
    T = rigid(np.eye(3) if R_wrist is None else R_wrist, SHOULDER + offset)
    return solve_arm(side, np.eye(3), SHOULDER, T, UPPER_M, FOREARM_M)


def elbow_from_line(side: Side, offset: list[float]) -> FloatArray:
    """Return where the elbow is from the line between shoulder and wrist, as a unit vector."""
    joints = arm(side, np.array(offset))
    assert joints is not None
    elbow, unit = joints[f"{side}_elbow"][:3, 3] - SHOULDER, np.array(offset) / np.linalg.norm(offset)
    off: FloatArray = elbow - (elbow @ unit) * unit
    return off / np.linalg.norm(off)


@pytest.mark.parametrize("side", SIDES)
def test_elbows_are_where_people_have_them(side: Side) -> None:
    out = OUT[side]
    assert elbow_from_line(side, [0.0, 0.0, -0.45])[1] < -0.9, "held ahead: down"
    assert elbow_from_line(side, [0.0, -0.5, 0.0])[2] > 0.9, "hanging: behind"
    assert elbow_from_line(side, [out * 0.5, 0.0, 0.0])[1] < -0.9, "to the side: under the arm"
    assert elbow_from_line(side, [0.0, 0.5, 0.0])[2] < -0.9, "overhead: in front"
    assert elbow_from_line(side, [-out * 0.3, -0.1, -0.3]) @ [out, 0.0, 0.0] > 0.1, "across the chest: outwards"


@pytest.mark.parametrize("side", SIDES)
def test_a_hanging_arm_has_the_body_s_axes(side: Side) -> None:
    # Of a hanging hand with the palm to the thigh: OpenXR's +Z to the wrist is up, +Y out of its back outwards.
    y, z = np.array([OUT[side], 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    R_wrist = np.stack([np.cross(y, z), y, z], axis=-1)
    joints = arm(side, np.array([0.0, -0.999 * (UPPER_M + FOREARM_M), 0.0]), R_wrist)
    assert joints is not None
    assert np.allclose(joints[f"{side}_wrist"][:3, :3], np.eye(3))
    for joint in ("shoulder", "elbow"):
        R = joints[f"{side}_{joint}"][:3, :3]
        # 20° of the elbow's outward rotation, and the last bit of the bend.
        assert R[1, 1] > 0.98
        assert R[0, 0] > 0.9
    assert np.allclose(hand_axes(side, R_wrist), np.eye(3))


def test_bones_keep_their_lengths_elbows_bend_forwards_and_nothing_jumps() -> None:
    random = np.random.default_rng(3)
    for side in SIDES:
        for _ in range(150):
            offset = random.normal(0.0, 0.3, 3)
            direction = offset / np.linalg.norm(offset)
            joints = arm(side, offset)
            if joints is None:
                assert np.linalg.norm(offset) > LONGEST * (UPPER_M + FOREARM_M)
                continue
            places = [joints[f"{side}_{name}"][:3, 3] for name in ("shoulder", "elbow", "wrist")]
            assert np.isfinite(places).all()
            assert np.linalg.norm(places[1] - places[0]) == pytest.approx(UPPER_M, abs=1e-6)
            assert np.linalg.norm(places[2] - places[1]) == pytest.approx(FOREARM_M, abs=1e-6)
            R_upper, R_lower = (joints[f"{side}_{name}"][:3, :3] for name in ("shoulder", "elbow"))
            # Flexion, the forearm forwards: from 0 to where forearm and upper arm meet (`bend_leg`), never backwards.
            bend = R_upper.T @ R_lower
            flexion = np.degrees(np.arctan2(bend[2, 1], bend[1, 1]))
            assert -1e-6 <= flexion <= 155.0
            moved = arm(side, offset + 1e-4 * random.normal(0.0, 1.0, 3))
            if moved is not None and direction[2] < 0.9:
                assert np.linalg.norm(moved[f"{side}_elbow"][:3, 3] - places[1]) < 0.01


def test_a_wrist_that_no_arm_reaches_gives_none() -> None:
    assert arm("right", np.array([0.0, -0.9, 0.0])) is None
    reached = arm("right", np.array([0.0, -0.65, 0.0]))
    assert reached is not None, "a shoulder that is drawn forwards gives some more"
    assert np.linalg.norm(reached["right_wrist"][:3, 3] - SHOULDER) < UPPER_M + FOREARM_M
