"""The figures of a grasping session."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray
from rhot_tools.grasp.pickups import TOUCH_M, Pickup, find_pickups, flesh, gaps_m, opposed
from rhot_tools.grasp.session import TIPS, GraspSession
from rhot_tools.measures.rows import Row, Section

_MM = 1e3
_HELD_MARGIN_S = 0.15
"""At either end of the carrying, in which fingers still close or already open."""
_HELD = 0.8
"""Share of the carrying with thumb and a finger touching that makes it a successful grasp."""
_GAP = "gap: of the flesh of a fingertip from the surface; negative inside"


@dataclass(frozen=True, slots=True)
class GraspFigures:
    """What one session shows; P pick-ups.

    Attributes:
        pickups: the pick-ups, in order of time.
        gaps: (N, 26) metres.
        held: (P,) share of each carrying in which thumb and a finger touch.
        drift_m: (P,) how far the object wanders about its middle place in the palm, 95th percentile.
        recover_s: (P,) from the end of each release until every finger is measured; NaN where that never was.
        success: (P,) whether it counts as grasped.
    """

    pickups: list[Pickup]
    gaps: FloatArray
    held: FloatArray
    drift_m: FloatArray
    recover_s: FloatArray
    success: FloatArray


def grasp_figures(session: GraspSession) -> GraspFigures:
    """Return the figures of a session."""
    gaps = gaps_m(session)
    pickups = find_pickups(session, gaps)
    touching = opposed(gaps, TOUCH_M)
    held = np.array([float(np.mean(touching[_middle(session, each.carry)])) for each in pickups])
    return GraspFigures(
        pickups,
        gaps,
        held,
        np.array([drift_m(session, each.carry) for each in pickups]),
        np.array([_recover_s(session, each) for each in pickups]),
        (held >= _HELD).astype(np.float64),
    )


def grasp_sections(session: GraspSession, found: GraspFigures, true: GraspSession | None = None) -> list[Section]:
    """Return the tables.

    Args:
        session: as tracked.
        found: its figures.
        true: the true hand and object at the same moments, where they are known.
    """
    beside = None if true is None else grasp_figures(true)
    sections = [_whole(session, found, true, beside)]
    sections += [_phase(phase, session, found, beside) for phase in ("reach", "close", "carry", "release")]
    return sections


def _whole(
    session: GraspSession, found: GraspFigures, true: GraspSession | None, beside: GraspFigures | None
) -> Section:
    def peer(text: str) -> str:
        return "" if beside is None else f"truth: {text}"

    truly = beside or found
    rows = [
        Row("pick-ups", len(found.pickups), peer=peer(f"{len(truly.pickups)}")),
        Row(
            "held while carried",
            100.0 * _mean(found.success),
            "%",
            least=100.0,
            peer=peer(f"{100.0 * _mean(truly.success):.0f} %"),
            note="thumb and a finger touch in 80 % of the carrying; touching is a gap of 15 mm or less",
        ),
        Row(
            "drift between hand and held object, worst pick-up",
            _MM * _most(found.drift_m),
            "mm",
            most=5.0,
            peer=peer(f"{_MM * _most(truly.drift_m):.2f} mm"),
            note="95th percentile about the middle of the carrying, in the palm's frame",
        ),
        Row("until every finger is measured again, median", _median(found.recover_s), "s"),
        Row("until every finger is measured again, worst", _most(found.recover_s), "s"),
    ]
    if true is not None and beside is not None:
        rows.append(
            Row("lifted and put down, off by, worst", _MM * _timing_s(session, found, true, beside), "ms", most=100.0)
        )
    return Section("Pick-ups", tuple(rows))


def _phase(phase: str, session: GraspSession, found: GraspFigures, beside: GraspFigures | None) -> Section:
    rows = rows_of(phase, found)
    tips = list(TIPS)
    gaps = found.gaps[rows]
    deep = np.maximum(-gaps[:, flesh()], 0.0).max(axis=1) if len(rows) else np.zeros(0)
    truth = None
    if beside is not None and len(true_rows := rows_of(phase, beside)):
        truth = beside.gaps[true_rows]

    def peer(value: float) -> str:
        return f"truth: {value:.1f} mm"

    figures = [
        Row("fingers measured", 100.0 * _mean(session.measured[rows].astype(np.float64)), "%"),
        Row(
            "gap of thumb and nearest finger, median",
            _MM * _median(pinch(gaps)),
            "mm",
            peer="" if truth is None else peer(_MM * _median(pinch(truth))),
            note=_GAP,
        ),
        Row(
            "gap of all tips, median",
            _MM * _median(gaps[:, tips].ravel()),
            "mm",
            peer="" if truth is None else peer(_MM * _median(truth[:, tips].ravel())),
        ),
        Row(
            "deepest joint inside, median",
            _MM * _median(deep),
            "mm",
            peer="" if truth is None else peer(_MM * _median(np.maximum(-truth[:, flesh()], 0.0).max(axis=1))),
        ),
        Row("deepest joint inside, worst", _MM * _most(deep), "mm"),
    ]
    return Section(phase.capitalize(), tuple(figures))


def pinch(gaps: FloatArray) -> FloatArray:
    """Return of gaps (N, 26) the larger one (N,) of the thumb's and of the nearest other tip's."""
    tips = gaps[:, list(TIPS)]
    larger: FloatArray = np.maximum(tips[:, 0], tips[:, 1:].min(axis=1)) if len(tips) else np.zeros(0)
    return larger


def rows_of(phase: str, found: GraspFigures) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the poses of a phase, of all pick-ups."""
    ranges = [each.phases()[phase] for each in found.pickups]
    parts = [np.arange(one.start, one.stop) for one in ranges]
    return np.concatenate(parts).astype(np.int64) if parts else np.zeros(0, dtype=np.int64)


