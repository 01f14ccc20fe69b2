from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.anatomy.hand import CAP_SHARE, MOVING, HandModel
from rhot.anatomy.hand_proportions import REFERENCE_LENGTH_M
from rhot.anatomy.skeleton import FINGERS, JOINTS, PARENTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_vector, rotation_x, rotation_y
from rhot.rig import HandFile, MarkerConfig
from rhot.types import Side

SIDES: tuple[Side, ...] = ("right", "left")
BENT = np.radians([[10.0, 5.0, 20.0, 15.0], *[[35.0, 4.0, 50.0, 33.0]] * 4])


def bone_lengths(model: HandModel, positions: FloatArray) -> FloatArray:
    lengths: FloatArray = np.linalg.norm(np.diff(positions[..., MOVING, :], axis=-2), axis=-1)
    return lengths


@pytest.fixture(params=SIDES)
def model(request: pytest.FixtureRequest) -> HandModel:
    return HandModel.from_file(HandFile(), request.param)


def test_middle_finger_gives_the_hand_its_length(model: HandModel) -> None:
    joints = model.forward_local(np.zeros((5, 4)))
    end = -joints.position("middle_tip")[2] + model.radii[JOINTS.index("middle_tip")]
    assert end == pytest.approx(0.189, abs=1e-9)


def test_flat_hand_points_forward_with_the_thumb_on_its_side(model: HandModel) -> None:
    joints = model.forward_local(np.zeros((5, 4)))
    for finger in FINGERS[1:]:
        tip, knuckle = joints.position(f"{finger}_tip"), joints.position(f"{finger}_proximal")
        assert tip[2] < knuckle[2] - 0.04
        assert tip[1] == pytest.approx(knuckle[1], abs=1e-9)
    thumb_x = joints.position("thumb_tip")[0]
    assert thumb_x < -0.05 if model.side == "right" else thumb_x > 0.05


def test_flexion_goes_to_the_palm_and_abduction_to_the_thumb(model: HandModel) -> None:
    flat = model.forward_local(np.zeros((5, 4)))
    flexed = model.forward_local(np.tile([0.5, 0.0, 0.0, 0.0], (5, 1)))
    spread = model.forward_local(np.tile([0.0, 0.2, 0.0, 0.0], (5, 1)))
    for finger in FINGERS[1:]:
        assert flexed.position(f"{finger}_tip")[1] < flat.position(f"{finger}_tip")[1] - 0.02
        sideways = (spread.position(f"{finger}_tip") - flat.position(f"{finger}_tip"))[0]
        assert sideways * model.handedness < -0.005
    assert spread.position("thumb_tip")[1] < flat.position("thumb_tip")[1] - 0.01
    across = flexed.position("thumb_tip")[0] - flat.position("thumb_tip")[0]
    assert across * model.handedness > 0.02


def test_joint_axes_are_openxrs(model: HandModel) -> None:
    joints = model.forward_local(BENT)
    for child, parent in PARENTS.items():
        if parent in (None, "wrist") or child.endswith("metacarpal"):
            continue
        back = joints.position(str(parent)) - joints.position(child)
        assert np.allclose(joints.rotation(str(parent))[:, 2], back / np.linalg.norm(back), atol=1e-9), child
    assert np.allclose(np.linalg.det(joints.rotations), 1.0)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_bones_keep_their_lengths_and_sides_mirror(seed: int) -> None:
    angles = np.random.default_rng(seed).uniform(-2.0, 2.0, (3, 5, 4))
    right, left = (HandModel.from_file(HandFile(), side) for side in SIDES)
    here, there = right.forward_local(angles), left.forward_local(angles)
    assert np.allclose(bone_lengths(right, here.positions), right.bones, atol=1e-12)
    mirror = np.diag([-1.0, 1.0, 1.0])
    assert np.allclose(here.positions @ mirror, there.positions, atol=1e-12)
    assert np.allclose(mirror @ here.rotations @ mirror, there.rotations, atol=1e-12)


def test_pose_and_batch_agree_with_one_at_a_time(model: HandModel) -> None:
    rng = np.random.default_rng(0)
    angles = rng.uniform(-1.0, 1.0, (4, 5, 4))
    T = np.tile(np.eye(4), (4, 1, 1))
    for pose in T:
        pose[:3, :3] = rotation_from_vector(rng.normal(size=3))
        pose[:3, 3] = rng.normal(size=3)
    many = model.forward(T, angles)
    assert many.positions.shape == (4, 26, 3)
    for k in range(4):
        one = model.forward(T[k], angles[k])
        local = model.forward_local(angles[k])
        assert np.allclose(one.positions, many.positions[k])
        assert np.allclose(one.rotations, many.rotations[k])
        assert np.allclose(one.positions, local.positions @ T[k, :3, :3].T + T[k, :3, 3])


