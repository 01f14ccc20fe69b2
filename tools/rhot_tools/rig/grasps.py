"""How a hand takes hold of an object, with what the tracker itself says its fingertips may be off."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.messages import HandPose, Message, ObjectPose, Point, PointSet, Side, Truth
from rhot.messages.base import Pose
from rhot.rig import Rig
from rhot_tools.export.poses import motions
from rhot_tools.grasp.figures import GraspFigures, drift_m, grasp_figures, grasp_sections, pinch, rows_of
from rhot_tools.grasp.pickups import as_true
from rhot_tools.grasp.session import TIPS, GraspSession, grasp_session, poses_at
from rhot_tools.measures.points import covariance_of
from rhot_tools.measures.rows import Row, Section
from rhot_tools.rig.heard import Heard
from rhot_tools.rig.statistics import Figure, figure_row, truth_row

# A grasping session as the simulated world's own messages tell it.

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


TimeArray = np.ndarray[tuple[int], np.dtype[np.int64]]

_MM: Final = 1e3
_SIGMAS: Final = 2.0
"""Standard deviations within which 95 of 100 errors lie."""
_SIGMAS_IN_SPACE: Final = 2.8
"""The same for the length of an error in space (chi-square, three degrees of freedom); a drift is such a length."""
_LATEST_NS: Final = 50_000_000
"""Points and poses further apart belong to different moments."""
_PHASES: Final = ("reach", "close", "carry", "release")


def grasps(rig: Rig, heard: Heard) -> list[Section]:
    """Return the tables of the pick-ups that were heard, the truth beside them on a simulated rig.

    Raises:
        ConfigError: no hand or no object, several of them, or an object without a shape.
    """
    session = grasp_session(heard.poses, None, None, None)
    found = grasp_figures(session)
    side = next(message.side for _, message in heard.poses if isinstance(message, HandPose))
    item = next(key.rsplit("/", 1)[1] for key, message in heard.poses if isinstance(message, ObjectPose))
    true = true_session(session, heard.truth, side, item) if heard.truth else None
    if not found.pickups:
        raise ConfigError(
            "nothing was picked up: the object did not move 3 cm with thumb and a finger near; measure for longer "
            "(--seconds), and see whether the object is tracked (`rhot status`)"
        )
    markers = {
        finger: name
        for name, marker in rig.config.markers.items()
        for finger in FINGERS
        if marker.hand == side and marker.joint == f"{finger}_tip"
    }
    doubt_m = tip_deviations(session, heard.points, markers)
    sections = grasp_sections(session, found, true)
    gaps = {phase: gap_figure(found, doubt_m, phase) for phase in _PHASES}
    drift = drift_figure(session, found, hand_deviations(heard.points, rig, side))
    sections += [
        Section(
            "Gap of thumb and nearest finger, and what it may be off",
            tuple(figure_row(phase, gap.scaled(_MM), "mm") for phase, gap in gaps.items()),
        ),
        Section(
            "Drift between hand and held object, and what it may be off",
            (figure_row("worst pick-up", drift.scaled(_MM), "mm"),),
        ),
    ]
    if true is not None:
        truly = grasp_figures(true)
        rows = [
            Row("pick-ups found, of those that there were", len(found.pickups) / max(len(truly.pickups), 1), least=1)
        ]
        for phase, gap in gaps.items():
            gap_m = pinch(truly.gaps[rows_of(phase, found)])
            value = float(np.median(gap_m)) if len(gap_m) else float("nan")
            rows.append(truth_row(f"gap, {phase}", gap.scaled(_MM), _MM * value, "mm"))
        drifted_m = max(drift_m(true, each.carry) for each in found.pickups)
        rows.append(truth_row("drift, worst pick-up", drift.scaled(_MM), _MM * drifted_m, "mm"))
        sections.append(Section("Grasping beside the simulator's truth (1: within its interval)", tuple(rows)))
    return sections


def tip_deviations(session: GraspSession, points: Sequence[PointSet], markers: Mapping[str, str]) -> FloatArray:
    """Return what fusion says that fingertips (N, 5) may be off towards the object, metres; NaN where it says nothing.

    Args:
        session: hand and object.
        points: in order of time.
        markers: finger to the name of the marker on its tip.
    """
    doubt_m = np.full((len(session.t_ns), len(FINGERS)), np.nan)
    times = np.array([each.t_ns for each in points], dtype=np.int64)
    if not len(times):
        return doubt_m
    away = session.joints[:, list(TIPS)] - session.objects[:, None, :3, 3]
    away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
    for row, t_ns in enumerate(session.t_ns.tolist()):
        at = int(np.searchsorted(times, t_ns, side="right")) - 1
        if at < 0 or t_ns - times[at] > _LATEST_NS:
            continue
        for column, finger in enumerate(FINGERS):
            point = points[at].points.get(markers.get(finger, ""))
            if point is not None:
                doubt_m[row, column] = _deviation(point, away[row, column])
    return doubt_m


def gap_figure(found: GraspFigures, doubt_m: FloatArray, phase: str) -> Figure:
    """Return the median gap of thumb and nearest finger in a phase, metres, and where it lies.

    All moments may err alike, so they tell no more of it than one; no interval where the two tips were mostly hidden.
    """
    rows = rows_of(phase, found)
    gaps = found.gaps[rows][:, list(TIPS)]
    if not len(rows):
        return Figure(float("nan"), float("nan"), float("nan"), 0.0, 0)
    nearest = 1 + gaps[:, 1:].argmin(axis=1)
    farther = np.where(gaps[:, 0] >= gaps[np.arange(len(rows)), nearest], 0, nearest)
    doubt = doubt_m[rows, farther]
    told = np.isfinite(doubt)
    value = float(np.median(pinch(found.gaps[rows])))
    reach = _SIGMAS * float(np.median(doubt[told])) if 2 * told.sum() > len(rows) else float("nan")
    return Figure(value, value - reach, value + reach, float(len(found.pickups)), len(rows))


def hand_deviations(points: Sequence[PointSet], rig: Rig, side: Side) -> tuple[TimeArray, FloatArray]:
    """Return times (N,), rig clock, and what fusion says that a marker of a hand may be off, metres (N,).

    It is the middle one of the hand's markers, each along its worst axis; NaN where none was measured.
    """
    names = [name for name, marker in rig.config.markers.items() if marker.hand == side]
    doubt_m = [
        [_worst_deviation(each.points[name]) for name in names if name in each.points and _measured(each.points[name])]
        for each in points
    ]
    times = np.array([each.t_ns for each in points], dtype=np.int64)
    return times, np.array([float(np.median(each)) if each else float("nan") for each in doubt_m])


def drift_figure(session: GraspSession, found: GraspFigures, doubt: tuple[TimeArray, FloatArray]) -> Figure:
    """Return how far the object drifts in the palm in the worst pick-up, metres, and where it lies.

    The palm is known from the hand's markers, no worse than one of them. Errors move an object that rests in the hand,
    so that a drift is never below zero and may all be error. Neighbouring moments err alike and tell no more than one.

    Args:
        session: hand and object.
        found: its figures.
        doubt: as `hand_deviations`.
    """
    if not len(found.drift_m):
        return Figure(float("nan"), float("nan"), float("nan"), 0.0, 0)
    worst = int(np.argmax(found.drift_m))
    carry, value = found.pickups[worst].carry, float(found.drift_m[worst])
    times, doubt_m = doubt
    within = (times >= session.t_ns[carry.start]) & (times <= session.t_ns[carry.stop - 1])
    told = doubt_m[within & np.isfinite(doubt_m)]
    reach = _SIGMAS_IN_SPACE * float(np.median(told)) if 2 * len(told) > within.sum() else float("nan")
    return Figure(value, value - min(reach, value), value + reach, float(len(found.pickups)), carry.stop - carry.start)


def _measured(point: Point) -> bool:
    return point.state == "measured"


def _worst_deviation(point: Point) -> float:
    if point.covariance is None:
        return point.sigma
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance_of(point))[-1]), 0.0))


def _deviation(point: Point, along: FloatArray) -> float:
    if point.covariance is None:
        return point.sigma
    variance = float(along @ covariance_of(point) @ along)
    return math.sqrt(max(variance, 0.0))
