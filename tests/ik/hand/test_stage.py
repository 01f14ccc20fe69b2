from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.anatomy.hand import HandJoints, HandModel
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from rhot.messages import CylinderShape, HandPose, ObjectPose, PointSet, decode, encode
from rhot.rig import HandFile, IkConfig, Rig
from rhot_ik.hand.fingers.closed_form import AnalyticFingers
from rhot_ik.hand.fingers.geometry import FingerGeometry
from rhot_ik.hand.stage import HandStage
from rhot_ik.whole_stage import WholeStage

FloatArray = NDArray[np.float64]
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


def only_pose(stage: HandStage, points: PointSet) -> HandPose:
    ((key, pose),) = stage.feed(points)
    assert isinstance(pose, HandPose)
    assert key == f"rhot/hand/{pose.side}"
    return pose


def positions(pose: HandPose) -> FloatArray:
    return np.array([pose.joints[name].position for name in JOINTS])


def test_first_sample_gives_a_full_valid_message(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    joints = right_hand.forward(wrist(), EASE)
    pose = only_pose(HandStage(right_rig), make_points(right_hand, joints, right_rig.config.markers, 0.0))
    assert tuple(pose.joints) == JOINTS
    assert decode(encode(pose), HandPose) == pose
    assert pose.state == "measured"
    assert set(pose.fingers.values()) == {"measured"}
    assert set(pose.residual) == set(FINGERS)
    assert max(pose.residual.values()) < 2e-3


@dataclass(frozen=True, slots=True)
class Case:
    solver: str
    corners: bool
    middle_mm: float


CASES = [Case(s, c, mm) for s in ("filter", "analytic", "fabrik") for c, mm in ((True, 4.0), (False, 10.0))]


@pytest.mark.parametrize("case", CASES)
def test_moving_hand_is_followed(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist, case: Case
) -> None:
    stage = HandStage(right_rig)
    stage.configure(IkConfig.model_validate({"solver": case.solver}))
    tips = [JOINTS.index(f"{finger}_tip") for finger in FINGERS]
    middle = [k for k, name in enumerate(JOINTS) if name.endswith(("proximal", "intermediate", "distal"))]
    errors = []
    for k in range(90):
        t_s = k / 60.0
        T = wrist((0.2 * np.sin(2.0 * t_s), 0.15 * np.sin(1.3 * t_s), 0.25 * np.sin(1.7 * t_s)))
        T[0, 3] += 0.1 * np.sin(3.0 * t_s)
        joints = right_hand.forward(T, moving_angles(t_s, right_hand))
        points = make_points(right_hand, joints, right_rig.config.markers, t_s, corners=case.corners)
        errors.append(np.linalg.norm(positions(only_pose(stage, points)) - joints.positions, axis=1) * 1e3)
    settled = np.array(errors)[15:]
    assert np.percentile(settled[:, tips], 95) < 1.5
    assert np.percentile(settled[:, middle], 95) < case.middle_mm


def test_noise_of_a_millimetre_stays_a_few_millimetres(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    stage = HandStage(right_rig)
    joints = right_hand.forward(wrist((0.2, 0.1, -0.2)), EASE)
    rng = np.random.default_rng(1)
    seen = []
    for k in range(120):
        noise = rng.normal(0.0, 0.001, (6, 3))
        points = make_points(right_hand, joints, right_rig.config.markers, k / 60.0, noise=noise)
        seen.append(positions(only_pose(stage, points)))
    error = np.linalg.norm(np.array(seen) - joints.positions, axis=-1)
    assert np.percentile(error, 95) < 0.008


def test_hidden_finger_is_held_and_rejoins_without_a_step(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    stage = HandStage(right_rig)
    previous, largest_step, largest_true = None, 0.0, 0.0
    before = None
    for k in range(150):
        t_s = k / 60.0
        joints = right_hand.forward(wrist(), moving_angles(t_s, right_hand))
        hidden = 60 <= k < 85
        points = make_points(right_hand, joints, right_rig.config.markers, t_s, hide=("ring",) if hidden else ())
        pose = only_pose(stage, points)
        assert pose.fingers["ring"] == ("predicted" if hidden else "measured")
        assert ("ring" in pose.residual) != hidden
        assert pose.state == "measured"
        now = positions(pose)
        if previous is not None and before is not None and k > 15:
            largest_step = max(largest_step, float(np.linalg.norm(now - previous, axis=1).max()))
            largest_true = max(largest_true, float(np.linalg.norm(joints.positions - before, axis=1).max()))
        previous, before = now, joints.positions
    assert largest_step < largest_true + 0.007


def test_hidden_base_is_carried_by_the_tips_then_given_up(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    stage = HandStage(right_rig)
    previous, steps = None, []
    for k in range(60):
        T = wrist()
        T[0, 3] += 0.2 * k / 60.0
        joints = right_hand.forward(T, EASE)
        hide = ("base",) if 20 <= k < 40 else ()
        pose = only_pose(stage, make_points(right_hand, joints, right_rig.config.markers, k / 60.0, hide=hide))
        assert pose.state == ("predicted" if hide else "measured")
        now = positions(pose)
        if previous is not None and k > 15:
            steps.append(np.linalg.norm(now - previous, axis=1).max())
        previous = now
        assert np.linalg.norm(now - joints.positions, axis=1).max() < 0.012
    assert max(steps) < 0.2 / 60.0 + 0.003
    late = [
        stage.feed(make_points(right_hand, joints, right_rig.config.markers, 1.0 + k / 60.0, hide=("base",)))
        for k in range(60)
    ]
    published = [bool(out) for out in late]
    assert published[:28] == [True] * 28
    assert not any(published[32:])


def test_nothing_seen_nothing_published(right_rig: Rig) -> None:
    stage = HandStage(right_rig)
    assert stage.feed(PointSet(t_ns=10**18, frame="rig", points={})) == []
    assert stage.counts["no_hand"] == 1
    assert stage.counts["hands"] == 0


def test_time_may_stand_still_jump_and_go_back(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    stage = HandStage(right_rig)
    joints = right_hand.forward(wrist(), EASE)
    for t_s in (0.0, 0.0, 0.016, 1000.0, 1000.016, 3.0, 3.016, 3.016):
        pose = only_pose(stage, make_points(right_hand, joints, right_rig.config.markers, t_s))
        assert np.isfinite(positions(pose)).all()
        assert np.linalg.norm(positions(pose) - joints.positions, axis=1).max() < 0.012
    # A sample that only came out of order is left out.
    assert stage.feed(make_points(right_hand, joints, right_rig.config.markers, 3.0)) == []


def test_wild_points_never_break_it(
    right_rig: Rig, make_points: MakePoints, right_hand: HandModel, wrist: Wrist
) -> None:
    stage = HandStage(right_rig)
    joints = right_hand.forward(wrist(), EASE)
    rng = np.random.default_rng(8)
    names = list(right_rig.config.markers)
    for k in range(150):
        scale = 10.0 ** rng.uniform(-6.0, 2.5)
        hide = tuple(name for name in names if rng.random() < 0.3)
        noise = rng.normal(0.0, scale, (6, 3))
        points = make_points(right_hand, joints, right_rig.config.markers, k / 60.0, hide=hide, noise=noise)
        for _, pose in stage.feed(points):
            assert isinstance(pose, HandPose)
            assert np.isfinite(positions(pose)).all()
            for place, finger in enumerate(FINGERS):
                angles = np.array(list(pose.angles[finger].model_dump().values()))
                assert (angles >= right_hand.angle_min[place] - 1e-9).all()
                assert (angles <= right_hand.angle_max[place] + 1e-9).all()


@pytest.mark.parametrize(
    ("name", "position"), [("thumb", (1e3, -1e3, 1e3)), ("thumb", (0.5, 0.3, 0.8)), ("base", (1e3, 0.0, 0.0))]
)
def test_a_point_where_it_cannot_be_counts_as_not_seen(
    right_rig: Rig,
    right_hand: HandModel,
    make_points: MakePoints,
    wrist: Wrist,
    name: str,
    position: tuple[float, float, float],
) -> None:
    """The farthest that a message can say, and a tip half a metre from its palm."""
    stage, without = HandStage(right_rig), HandStage(right_rig)
    joints = right_hand.forward(wrist(), EASE)
    for k in range(30):
        points = make_points(right_hand, joints, right_rig.config.markers, k / 60.0)
        hidden = make_points(right_hand, joints, right_rig.config.markers, k / 60.0, hide=(name,))
        wild = points.points | {name: points.points[name].model_copy(update={"position": position})}
        seen, expected = (points, points) if k < 10 else (points.model_copy(update={"points": wild}), hidden)
        assert np.allclose(positions(only_pose(stage, seen)), positions(only_pose(without, expected)))
    assert stage.counts["outside"] + stage.counts["not_of_this_hand"] == 20


def test_two_hands_mirror_each_other(two_hands_rig: Rig, make_points: MakePoints, wrist: Wrist) -> None:
    stage = HandStage(two_hands_rig)
    mirror = np.diag([-1.0, 1.0, 1.0])
    T_right = wrist((0.1, 0.2, 0.15))
    T_left = T_right.copy()
    T_left[:3, :3] = mirror @ T_right[:3, :3] @ mirror
    T_left[0, 3] = -T_right[0, 3]
    for k in range(5):
        points = {}
        for side, T in (("right", T_right), ("left", T_left)):
            model = HandModel.from_file(HandFile(), "right" if side == "right" else "left")
            made = make_points(model, model.forward(T, EASE), two_hands_rig.config.markers, k / 60.0)
            points.update(made.points)
        poses = dict(stage.feed(PointSet(t_ns=made.t_ns, frame="rig", points=points)))
        right, left = poses["rhot/hand/right"], poses["rhot/hand/left"]
        assert isinstance(right, HandPose)
        assert isinstance(left, HandPose)
        assert np.allclose(positions(right) @ mirror, positions(left), atol=1e-6)
        assert right.angles["index"].mcp_flexion == pytest.approx(left.angles["index"].mcp_flexion, abs=1e-5)


def test_same_input_gives_the_same_output(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    samples = [
        make_points(
            right_hand, right_hand.forward(wrist(), moving_angles(k / 60, right_hand)), right_rig.config.markers, k / 60
        )
        for k in range(20)
    ]
    one, other = HandStage(right_rig), HandStage(right_rig)
    assert [one.feed(sample) for sample in samples] == [other.feed(sample) for sample in samples]


def least_s(call: Callable[[], object], times: int) -> float:
    """The least of many, without what others had the core for: what a busy machine leaves comparable."""
    took = []
    for _ in range(times):
        begin = time.thread_time()
        call()
        took.append(time.thread_time() - begin)
    return min(took)


@pytest.fixture
def costs_s(right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist) -> tuple[float, float, float]:
    """Five fingers in closed form; a sample; a stage and its first sample."""
    markers = right_rig.config.markers
    samples = [
        make_points(right_hand, right_hand.forward(wrist(), moving_angles(k / 60, right_hand)), markers, k / 60)
        for k in range(200)
    ]
    geometry = FingerGeometry.of(right_hand, markers)
    closed_form, tips = AnalyticFingers(geometry), geometry.marker_points(EASE)
    stage, coming = HandStage(right_rig), iter(samples)
    sample_s = least_s(lambda: stage.feed(next(coming)), len(samples))
    first_s = least_s(lambda: HandStage(right_rig).feed(samples[50]), 5)
    return least_s(lambda: closed_form.solve(tips), 200), sample_s, first_s


def test_a_stage_and_its_first_sample_cost_little(costs_s: tuple[float, float, float]) -> None:
    closed_form_s, _, first_s = costs_s
    # Development machine, busy: 57 us in closed form, 10 ms a stage and its first one.
    assert closed_form_s < 400e-6
    assert first_s < 300.0 * closed_form_s


def test_a_sample_costs_few_times_the_closed_form_of_five_fingers(costs_s: tuple[float, float, float]) -> None:
    closed_form_s, sample_s, _ = costs_s
    assert sample_s < 12.0 * closed_form_s


def test_a_tip_that_returns_far_from_where_it_was_held_makes_no_jump(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """The ring finger curls alone while it is hidden, so that no neighbour tells of it."""
    stage, steps, errors = HandStage(right_rig), [], []
    previous = None
    for k in range(180):
        angles = EASE.copy()
        angles[3, 0] += np.radians(45.0) * np.clip((k - 70) / 20.0, 0.0, 1.0)
        angles[3, 2] += np.radians(55.0) * np.clip((k - 70) / 20.0, 0.0, 1.0)
        angles[3, 3] = right_hand.coupling[3] * angles[3, 2]
        joints = right_hand.forward(wrist(), right_hand.clamp(angles))
        hide = ("ring",) if 60 <= k < 100 else ()
        now = positions(
            only_pose(stage, make_points(right_hand, joints, right_rig.config.markers, k / 60.0, hide=hide))
        )
        errors.append(np.linalg.norm(now - joints.positions, axis=1).max())
        if previous is not None and k >= 95:
            steps.append(np.linalg.norm(now - previous, axis=1).max())
        previous = now
    assert errors[98] > 0.03
    assert max(steps) < 0.008
    assert errors[-1] < 0.006


def test_points_with_a_larger_sigma_weigh_less(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """The base marker trembles by 12 mm in depth."""
    joints = right_hand.forward(wrist(), EASE)
    tremble = []
    for sigma in (0.0005, 0.03):
        stage, wrists = HandStage(right_rig), []
        for k in range(60):
            shift = np.zeros((6, 3))
            shift[5, 2] = 0.012 * (-1.0) ** k
            points = make_points(right_hand, joints, right_rig.config.markers, k / 60.0, noise=shift)
            base = points.points["base"].model_copy(update={"sigma": sigma})
            pose = only_pose(stage, points.model_copy(update={"points": points.points | {"base": base}}))
            wrists.append(positions(pose)[1])
        tremble.append(np.std(wrists[30:], axis=0).max())
    assert tremble[0] > 0.006
    assert tremble[1] < 0.3 * tremble[0]


def test_a_ray_and_the_length_of_the_finger_give_its_depth(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """One camera sees the index finger: 100 mm unsure along its ray, and 60 mm off there."""
    stage = HandStage(right_rig)
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
        pose = only_pose(stage, points)
        assert pose.fingers["index"] == "measured"
        errors.append(np.linalg.norm(positions(pose)[tip] - joints.positions[tip]))
    assert np.median(errors[60:]) < 0.008
    assert np.percentile(errors[60:], 95) < 0.020


def test_a_hidden_finger_closes_with_its_neighbours(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    stage, tip = HandStage(right_rig), JOINTS.index("ring_tip")
    errors = []
    for k in range(120):
        angles = EASE.copy()
        closed = np.clip((k - 40) / 40.0, 0.0, 1.0)
        angles[1:, 0] += np.radians(35.0) * closed
        angles[1:, 2] += np.radians(40.0) * closed
        angles[:, 3] = right_hand.coupling * angles[:, 2]
        joints = right_hand.forward(wrist(), right_hand.clamp(angles))
        hide = ("ring",) if k >= 45 else ()
        pose = only_pose(stage, make_points(right_hand, joints, right_rig.config.markers, k / 60.0, hide=hide))
        errors.append(np.linalg.norm(positions(pose)[tip] - joints.positions[tip]))
    assert max(errors[45:]) < 0.025


def test_where_the_patch_sits_and_how_long_fingers_are_is_learned(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    """A patch 8 mm nearer to the fingers and tilted by 5° than the model has it."""
    stage, T, late = HandStage(right_rig), wrist(), []
    R = T[:3, :3] @ rotation_from_vector(np.radians([5.0, 0.0, 0.0])) @ T[:3, :3].T
    for k in range(400):
        joints = moving_joints(k / 60.0, right_hand, wrist)
        points = make_points(right_hand, joints, right_rig.config.markers, k / 60.0)
        base = points.points["base"]
        middle, shift = np.array(base.position), -0.008 * T[:3, 2]
        corners = tuple(tuple((middle + shift + R @ (np.array(c) - middle)).tolist()) for c in base.corners or ())
        x, y, z = (middle + shift).tolist()
        moved = base.model_copy(update={"position": (x, y, z), "corners": corners})
        pose = only_pose(stage, points.model_copy(update={"points": points.points | {"base": moved}}))
        late.append(np.linalg.norm(positions(pose) - joints.positions, axis=1).mean())
    # A hand on the patch as the model has it would be off by 8 mm and 5°, which is 8 mm more at the knuckles.
    assert np.mean(late[300:]) < 0.006


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
        stage = WholeStage(right_rig)
        for k in range(150):
            points = make_points(right_hand, joints, markers, k / 60.0, hide=() if k < 30 else FINGERS[1:])
            place = {"position": tuple(middle.tolist()), "orientation": (x, y, z, w)}
            held = {"t_ns": points.t_ns, "frame": "rig", "state": "measured", "shape": shape} | place
            assert stage.feed(ObjectPose.model_validate(held)) == []
            ((_, pose),) = stage.feed(points)
            assert isinstance(pose, HandPose)
            off = positions(pose)[tips] - middle
        off -= np.outer(off @ along, along)
        depth[shape is None] = radius + right_hand.radii[tips] - np.linalg.norm(off, axis=1)
    assert depth[True].max() > 0.008
    assert depth[False].max() < 0.003
