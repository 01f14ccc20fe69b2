"""One foot for its leg: carried on when it is not seen, never with a leap."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rigid, rotation_x, rotation_y
from rhot.messages import FootPose, Side
from rhot_ik.legs.foot_track import FootTrack, HipMotion

UP = np.array([0.0, 1.0, 0.0])
ANKLE_M = np.array([0.0, 0.0, 0.07])
USUAL_M = np.array([0.09, -0.86, 0.0])
STEP_NS = 10_000_000
HIPS = HipMotion(rigid(np.eye(3), np.array([0.0, 0.95, 0.0])), np.zeros(3))


def track() -> FootTrack:
    return FootTrack(ANKLE_M, USUAL_M, UP)


def foot(
    t_ns: int,
    ankle: tuple[float, float, float],
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    sigma: float = 0.002,
    R: FloatArray | None = None,
    stationary: bool = False,
) -> FootPose:
    side: Side = "right"
    R = np.eye(3) if R is None else R
    x, y, z = (np.array(ankle) - R @ ANKLE_M).tolist()
    qx, qy, qz, qw = quaternion_from_rotation(R).tolist()
    return FootPose(
        t_ns=t_ns,
        side=side,
        frame="rig",
        position=(x, y, z),
        orientation=(qx, qy, qz, qw),
        velocity=velocity,
        sigma=sigma,
        stage="marker",
        stationary=stationary,
        state="measured",
    )


def position(tracked: FootTrack, t_ns: int) -> FloatArray:
    ankle = tracked.at(t_ns, HIPS)
    assert ankle is not None
    return ankle.position


def walked(tracked: FootTrack) -> int:
    """Feed a foot that stands and then swings forwards at 2 m/s through the position beneath its hip; return when."""
    for step in range(40):
        t_s = 0.01 * step
        moving = t_s > 0.2
        far = -2.0 * (t_s - 0.3) if moving else 0.2
        tracked.update(
            foot(step * STEP_NS, (0.09, 0.09, far), (0.0, 0.0, -2.0 if moving else 0.0), stationary=not moving)
        )
        tracked.at(step * STEP_NS, HIPS)
    return 39 * STEP_NS


def test_a_measured_foot_is_where_it_was_measured() -> None:
    tracked = track()
    for step in range(30):
        where = (0.1, 0.1, -0.01 * step)
        tracked.update(foot(step * STEP_NS, where, (0.0, 0.0, -1.0)))
        np.testing.assert_allclose(position(tracked, step * STEP_NS), where, atol=1e-4)
    assert tracked.state == "measured"


def test_asking_twice_for_a_moment_takes_no_trust() -> None:
    tracked = track()
    for step in range(10):
        tracked.at(step * STEP_NS, HIPS)
        tracked.update(foot(step * STEP_NS, (0.1, 0.1, -0.02 * step), (0.0, 0.0, -2.0)))
        ankle = tracked.at(step * STEP_NS, HIPS)
    assert ankle is not None
    assert ankle.trust > 0.95
    np.testing.assert_allclose(ankle.position, [0.1, 0.1, -0.18], atol=0.001)


def test_a_foot_that_is_lost_in_its_swing_stays_with_its_hip() -> None:
    tracked = track()
    last_ns = walked(tracked)
    positions = np.array([position(tracked, last_ns + step * STEP_NS) for step in range(1, 201)])
    offs_m = np.linalg.norm((positions - [0.09, 0.09, 0.0])[:, [0, 2]], axis=1)
    # With its velocity it would be 4 m away.
    assert offs_m.max() < 0.45
    assert offs_m[-1] < 0.1
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() < 0.025, "it goes on as it moved, 2 m/s"
    assert positions[:, 1].min() > 0.0899, "not through the floor"


def test_a_foot_that_is_lost_under_a_table_stays_before_its_chair() -> None:
    tracked = track()
    for step in range(400):
        tracked.update(foot(step * STEP_NS, (0.09, 0.5, -0.45)))
        tracked.at(step * STEP_NS, HIPS)
    positions = np.array([position(tracked, (400 + step) * STEP_NS) for step in range(200)])
    assert np.linalg.norm(positions - [0.09, 0.5, -0.45], axis=1).max() < 0.1


def test_a_foot_that_is_lost_tiptoe_becomes_level() -> None:
    tracked = track()
    tracked.update(foot(0, (0.09, 0.09, 0.0), R=rotation_x(-0.8)))
    for step in range(99):
        tracked.at(step * STEP_NS, HIPS)
    ankle = tracked.at(99 * STEP_NS, HIPS)
    assert ankle is not None
    assert np.degrees(np.arccos(ankle.T_rig_ankle[1, 1])) < 4.0


def test_a_foot_that_is_found_again_does_not_jump() -> None:
    tracked = track()
    last_ns = walked(tracked)
    positions = []
    for step in range(1, 101):
        t_ns = last_ns + step * STEP_NS
        if step > 50:
            tracked.update(foot(t_ns, (0.09, 0.09, 0.4)))
        positions.append(position(tracked, t_ns))
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    apart_m = np.linalg.norm(positions[49] - np.array([0.09, 0.09, 0.4]))
    assert apart_m > 0.4, "there is something to jump over"
    assert steps_m.max() < 0.08, "6 m/s, and what the pendulum does"
    np.testing.assert_allclose(positions[-1], [0.09, 0.09, 0.4], atol=0.001)


@pytest.mark.parametrize("turned", [True, False])
def test_a_measurement_that_leaps_is_not_followed_at_once(turned: bool) -> None:
    tracked = track()
    turns_rad, places_m = [], []
    T = np.eye(4)
    for step in range(60):
        gone = step >= 40
        where = (0.1, 0.1, -0.3 if gone and not turned else 0.0)
        R = rotation_y(2.0) if gone and turned else np.eye(3)
        tracked.update(foot(step * STEP_NS, where, R=R))
        ankle = tracked.at(step * STEP_NS, HIPS)
        assert ankle is not None
        T = ankle.T_rig_ankle
        turns_rad.append(float(np.arctan2(T[0, 2], T[0, 0])))
        places_m.append(T[2, 3])
    # Of 2 rad and of 300 mm.
    assert np.abs(np.diff(turns_rad)).max() < 0.6
    assert np.abs(np.diff(places_m)).max() < 0.09
    np.testing.assert_allclose(T, rigid(R, np.array(where)), atol=0.01)


def test_a_guessed_foot_is_no_longer_known_after_a_while() -> None:
    tracked = track()
    last_ns = walked(tracked)
    states = []
    for step in range(1, 60):
        tracked.update(foot(last_ns + step * STEP_NS, (0.09, 0.09, -0.18 - 0.02 * step), sigma=0.5))
        tracked.at(last_ns + step * STEP_NS, HIPS)
        states.append(tracked.state)
    assert states[0] == "predicted"
    assert 10 < states.index(None) < 30
    assert set(states[states.index(None) :]) == {None}


def test_a_foot_that_is_doubtful_from_the_start_is_not_known() -> None:
    tracked = track()
    tracked.update(foot(0, (0.1, 0.1, 0.0), sigma=0.4))
    assert tracked.at(0, HIPS) is not None
    assert tracked.state is None


def test_the_ankle_of_a_lifted_heel_moves_though_its_marker_rests() -> None:
    tracked = track()
    rate = 4.0
    # The marker stays where it is; the heel comes up around it.
    for step in range(20):
        R = rotation_x(-rate * 0.01 * step)
        ankle = tuple((R @ ANKLE_M).tolist())
        tracked.update(foot(step * STEP_NS, ankle, R=R))
        tracked.at(step * STEP_NS, HIPS)
    early, late = position(tracked, 19 * STEP_NS), position(tracked, 22 * STEP_NS)
    true_m = rotation_x(-rate * 0.22) @ ANKLE_M - rotation_x(-rate * 0.19) @ ANKLE_M
    np.testing.assert_allclose(late - early, true_m, atol=0.003)
    assert np.linalg.norm(true_m) > 0.008
