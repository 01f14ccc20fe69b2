from __future__ import annotations

import numpy as np
import pytest

from rhot.core import Output
from rhot.messages import CylinderShape, HeadPose, ObjectPose
from rhot.rig import RegistrationFile, RigidTransform
from rhot_objects.core import HOLD_S, ObjectCore
from rhot_objects.pose import Pose, Registration
from rhot_objects.sources import PoseSample

MS = 1_000_000
SHIFTED = Registration.from_file(
    RegistrationFile(T_rig_tracker=RigidTransform(position=(0.0, 0.0, 1.0), orientation=(0.0, 0.0, 0.0, 1.0)))
)


def sample(t_ns: int, x: float = 0.0) -> PoseSample:
    return PoseSample(t_ns, Pose.from_arrays((x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))


def only(outputs: list[Output]) -> tuple[str, ObjectPose]:
    ((key, message),) = outputs
    assert isinstance(message, ObjectPose)
    return key, message


def test_a_tracked_object_is_measured_in_the_rig_frame() -> None:
    key, pose = only(ObjectCore(SHIFTED).feed({"cup": sample(7 * MS, 0.25)}, 8 * MS))
    assert key == "rhot/object/cup"
    assert (pose.state, pose.t_ns, pose.frame) == ("measured", 7 * MS, "rig")
    assert pose.position == pytest.approx((0.25, 0.0, 1.0))
    assert not isinstance(pose, HeadPose)


def test_an_object_states_its_shape_measured_or_predicted() -> None:
    cup = CylinderShape(radius=0.04, height=0.1)
    core = ObjectCore(SHIFTED, shapes={"cup": cup})
    assert only(core.feed({"cup": sample(0)}, 0))[1].shape == cup
    _, held = only(core.feed({}, MS))
    assert (held.state, held.shape) == ("predicted", cup)
    assert only(ObjectCore(SHIFTED, shapes={"cup": cup}).feed({"pen": sample(0)}, 0))[1].shape is None
    assert only(core.registered(SHIFTED).feed({"cup": sample(0)}, 0))[1].shape == cup, "registered again"


def test_the_headset_has_its_own_key_and_message() -> None:
    key, pose = only(ObjectCore(SHIFTED).feed({"head": sample(0)}, 0))
    assert key == "rhot/head"
    assert isinstance(pose, HeadPose)


def test_a_lost_object_is_held_briefly_and_then_not_published() -> None:
    core = ObjectCore(SHIFTED)
    core.feed({"cup": sample(0, 0.25)}, 0)
    hold_ns = round(HOLD_S * 1e9)
    _, held = only(core.feed({}, hold_ns))
    assert (held.state, held.t_ns) == ("predicted", hold_ns)
    assert held.position == pytest.approx((0.25, 0.0, 1.0))
    assert core.feed({}, hold_ns + 1) == []
    # Once given up it stays away, whatever the clock says, until it is measured again.
    assert core.feed({}, hold_ns) == []
    assert only(core.feed({"cup": sample(hold_ns)}, hold_ns))[1].state == "measured"


def test_objects_are_lost_one_by_one() -> None:
    core = ObjectCore(SHIFTED)
    core.feed({"cup": sample(0), "pen": sample(0)}, 0)
    states = {
        key: message.state
        for key, message in core.feed({"pen": sample(10 * MS)}, 10 * MS)
        if isinstance(message, ObjectPose)
    }
    assert states == {"rhot/object/cup": "predicted", "rhot/object/pen": "measured"}


def test_nothing_is_held_that_lies_in_the_future() -> None:
    core = ObjectCore(SHIFTED)
    core.feed({"cup": sample(10**12)}, 10**12)
    assert core.feed({}, 10**12 - 1) == []


def test_a_pose_that_no_message_can_carry_counts_as_lost() -> None:
    core = ObjectCore(SHIFTED)
    core.feed({"cup": sample(0)}, 0)
    _, held = only(core.feed({"cup": sample(MS, 1e7)}, MS))
    assert held.state == "predicted"
    assert np.abs(held.position).max() < 2.0
    assert core.unusable == 1
