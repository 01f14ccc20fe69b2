from __future__ import annotations

import numpy as np

from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_vector, vector_from_rotation
from rhot.messages import HeadPose
from rhot_feet.head_track import HeadTrack

START_NS = 1_700_000_000_000_000_000
RATE = np.array([0.0, 1.0, 0.0])


def pose(t_s: float, state: str = "measured") -> HeadPose:
    x, y, z, w = quaternion_from_rotation(rotation_from_vector(t_s * RATE)).tolist()
    return HeadPose.model_validate(
        {
            "t_ns": START_NS + round(1e9 * t_s),
            "seq": 0,
            "frame": "rig",
            "position": (t_s, 1.6, 0.0),
            "orientation": (x, y, z, w),
            "state": state,
        }
    )


def track(*times_s: float) -> HeadTrack:
    heads = HeadTrack()
    for t_s in times_s:
        heads.add(pose(t_s))
    return heads


def ns(t_s: float) -> int:
    return START_NS + round(1e9 * t_s)


def test_lies_between_its_neighbours_however_they_arrive() -> None:
    for order in ((0.0, 0.01, 0.02), (0.02, 0.0, 0.01)):
        T = track(*order).at(ns(0.014))
        assert T is not None
        np.testing.assert_allclose(T[:3, 3], [0.014, 1.6, 0.0], atol=1e-12)
        np.testing.assert_allclose(vector_from_rotation(T[:3, :3]), 0.014 * RATE, atol=1e-9)


def test_goes_on_for_a_moment_and_then_is_unknown() -> None:
    heads = track(0.0, 0.01)
    ahead = heads.at(ns(0.03))
    assert ahead is not None
    np.testing.assert_allclose(ahead[:3, 3], [0.03, 1.6, 0.0], atol=1e-9)
    assert heads.at(ns(0.05)) is None
    assert heads.at(ns(-0.001)) is None


def test_no_pose_within_a_gap() -> None:
    heads = track(0.0, 0.01, 0.2, 0.21)
    assert heads.at(ns(0.1)) is None
    assert heads.at(ns(0.205)) is not None


def test_a_predicted_head_does_not_count() -> None:
    heads = track(0.0, 0.01)
    heads.add(pose(0.035, "predicted"))
    assert heads.at(ns(0.045)) is None


def test_keeps_one_second() -> None:
    heads = track(*np.arange(0.0, 3.0, 0.01).tolist())
    assert heads.at(ns(1.5)) is None
    assert heads.at(ns(2.5)) is not None


def test_a_moment_is_awaited_while_poses_come_but_none_reaches_it() -> None:
    heads = track(0.0, 0.01)
    assert not heads.awaits(ns(0.02)), "the head goes on as it did"
    assert heads.awaits(ns(0.1))
    assert not heads.awaits(ns(2.0)), "no pose has come for long"
    assert not HeadTrack().awaits(ns(0.0))
