"""Whatever points arrive: nothing that is not a number, no angle beyond its limit, and no crash."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion, rotation_from_vector, vector_from_rotation
from rhot.messages import HandPose, Point, PointSet, State
from rhot.rig import CameraConfig, HandFile, MarkerConfig, Rig, RigConfig
from rhot.rig.folder import NO_REGISTRATION
from rhot_ik.hand.filter.evidence import HandObservation
from rhot_ik.hand.solver import HandSolver
from rhot_ik.hand.track import HandSolution
from rhot_ik.hand_core import HandCore

MakePoints = Callable[..., PointSet]
Wrist = Callable[..., FloatArray]

START_NS = 1_700_000_000_000_000_000
EASE = np.radians([[10.0, 5.0, 15.0, 15.0], *[[20.0, 0.0, 30.0, 20.0]] * 4])
NAMES = (*FINGERS, "base")

coordinate = st.floats(-0.09, 0.09)
a_point = st.tuples(
    coordinate, coordinate, st.floats(0.7, 0.9), st.sampled_from([0.0, 1e-6, 0.001, 0.02, 1e3]), st.booleans()
)
a_sample = st.tuples(
    st.sampled_from([0, 1, 1_000_000, 8_333_333, 50_000_000, 400_000_000, 5_000_000_000, -20_000_000, -3_000_000_000]),
    st.dictionaries(st.sampled_from(NAMES), a_point),
    st.booleans(),
)


def core_of_right_hand() -> HandCore:
    markers = {finger: MarkerConfig(joint=f"{finger}_tip") for finger in FINGERS}
    markers["base"] = MarkerConfig(joint="wrist", kind="patch", size_m=(0.04, 0.03))
    config = RigConfig(cameras={"left": CameraConfig()}, markers=markers)
    return HandCore(Rig(Path(), config, {}, True, HandFile(), NO_REGISTRATION))


def check(pose: HandPose, model: HandModel) -> None:
    positions = np.array([pose.joints[name].position for name in JOINTS])
    orientations = np.array([pose.joints[name].orientation for name in JOINTS])
    angles = np.array([list(pose.angles[finger].model_dump().values()) for finger in FINGERS])
    assert np.isfinite(positions).all()
    assert np.allclose(np.linalg.norm(orientations, axis=1), 1.0, atol=1e-6)
    assert (angles >= model.angle_min - 1e-12).all()
    assert (angles <= model.angle_max + 1e-12).all()


@settings(deadline=None, max_examples=30)
@given(samples=st.lists(a_sample, min_size=1, max_size=12))
def test_any_points_at_any_times_give_legal_finite_hands(
    samples: list[tuple[int, dict[str, tuple[float, float, float, float, bool]], bool]],
) -> None:
    core, model = core_of_right_hand(), HandModel.from_file(HandFile(), "right")
    t_ns = START_NS
    for step_ns, seen, flat in samples:
        t_ns += step_ns
        points = {}
        for name, (x, y, z, sigma, measured) in seen.items():
            corners = None
            if name == "base":
                # A square, or four corners in one place.
                size = 0.0 if flat else 0.02
                corners = ((x - size, y, z), (x, y - size, z), (x + size, y, z), (x, y + size, z))
            state: State = "measured" if measured else "predicted"
            points[name] = Point(position=(x, y, z), sigma=sigma, views=2, state=state, corners=corners)
        for _, pose in core.feed(PointSet(t_ns=t_ns, frame="rig", points=points)):
            assert isinstance(pose, HandPose)
            check(pose, model)


@pytest.mark.parametrize("dt_s", [0.0, 1e-9, 1e-3, 0.3, 0.9, 2.0])
def test_a_still_hand_stays_where_it_is_whatever_the_time_between_samples(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist, dt_s: float
) -> None:
    core = HandCore(right_rig)
    joints = right_hand.forward(wrist(), EASE)
    poses: list[HandPose] = []
    for k in range(60):
        t_s = k / 60.0 if k < 30 else 0.5 + (k - 30) * dt_s
        for _, pose in core.feed(make_points(right_hand, joints, right_rig.config.markers, t_s)):
            assert isinstance(pose, HandPose)
            check(pose, right_hand)
            poses.append(pose)
    assert len(poses) == 60
    found = np.array([[pose.joints[name].position for name in JOINTS] for pose in poses])
    assert np.linalg.norm(found[-1] - joints.positions, axis=1).max() < 0.006
    if dt_s < 1.0:
        assert np.linalg.norm(np.diff(found[20:], axis=0), axis=-1).max() < 0.004


@pytest.mark.parametrize("only", NAMES)
def test_one_marker_alone_is_no_hand_and_holds_one_only_for_a_while(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist, only: str
) -> None:
    joints = right_hand.forward(wrist(), EASE)
    markers = right_rig.config.markers
    alone = tuple(name for name in NAMES if name != only)
    assert HandCore(right_rig).feed(make_points(right_hand, joints, markers, 0.0, hide=alone)) == []
    core = HandCore(right_rig)
    for k in range(30):
        core.feed(make_points(right_hand, joints, markers, k / 60.0))
    last = []
    for k in range(30, 120):
        last = core.feed(make_points(right_hand, joints, markers, k / 60.0, hide=alone))
        for _, pose in last:
            assert isinstance(pose, HandPose)
            check(pose, right_hand)
            assert (pose.fingers.get(only) == "measured") == (only != "base")
    # The base alone still holds a hand; a tip alone does not say where the palm is.
    assert bool(last) == (only == "base")


def test_a_hand_of_predicted_points_alone_is_predicted_and_ends(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    core = HandCore(right_rig)
    joints = right_hand.forward(wrist(), EASE)
    poses = []
    for k in range(120):
        points = make_points(right_hand, joints, right_rig.config.markers, k / 60.0)
        if k >= 30:
            bridged = {
                name: point.model_copy(update={"state": "predicted", "corners": None, "views": 0})
                for name, point in points.points.items()
            }
            points = points.model_copy(update={"points": bridged})
        poses.append(core.feed(points))
    for out in poses[31:50]:
        ((_, pose),) = out
        assert isinstance(pose, HandPose)
        check(pose, right_hand)
        assert pose.state == "predicted"
        assert set(pose.fingers.values()) == {"predicted"}
    assert poses[-1] == []


def bare_solver(side: str) -> HandSolver:
    model = HandModel.from_file(HandFile(), "left" if side == "left" else "right")
    markers = {f: MarkerConfig(hand=model.side, joint=f"{f}_tip") for f in FINGERS}
    markers["base"] = MarkerConfig(hand=model.side, joint="wrist")
    config = RigConfig(cameras={"left": CameraConfig()}, markers=markers)
    return HandSolver(model, markers, "base", config.ik)


def test_a_mirrored_hand_moves_as_the_mirror_image() -> None:
    right, left = bare_solver("right"), bare_solver("left")
    model = right.geometry.model
    mirror = np.array([-1.0, 1.0, 1.0])
    rng = np.random.default_rng(5)
    for k in range(40):
        T = np.eye(4)
        T[:3, :3] = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]) @ rotation_from_vector(
            0.3 * np.sin(0.1 * k + np.arange(3))
        )
        T[:3, 3] = 0.02, 0.05 + 0.003 * k, 0.8
        angles = model.clamp(EASE + np.radians(15.0) * np.sin(0.2 * k + np.arange(5))[:, None])
        tips = right.geometry.marker_points(angles) @ T[:3, :3].T + T[:3, 3] + rng.normal(0.0, 0.0005, (5, 3))
        if k % 10 > 6:
            tips[k % 5] = np.nan
        seen = np.isfinite(tips[:, 0])
        t_ns = START_NS + round(k / 60.0 * 1e9)
        solutions: list[HandSolution | None] = []
        for solver, sign in ((right, np.ones(3)), (left, mirror)):
            solutions.append(solver.solve(HandObservation(t_ns, T[:3, 3] * sign, True, None, tips * sign, seen)))
        one, other = solutions
        assert one is not None
        assert other is not None
        assert np.allclose(one.positions * mirror, other.positions, atol=1e-6)
        assert np.allclose(one.angles, other.angles, atol=1e-5)


def test_a_hand_taken_up_the_wrong_way_round_is_right_again_within_a_second(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """The first second shows a hand turned by half a turn about its long axis, then the true one goes on."""
    core = HandCore(right_rig)
    T = wrist()
    turned = T.copy()
    turned[:3, :3] = T[:3, :3] @ rotation_from_vector(np.array([0.0, 2.0, 0.0]))
    error = np.inf
    for k in range(150):
        joints = right_hand.forward(turned if k < 60 else T, EASE)
        points = make_points(right_hand, joints, right_rig.config.markers, k / 60.0)
        for _, pose in core.feed(points):
            assert isinstance(pose, HandPose)
            check(pose, right_hand)
            found = np.array([pose.joints[name].position for name in JOINTS])
            error = float(np.linalg.norm(found - joints.positions, axis=1).max())
        if k == 119:
            assert error < 0.012
    assert error < 0.008


def test_what_five_tips_have_met_is_not_overturned_by_two(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """Three tips vanish and the two that are left lie where this hand cannot have them, for two seconds."""
    core, T = HandCore(right_rig), wrist()
    joints = right_hand.forward(T, EASE)
    markers = right_rig.config.markers
    turned = T[:3, :3] @ rotation_from_vector(np.array([0.0, 1.6, 0.0])) @ T[:3, :3].T
    largest = 0.0
    for k in range(150):
        points = make_points(right_hand, joints, markers, k / 60.0)
        if k >= 30:
            base = np.array(points.points["base"].position)
            seen = {"base": points.points["base"]}
            for name in ("index", "middle"):
                point = points.points[name]
                moved = base + turned @ (np.array(point.position) - base)
                seen[name] = point.model_copy(update={"position": tuple(moved.tolist())})
            points = points.model_copy(update={"points": seen})
        for _, pose in core.feed(points):
            assert isinstance(pose, HandPose)
            found = rotation_from_quaternion(np.array(pose.joints["wrist"].orientation))
            if k >= 30:
                largest = max(largest, float(np.linalg.norm(vector_from_rotation(T[:3, :3].T @ found))))
    assert np.degrees(largest) < 45.0


def test_a_hand_of_which_all_tips_say_that_it_was_turned_round_is_looked_for_at_once(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """It is shown as it is found: fingers of another palm are not led in from where they were."""
    core, T = HandCore(right_rig), wrist()
    turned = T.copy()
    turned[:3, :3] = T[:3, :3] @ rotation_from_vector(np.array([0.0, 2.0, 0.0]))
    for k in range(65):
        joints = right_hand.forward(turned if k < 60 else T, EASE)
        points = make_points(right_hand, joints, right_rig.config.markers, k / 60.0)
        ((_, pose),) = core.feed(points)
    assert isinstance(pose, HandPose)
    found = np.array([pose.joints[name].position for name in JOINTS])
    assert np.linalg.norm(found - joints.positions, axis=1).max() < 0.02
