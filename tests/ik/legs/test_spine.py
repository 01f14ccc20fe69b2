"""The spine between hips and head: known postures, lengths, no jumps."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.anatomy.body_proportions import SPINE_SHARES, BodyModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rigid, rotation_from_vector, rotation_x, rotation_y, rotation_z
from rhot.rig import BodyConfig
from rhot_ik.legs.upper_body import spine

BODY = BodyModel.from_config(BodyConfig(height_m=1.8))
HIPS = rigid(np.eye(3), np.array([0.2, 0.95, -0.1]))


def head_over(offset: FloatArray, R: FloatArray | None = None) -> FloatArray:
    """Return the headset's pose (4, 4) that has its neck at an offset (3,) from the hips."""
    turned = np.eye(3) if R is None else R
    return rigid(turned, HIPS[:3, 3] + offset - turned @ np.array(BODY.neck_m))


def bones_m(joints: dict[str, FloatArray], T_rig_hips: FloatArray = HIPS) -> FloatArray:
    chain = [T_rig_hips, *(joints[name] for name in ("spine_lower", "chest", "neck"))]
    lengths: FloatArray = np.linalg.norm(np.diff([T[:3, 3] for T in chain], axis=0), axis=1)
    return lengths


def test_an_upright_person_has_the_published_heights() -> None:
    joints = spine(HIPS, head_over(np.array([0.0, BODY.neck_height_m, 0.0])), BODY)
    for T in joints.values():
        assert np.allclose(T[:3, :3], np.eye(3), atol=1e-9)
        assert T[:3, 3][[0, 2]] == pytest.approx([0.2, -0.1], abs=1e-9)
    heights = [joints[name][1, 3] - 0.95 for name in ("spine_lower", "chest", "neck", "head")]
    # De Leva's trunk over Drillis and Contini's heights: 0.346 H from the hips to the neck.
    assert np.array(heights) / 1.8 == pytest.approx([0.0836, 0.2072, 0.346, 0.394], abs=5e-4)


@pytest.mark.parametrize("share", [1.0, 0.95, 0.8, 0.6])
@pytest.mark.parametrize("lean_deg", [0.0, 40.0, 90.0])
def test_a_slouching_spine_keeps_its_bones_and_bends_backwards(share: float, lean_deg: float) -> None:
    up = rotation_x(-np.radians(lean_deg)) @ [0.0, 1.0, 0.0]
    joints = spine(HIPS, head_over(share * BODY.neck_height_m * up), BODY)
    assert bones_m(joints) == pytest.approx(np.array(SPINE_SHARES) * BODY.neck_height_m, abs=1e-5)
    out = [T[:3, 3] - HIPS[:3, 3] for T in (joints["spine_lower"], joints["chest"])]
    back = rotation_x(-np.radians(lean_deg)) @ [0.0, 0.0, 1.0]
    for place in out:
        assert place @ back >= -1e-6
        assert place[0] == pytest.approx(0.0, abs=1e-9)
    assert bool(out[1] @ back > 0.02) is (share < 1.0)


def test_a_longer_person_gets_longer_bones() -> None:
    joints = spine(HIPS, head_over(np.array([0.0, 1.1 * BODY.neck_height_m, 0.0])), BODY)
    assert bones_m(joints) == pytest.approx(1.1 * np.array(SPINE_SHARES) * BODY.neck_height_m, abs=1e-6)


@pytest.mark.parametrize("turned_deg", [-100.0, -45.0, 30.0, 125.0])
def test_a_turned_head_turns_the_chest_by_its_share_of_the_range(turned_deg: float) -> None:
    R = rotation_y(np.radians(turned_deg)) @ rotation_x(-0.5)
    joints = spine(HIPS, head_over(np.array([0.0, BODY.neck_height_m, 0.0]), R), BODY)
    for name, share in (("spine_lower", 10.0 / 125.0), ("chest", 45.0 / 125.0)):
        x, z = joints[name][0, 0], joints[name][2, 0]
        assert np.degrees(np.arctan2(-z, x)) == pytest.approx(share * turned_deg, abs=1e-6)
    assert np.allclose(joints["head"][:3, :3], R)


def test_whatever_the_head_does_all_is_finite_and_nothing_jumps() -> None:
    """Small steps of the head move each joint by little, also where it looks behind, lies over, or touches the hips."""
    random = np.random.default_rng(7)
    for _ in range(60):
        offset, turn = random.normal(0.0, 0.4, 3), random.normal(0.0, 2.0, 3)
        offset[1] += 0.4
        before = None
        for k in range(3):
            R = rotation_from_vector(turn) @ rotation_z(1e-4 * k)
            joints = spine(HIPS, head_over(offset + 1e-4 * k * np.ones(3), R), BODY)
            now = np.stack(list(joints.values()))
            assert np.isfinite(now).all()
            rotations = now[:, :3, :3]
            assert np.allclose(np.swapaxes(rotations, 1, 2) @ rotations, np.eye(3), atol=1e-9)
            if before is not None:
                assert np.abs(now[:, :3, 3] - before[:, :3, 3]).max() < 0.01
                assert np.abs(rotations - before[:, :3, :3]).max() < 0.05
            before = now
    together = spine(HIPS, head_over(np.zeros(3)), BODY)
    assert all(np.isfinite(T).all() for T in together.values())
