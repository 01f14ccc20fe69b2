from __future__ import annotations

import numpy as np
import pytest

from rhot.messages import CylinderShape, HeadPose, ObjectPose
from rhot.rig import RegistrationFile, RigidTransform
from rhot.stage import Output
from rhot_objects.pose import Pose
from rhot_objects.registration import Registration
from rhot_objects.sources import PoseSample
from rhot_objects.stage import HOLD_S, ObjectStage

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
    key, pose = only(ObjectStage(SHIFTED).feed({"cup": sample(7 * MS, 0.25)}, 8 * MS))
    assert key == "rhot/object/cup"
    assert (pose.state, pose.t_ns, pose.frame) == ("measured", 7 * MS, "rig")
    assert pose.position == pytest.approx((0.25, 0.0, 1.0))
    assert not isinstance(pose, HeadPose)


def test_an_object_states_its_shape_measured_or_predicted() -> None:
    cup = CylinderShape(radius=0.04, height=0.1)
    stage = ObjectStage(SHIFTED, shapes={"cup": cup})
    assert only(stage.feed({"cup": sample(0)}, 0))[1].shape == cup
    _, held = only(stage.feed({}, MS))
    assert (held.state, held.shape) == ("predicted", cup)
    assert only(ObjectStage(SHIFTED, shapes={"cup": cup}).feed({"pen": sample(0)}, 0))[1].shape is None
    assert only(stage.registered(SHIFTED).feed({"cup": sample(0)}, 0))[1].shape == cup, "registered again"


def test_the_headset_has_its_own_key_and_message() -> None:
    key, pose = only(ObjectStage(SHIFTED).feed({"head": sample(0)}, 0))
    assert key == "rhot/head"
    assert isinstance(pose, HeadPose)


def test_a_lost_object_is_held_briefly_and_then_not_published() -> None:
    stage = ObjectStage(SHIFTED)
    stage.feed({"cup": sample(0, 0.25)}, 0)
    hold_ns = round(HOLD_S * 1e9)
    _, held = only(stage.feed({}, hold_ns))
    assert (held.state, held.t_ns) == ("predicted", hold_ns)
    assert held.position == pytest.approx((0.25, 0.0, 1.0))
    assert stage.feed({}, hold_ns + 1) == []
    # Once given up it stays away, whatever the clock says, until it is measured again.
    assert stage.feed({}, hold_ns) == []
    assert only(stage.feed({"cup": sample(hold_ns)}, hold_ns))[1].state == "measured"


def test_objects_are_lost_one_by_one() -> None:
    stage = ObjectStage(SHIFTED)
    stage.feed({"cup": sample(0), "pen": sample(0)}, 0)
    states = {
        key: message.state
        for key, message in stage.feed({"pen": sample(10 * MS)}, 10 * MS)
        if isinstance(message, ObjectPose)
    }
    assert states == {"rhot/object/cup": "predicted", "rhot/object/pen": "measured"}


def test_nothing_is_held_that_lies_in_the_future() -> None:
    stage = ObjectStage(SHIFTED)
    stage.feed({"cup": sample(10**12)}, 10**12)
    assert stage.feed({}, 10**12 - 1) == []


def test_a_pose_that_no_message_can_carry_counts_as_lost() -> None:
    stage = ObjectStage(SHIFTED)
    stage.feed({"cup": sample(0)}, 0)
    _, held = only(stage.feed({"cup": sample(MS, 1e7)}, MS))
    assert held.state == "predicted"
    assert np.abs(held.position).max() < 2.0
    assert stage.unusable == 1
