"""Random hands: bones, paint and the skin over them."""

from __future__ import annotations

import numpy as np
import pytest

from worlds.hand import (
    ANGLES,
    BONES,
    JOINTS,
    MARKERS,
    Hand,
    bone_poses,
    cone_distance,
    joint_positions,
    marker_positions,
)
from worlds.skin import Skin, make_skin, surface_nets, with_patch
from worlds.world import random_hand

pytestmark = pytest.mark.xdist_group("random hands")


@pytest.fixture(scope="module", params=[3, 4])
def hand(request: pytest.FixtureRequest) -> Hand:
    rng = np.random.default_rng(request.param)
    return with_patch(random_hand(rng), rng)


@pytest.fixture(scope="module")
def skin(hand: Hand) -> Skin:
    return make_skin(hand)


def test_bones_keep_their_lengths_in_any_pose(hand: Hand) -> None:
    angles = np.random.default_rng(1).uniform(-10.0, 90.0, (20, len(ANGLES)))
    joints = joint_positions(hand, bone_poses(hand, angles))
    at = {name: joints[:, place] for place, name in enumerate(JOINTS)}
    for finger, lengths in hand.lengths.items():
        chain = ("cmc", "mcp", "ip", "tip") if finger == "thumb" else ("mcp", "pip", "dip", "tip")
        for place, length in enumerate(lengths):
            apart = at[f"{finger}_{chain[place + 1]}"] - at[f"{finger}_{chain[place]}"]
            np.testing.assert_allclose(np.linalg.norm(apart, axis=1), length, atol=1e-9)


def test_flexion_bends_to_the_palm_and_abduction_turns_to_the_thumb(hand: Hand) -> None:
    tip = JOINTS.index("middle_tip")
    moves = {}
    for name in ("middle_mcp_flex", "middle_mcp_abd"):
        angles = np.zeros((2, len(ANGLES)))
        angles[1, ANGLES.index(name)] = 20.0
        joints = joint_positions(hand, bone_poses(hand, angles))
        moves[name] = joints[1, tip] - joints[0, tip]
    assert moves["middle_mcp_flex"][2] > 20.0
    assert moves["middle_mcp_abd"][0] > 20.0


def test_markers_lie_inside_their_fingertips_and_move_with_them(hand: Hand) -> None:
    centres = hand.marker_centres()
    for finger in MARKERS[:5]:
        cone = hand.tip_cone(finger)
        depth = cone_distance(centres[finger][None], cone.start, cone.end, cone.start_mm, cone.end_mm)[0]
        assert depth < -0.7 * cone.end_mm
        assert hand.border(finger) < centres[finger][1] < hand.lengths[finger][2]
    angles = np.random.default_rng(2).uniform(0.0, 60.0, (5, len(ANGLES)))
    poses = bone_poses(hand, angles)
    markers, joints = marker_positions(hand, poses), joint_positions(hand, poses)
    apart = markers[:, MARKERS.index("ring")] - joints[:, JOINTS.index("ring_tip")]
    assert np.ptp(np.linalg.norm(apart, axis=1)) < 1e-9


def test_skin_is_painted_on_rigid_tips_only(hand: Hand, skin: Skin) -> None:
    np.testing.assert_allclose(skin.weights.sum(axis=1), 1.0, atol=1e-9)
    painted = skin.beyond > 0.0
    distal = [BONES.index(f"{finger}_distal") for finger in MARKERS[:5]]
    np.testing.assert_allclose(skin.weights[painted][:, distal].sum(axis=1), 1.0, atol=1e-9)
    rest = bone_poses(hand, np.zeros((1, 20)))[0]
    for place, finger in enumerate(MARKERS[:5]):
        corners = np.unique(skin.quads[skin.finger == place])
        corners = corners[painted[corners]]
        bone = rest[distal[place]]
        local = (skin.vertices[corners] - bone[:3, 3]) @ bone[:3, :3]
        cone = hand.tip_cone(finger)
        off = cone_distance(local, cone.start, cone.end, cone.start_mm, cone.end_mm)
        assert np.abs(off).max() < 0.5
    assert 0.36 < skin.width_mm / hand.length_mm < 0.50


def test_patch_touches_the_back_of_the_hand_from_outside(hand: Hand, skin: Skin) -> None:
    inverse = np.linalg.inv(hand.T_hand_patch)
    local = skin.vertices @ inverse[:3, :3].T + inverse[:3, 3]
    under = (np.abs(local[:, :2]) < np.array(hand.patch[:2]) / 2).all(axis=1) & (local[:, 2] < 20.0)
    gap = local[under][:, 2].min() - hand.patch[2] / 2
    assert -1.0 < gap < 1.0


def test_surface_of_a_ball() -> None:
    axes = [np.linspace(-6.0, 6.0, 25), np.linspace(-6.0, 6.0, 31), np.linspace(-6.0, 6.0, 25)]
    field = np.linalg.norm(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), axis=-1) - 5.0
    vertices, quads = surface_nets(field, axes)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 5.0, atol=0.1)
    a, b, c, d = (vertices[quads[:, i]] for i in range(4))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c) + np.cross(c, d)).sum() / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 125.0, rel=0.02)