def test_measured_bones_replace_proportional_ones() -> None:
    given_lengths = {"index_intermediate": 0.050, "index_proximal": 0.080, "thumb_tip": 0.022, "palm": 0.055}
    joints = HandModel.from_file(HandFile(bones_m=given_lengths), "right").forward_local(BENT)
    for child, length in given_lengths.items():
        parent = PARENTS[child]
        assert np.linalg.norm(joints.position(child) - joints.position(str(parent))) == pytest.approx(length)


def test_size_scales_with_length() -> None:
    small, large = (HandModel.from_file(HandFile(length_m=length), "right") for length in (0.15, 0.225))
    assert np.allclose(large.bones, small.bones * 1.5)
    assert np.allclose(large.knuckles, small.knuckles * 1.5)
    assert np.allclose(large.radii, small.radii * 1.5)


def test_cap_centre_is_that_of_the_painted_volume(model: HandModel) -> None:
    marker = MarkerConfig(hand=model.side, joint="index_tip")
    radius = model.radii[JOINTS.index("index_tip")]
    length = CAP_SHARE * (model.bones[FINGERS.index("index"), 2] + radius)
    # Monte Carlo over the painted part of a capsule: z = 0 at the tip joint, the very tip at −radius.
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (200_000, 3)) * (radius, radius, length)
    inside = (np.hypot(points[:, 0], points[:, 1]) < radius) & (points[:, 2] < length - radius)
    inside &= np.where(points[:, 2] < 0.0, np.linalg.norm(points, axis=1) < radius, True)
    expected = points[inside].mean(axis=0)
    assert np.allclose(model.marker_offset("index", marker), expected, atol=1e-4)


def test_joints_are_inside_the_heads_of_bones_and_lengths_stay_whole(model: HandModel) -> None:
    """Centres lie a head's radius before a bone's end, so a knuckle is nearer to the wrist and the hand as long."""
    scale = model.length_m / REFERENCE_LENGTH_M / 1000.0
    bones, knuckle = model.bones[FINGERS.index("middle")], model.knuckles[FINGERS.index("middle")]
    tip = model.radii[JOINTS.index("middle_tip")]
    assert -knuckle[2] + bones.sum() + tip == pytest.approx(model.length_m, abs=1e-4)
    assert -knuckle[2] == pytest.approx((28.0 + 64.60 - 7.0) * scale, abs=1e-4)
    # From the crease over the last joint to the very tip: 0.12 to 0.14 hand lengths.
    assert 0.115 < (bones[2] + tip) / model.length_m < 0.14


def test_markers_and_patch_move_with_the_hand(model: HandModel) -> None:
    patch = MarkerConfig(hand=model.side, joint="wrist", kind="patch", size_m=(0.04, 0.03))
    other = MarkerConfig(hand="left" if model.side == "right" else "right", joint="index_tip")
    T = np.eye(4)
    T[:3, :3] = rotation_y(0.7) @ rotation_x(0.3)
    T[:3, 3] = 0.1, 0.2, 0.8
    joints = model.forward(T, BENT)
    centres = model.marker_positions(joints, {"base": patch, "other": other})
    assert set(centres) == {"base"}
    corners = model.patch_corners(joints, patch)
    assert np.allclose(corners.mean(axis=0), centres["base"])
    assert np.linalg.norm(corners[1] - corners[0]) == pytest.approx(0.04)
    assert np.linalg.norm(corners[2] - corners[1]) == pytest.approx(0.03)
    local = (centres["base"] - T[:3, 3]) @ T[:3, :3]
    assert local[1] > 0.01
    assert local[2] == pytest.approx(-0.025, abs=1e-3)


def test_measured_marker_offset_wins() -> None:
    hand = HandFile(marker_offsets_m={"index": (0.001, 0.002, 0.003)})
    model = HandModel.from_file(hand, "right")
    assert model.marker_offset("index", MarkerConfig(joint="index_tip")) == pytest.approx((0.001, 0.002, 0.003))


def test_limits_are_the_stated_ones(model: HandModel) -> None:
    low, high = np.degrees(model.angle_min), np.degrees(model.angle_max)
    assert np.allclose(low[1:, (0, 2, 3)], 0.0)
    assert np.allclose(high[1:, (0, 2, 3)], (90.0, 110.0, 90.0))
    assert np.allclose(high[1:, 1] - low[1:, 1], 30.0)
    # The middle of the range of abduction goes on straight from the metacarpal.
    middle = np.zeros((5, 4))
    middle[:, 1] = 0.5 * (model.angle_min[:, 1] + model.angle_max[:, 1])
    first = np.diff(model.finger_chains(middle)[0], axis=1)[1:, 0]
    metacarpal = (model.knuckles - model.metacarpals)[1:]
    aside = np.arctan2(first[:, 0], first[:, 2]) - np.arctan2(metacarpal[:, 0], metacarpal[:, 2])
    assert np.degrees(np.abs(np.arctan2(np.sin(aside), np.cos(aside)))).max() < 1.0
    clamped = model.clamp(np.full((5, 4), 9.0))
    assert np.allclose(clamped, model.angle_max)
