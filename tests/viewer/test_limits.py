"""Fans of the joint limits: they begin and end where the model's angles do, about the hand that is shown."""

from __future__ import annotations

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from rhot.messages import FingerAngles, HandPose, Joint
from rhot.messages.base import wire_position
from rhot.rig import HandFile
from rhot_viewer.scene.drawn import LINES, STEPS, limit_lines

MODEL = HandModel.from_file(HandFile(), "left")


def pose(angles: FloatArray, fingers: tuple[str, ...] = FINGERS) -> tuple[HandPose, FloatArray]:
    """Return a pose with these angles (5, 4), and its joints (26, 3)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector(np.array([0.4, -0.7, 0.2])), (0.1, -0.05, 0.8)
    joints = MODEL.forward(T, angles)
    x, y, z, w = quaternion_from_rotation(T[:3, :3])
    shown = {
        name: Joint(position=wire_position(place), orientation=(x, y, z, w), radius=0.008)
        for name, place in zip(JOINTS, joints.positions, strict=True)
    }
    named = {
        finger: FingerAngles(mcp_flexion=a, mcp_abduction=b, pip_flexion=c, dip_flexion=d)
        for finger, (a, b, c, d) in zip(FINGERS, angles, strict=True)
        if finger in fingers
    }
    message = HandPose(t_ns=1, frame="rig", side="left", joints=shown, angles=named, residual={}, state="measured")
    return message, joints.positions


def test_fans_end_at_the_limits_and_hold_the_joints() -> None:
    angles = MODEL.clamp(np.tile([0.6, 0.05, 0.7, 0.4], (5, 1)))
    message, positions = pose(angles)
    lines = limit_lines(MODEL, message)
    assert lines is not None
    assert lines.shape == (LINES, 2, 3)
    # The first fan: flexion of the thumb's first joint; its arc passes where that bone ends now.
    low, high = angles.copy(), angles.copy()
    low[:, 0], high[:, 0] = MODEL.angle_min[:, 0], MODEL.angle_max[:, 0]
    np.testing.assert_allclose(lines[0, 0], pose(low)[1][JOINTS.index("thumb_proximal")], atol=1e-9)
    np.testing.assert_allclose(lines[STEPS - 1, 1], pose(high)[1][JOINTS.index("thumb_proximal")], atol=1e-9)
    hub = positions[JOINTS.index("thumb_metacarpal")]
    np.testing.assert_allclose(lines[STEPS : STEPS + 2, 0], [hub, hub], atol=1e-9)
    for joint in ("index_intermediate", "little_distal", "ring_tip"):
        away = np.linalg.norm(lines.reshape(-1, 3) - positions[JOINTS.index(joint)], axis=1).min()
        assert away < 0.01, joint


def test_hand_without_all_angles_has_no_fans() -> None:
    assert limit_lines(MODEL, pose(np.zeros((5, 4)), FINGERS[:4])[0]) is None
