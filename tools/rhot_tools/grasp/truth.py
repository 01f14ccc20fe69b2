"""A grasping session as the simulated world's own messages tell it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rhot.anatomy.skeleton import JOINTS
from rhot.messages import Message, ObjectPose, Truth
from rhot.messages.base import Pose
from rhot_tools.export.poses import motions
from rhot_tools.grasp.pickups import as_true
from rhot_tools.grasp.session import GraspSession, poses_at

_PARTS = (*JOINTS, "object")


def true_session(session: GraspSession, truth: Sequence[Truth], side: str, item: str) -> GraspSession | None:
    """Return the same moments with the true hand and object; None where the truth does not tell them throughout.

    Args:
        session: as tracked.
        truth: of the simulated world, in order of time.
        side: of the hand.
        item: id of the object.
    """
    known = [each for each in truth if side in each.hands and item in each.objects]
    if len(known) < 2 or known[0].t_ns > session.t_ns[0] or known[-1].t_ns < session.t_ns[-1]:
        return None
    rigid: list[tuple[str, Message]] = []
    for each in known:
        poses: dict[str, Pose] = {**each.hands[side], "object": each.objects[item]}
        rigid += [(f"rhot/object/{part}", _posed(each, poses[part])) for part in _PARTS]
    found = motions(rigid)
    parts = {part: poses_at(found[f"object_{part}"], session.t_ns) for part in _PARTS}
    joints = np.stack([parts[joint][:, :3, 3] for joint in JOINTS], axis=1)
    return as_true(session, joints, parts["palm"][:, :3, :3], parts["object"])


def _posed(truth: Truth, pose: Pose) -> ObjectPose:
    return ObjectPose(
        t_ns=truth.t_ns, frame=truth.frame, position=pose.position, orientation=pose.orientation, state="measured"
    )