def _middle(session: GraspSession, carry: slice) -> slice:
    """Return the carrying without its ends, or all of it where little would be left."""
    t_s = session.t_s
    first = int(np.searchsorted(t_s, t_s[carry.start] + _HELD_MARGIN_S))
    last = int(np.searchsorted(t_s, t_s[carry.stop - 1] - _HELD_MARGIN_S))
    return slice(first, last) if last - first > 2 else carry


def drift_m(session: GraspSession, carry: slice) -> float:
    """Return how far the object wanders about its middle place in the palm while it is carried, 95th percentile."""
    rows = _middle(session, carry)
    off = session.objects[rows, :3, 3] - session.joints[rows, 0]
    local = np.einsum("nij,ni->nj", session.palm[rows], off)
    return float(np.percentile(np.linalg.norm(local - np.median(local, axis=0), axis=1), 95.0))


def _recover_s(session: GraspSession, pickup: Pickup) -> float:
    t_s = session.t_s
    end = min(pickup.release.stop, len(t_s) - 1)
    whole = np.flatnonzero(session.measured[end:].all(axis=1))
    return float(t_s[end + whole[0]] - t_s[end]) if len(whole) else float("nan")


def _timing_s(session: GraspSession, found: GraspFigures, true: GraspSession, beside: GraspFigures) -> float:
    """Return how far off lifting and putting down are at most, seconds; NaN where a pick-up is missing."""
    if len(found.pickups) != len(beside.pickups) or not found.pickups:
        return float("nan")
    pairs = zip(found.pickups, beside.pickups, strict=True)
    off = [
        abs(float(session.t_s[a] - true.t_s[b]))
        for one, other in pairs
        for a, b in (
            (one.carry.start, other.carry.start),
            (one.carry.stop - 1, other.carry.stop - 1),
        )
    ]
    return max(off)


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if values.size else float("nan")


def _median(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


def _most(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else float("nan")
