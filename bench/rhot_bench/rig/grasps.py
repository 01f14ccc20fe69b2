"""How a hand takes hold of an object, with what the tracker itself says its fingertips may be off."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.messages import HandPose, ObjectPose, Point, PointSet
from rhot.rig import Rig
from rhot_bench.grasp.figures import GraspFigures, grasp_figures, grasp_sections, pinch, rows_of
from rhot_bench.grasp.session import TIPS, GraspSession, grasp_session
from rhot_bench.grasp.truth import true_session
from rhot_bench.measures.rows import Row, Section
from rhot_bench.motion.estimates import covariance_of
from rhot_bench.rig.heard import Heard
from rhot_bench.rig.rows import figure_row, truth_row
from rhot_bench.rig.statistics import Figure

_MM: Final = 1e3
_SIGMAS: Final = 2.0
"""Standard deviations within which 95 of 100 errors lie."""
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
    sections.append(
        Section(
            "Gap of thumb and nearest finger, and what it may be off",
            tuple(figure_row(phase, gap.scaled(_MM), "mm") for phase, gap in gaps.items()),
        )
    )
    if true is not None:
        truly = grasp_figures(true)
        rows = [
            Row("pick-ups found, of those that there were", len(found.pickups) / max(len(truly.pickups), 1), least=1)
        ]
        for phase, gap in gaps.items():
            gap_m = pinch(truly.gaps[rows_of(phase, found)])
            value = float(np.median(gap_m)) if len(gap_m) else float("nan")
            rows.append(truth_row(f"gap, {phase}", gap.scaled(_MM), _MM * value, "mm"))
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


def _deviation(point: Point, along: FloatArray) -> float:
    if point.covariance is None:
        return point.sigma
    variance = float(along @ covariance_of(point) @ along)
    return math.sqrt(max(variance, 0.0))
