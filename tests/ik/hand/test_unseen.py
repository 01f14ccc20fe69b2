"""Markers that no camera sees, or only one: held, carried, closed, and taken up again."""

from __future__ import annotations

import numpy as np
from hands.moving_hand import EASE, MakePoints, Wrist, moving_angles, moving_joints, only_pose, positions

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from rhot.messages import CylinderShape, HandPose, ObjectPose
from rhot.rig import Rig
from rhot_ik.core import IkCore
from rhot_ik.hand_core import HandCore


def test_a_hidden_finger_is_held_and_taken_up_again(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    core = HandCore(right_rig)
    errors = []
    for k in range(150):
        t_s = k / 60.0
        joints = right_hand.forward(wrist(), moving_angles(t_s, right_hand))
        hidden = 60 <= k < 85
        points = make_points(right_hand, joints, right_rig.config.markers, t_s, hide=("ring",) if hidden else ())
        pose = only_pose(core, points)
        assert pose.fingers["ring"] == ("predicted" if hidden else "measured")
        assert ("ring" in pose.residual) != hidden
        assert pose.state == "measured"
        errors.append(float(np.linalg.norm(positions(pose) - joints.positions, axis=1).max()))
    assert max(errors[60:85]) < 0.02
    assert max(errors[15:60] + errors[85:]) < 0.006


def test_hidden_base_is_carried_by_the_tips_then_given_up(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    core = HandCore(right_rig)
    previous, steps = None, []
    for k in range(60):
        T = wrist()
        T[0, 3] += 0.2 * k / 60.0
        joints = right_hand.forward(T, EASE)
        hide = ("base",) if 20 <= k < 40 else ()
        pose = only_pose(core, make_points(right_hand, joints, right_rig.config.markers, k / 60.0, hide=hide))
        assert pose.state == ("predicted" if hide else "measured")
        now = positions(pose)
        if previous is not None and k > 15:
            steps.append(np.linalg.norm(now - previous, axis=1).max())
        previous = now
        assert np.linalg.norm(now - joints.positions, axis=1).max() < 0.012
    assert max(steps) < 0.2 / 60.0 + 0.003
    late = [
        core.feed(make_points(right_hand, joints, right_rig.config.markers, 1.0 + k / 60.0, hide=("base",)))
        for k in range(60)
    ]
    published = [bool(out) for out in late]
    assert published[:28] == [True] * 28
    assert not any(published[32:])


def test_a_tip_that_returns_far_from_where_it_was_held_is_there_at_once(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """The ring finger curls alone while it is hidden, so that no neighbour tells of it."""
    core, errors = HandCore(right_rig), []
    for k in range(180):
        angles = EASE.copy()
        angles[3, 0] += np.radians(45.0) * np.clip((k - 70) / 20.0, 0.0, 1.0)
        angles[3, 2] += np.radians(55.0) * np.clip((k - 70) / 20.0, 0.0, 1.0)
        angles[3, 3] = right_hand.coupling[3] * angles[3, 2]
        joints = right_hand.forward(wrist(), right_hand.clamp(angles))
        hide = ("ring",) if 60 <= k < 100 else ()
        now = positions(only_pose(core, make_points(right_hand, joints, right_rig.config.markers, k / 60.0, hide=hide)))
        errors.append(np.linalg.norm(now - joints.positions, axis=1).max())
    assert errors[98] > 0.03
    assert max(errors[100:]) < 0.006


def test_a_ray_and_the_length_of_the_finger_give_its_depth(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """One camera sees the index finger: 100 mm unsure along its ray, and 60 mm off there."""
    core = HandCore(right_rig)
    tip = JOINTS.index("index_tip")
    errors = []
    for k in range(120):
        joints = moving_joints(k / 60.0, right_hand, wrist)
        points = make_points(right_hand, joints, right_rig.config.markers, k / 60.0)
        if k >= 60:
            seen = points.points["index"]
            ray = np.array(seen.position) / np.linalg.norm(seen.position)
            x, y, z = (np.array(seen.position) + 0.06 * ray).tolist()
            spread = 0.001**2 * np.eye(3) + 0.1**2 * np.outer(ray, ray)
            xx, xy, xz, yy, yz, zz = spread[np.triu_indices(3)].tolist()
            update = {"position": (x, y, z), "covariance": (xx, xy, xz, yy, yz, zz), "state": "one_view", "views": 1}
            points = points.model_copy(update={"points": points.points | {"index": seen.model_copy(update=update)}})
        pose = only_pose(core, points)
        assert pose.fingers["index"] == "measured"
        errors.append(np.linalg.norm(positions(pose)[tip] - joints.positions[tip]))
    assert np.median(errors[60:]) < 0.008
    assert np.percentile(errors[60:], 95) < 0.020


def test_a_hidden_finger_closes_with_its_neighbours(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    core, tip = HandCore(right_rig), JOINTS.index("ring_tip")
    errors = []
    for k in range(120):
        angles = EASE.copy()
        closed = np.clip((k - 40) / 40.0, 0.0, 1.0)
        angles[1:, 0] += np.radians(35.0) * closed
        angles[1:, 2] += np.radians(40.0) * closed
        angles[:, 3] = right_hand.coupling * angles[:, 2]
        joints = right_hand.forward(wrist(), right_hand.clamp(angles))
        hide = ("ring",) if k >= 45 else ()
        pose = only_pose(core, make_points(right_hand, joints, right_rig.config.markers, k / 60.0, hide=hide))
        errors.append(np.linalg.norm(positions(pose)[tip] - joints.positions[tip]))
    assert max(errors[45:]) < 0.025


def test_hidden_fingers_stop_at_the_cylinder_that_the_hand_holds(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """A rod of 70 mm across the palm; all fingers but the thumb go out of sight over it."""
    joints, markers = right_hand.forward(wrist(), EASE), right_rig.config.markers
    T, radius = wrist(), 0.035
    middle = T[:3, 3] + T[:3, :3] @ np.array([0.0, -0.055, -0.118])
    along = T[:3, :3] @ np.array([1.0, 0.0, 0.0])
    # The object's z along the knuckles.
    half = T[:3, :3] @ rotation_from_vector(np.array([0.0, np.pi / 2, 0.0]))
    x, y, z, w = quaternion_from_rotation(half).tolist()
    tips = [JOINTS.index(f"{finger}_tip") for finger in FINGERS[1:]]
    depth = {}
    for shape in (None, CylinderShape(radius=radius, height=0.2)):
        core = IkCore(right_rig)
        for k in range(150):
            points = make_points(right_hand, joints, markers, k / 60.0, hide=() if k < 30 else FINGERS[1:])
            place = {"position": tuple(middle.tolist()), "orientation": (x, y, z, w)}
            held = {"t_ns": points.t_ns, "frame": "rig", "state": "measured", "shape": shape} | place
            assert core.feed(ObjectPose.model_validate(held)) == []
            ((_, pose),) = core.feed(points)
            assert isinstance(pose, HandPose)
            off = positions(pose)[tips] - middle
        off -= np.outer(off @ along, along)
        depth[shape is None] = radius + right_hand.radii[tips] - np.linalg.norm(off, axis=1)
    assert depth[True].max() > 0.008
    assert depth[False].max() < 0.003


def test_a_tip_that_returns_and_moves_on_is_not_followed_behind(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """The ring finger comes back bent by some 25° more at either hinge, and bends on, its tip at 0.4 m/s."""
    core, T = HandCore(right_rig), wrist()
    tip, errors = JOINTS.index("ring_tip"), []
    for k in range(130):
        bent = np.clip(k - 75, 0.0, 1.0) + np.clip((k - 98) / 12.0, 0.0, 1.5)
        angles = EASE.copy()
        angles[3, 0] += np.radians(25.0) * bent
        angles[3, 2] += np.radians(30.0) * bent
        angles[3, 3] = right_hand.coupling[3] * angles[3, 2]
        joints = right_hand.forward(T, right_hand.clamp(angles))
        hide = ("ring",) if 60 <= k < 98 else ()
        points = make_points(right_hand, joints, right_rig.config.markers, k / 60.0, hide=hide)
        errors.append(float(np.linalg.norm(positions(only_pose(core, points))[tip] - joints.positions[tip])))
    assert errors[97] > 0.02
    assert max(errors[98:]) < 0.003
