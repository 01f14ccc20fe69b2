"""A hand that moves smoothly, and what a core makes of its markers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rhot.anatomy.hand import HandJoints, HandModel
from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot.messages import HandPose, PointSet
from rhot_ik.hand_core import HandCore

MakePoints = Callable[..., PointSet]
Wrist = Callable[..., FloatArray]

EASE = np.radians([[10.0, 5.0, 15.0, 15.0], *[[20.0, 0.0, 30.0, 20.0]] * 4])


def moving_angles(t_s: float, model: HandModel) -> FloatArray:
    phase = np.arange(5) * 0.7
    angles = EASE.copy()
    angles[:, 0] += np.radians(12.0) * np.sin(3.0 * t_s + phase)
    angles[:, 2] += np.radians(14.0) * np.sin(2.0 * t_s + 2.0 * phase)
    angles[:, 3] = model.coupling * angles[:, 2]
    return model.clamp(angles)


def moving_joints(t_s: float, model: HandModel, wrist: Wrist) -> HandJoints:
    return model.forward(wrist(), moving_angles(t_s, model))


def only_pose(core: HandCore, points: PointSet) -> HandPose:
    ((key, pose),) = core.feed(points)
    assert isinstance(pose, HandPose)
    assert key == f"rhot/hand/{pose.side}"
    return pose


def positions(pose: HandPose) -> FloatArray:
    return np.array([pose.joints[name].position for name in JOINTS])
