"""What could be seen over time against what was reported: coverage, and how occlusions are survived."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot_sim.comparison.coverage import NEAR_FRAMES, visible_to_two
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_tools.measures.points import PointTrack

SHORT_S: Final = 0.25
"""An occlusion up to this long is to be bridged."""
BACK_S: Final = 0.05
"""A marker is to be measured again this soon after both cameras see it again."""


@dataclass(frozen=True, slots=True)
class Survival:
    """What became of markers that were hidden for a while.

    Attributes:
        samples: (moment, marker) pairs in view of two cameras.
        measured: share of them that was measured.
        occlusions: short ones, with sight before and after.
        survived: share of these that were reported all through, and measured again in time.
        back_s: median time from sight to measurement, of all occlusions; NaN without any.
    """

    samples: int
    measured: float
    occlusions: int
    survived: float
    back_s: float


def visible_markers(cameras: Mapping[str, MarkerCoverage], names: Sequence[str], times_s: FloatArray) -> BoolArray:
    """Return (T, M) which markers at least two cameras see at times (T,), seconds since the world's start."""
    rows = [visible_to_two(cameras, t_s) for t_s in times_s.tolist()]
    return np.array([[name in row for name in names] for row in rows], dtype=np.bool_).reshape(-1, len(names))


def survival(track: PointTrack, times_s: FloatArray, visible: BoolArray, rate_hz: float) -> Survival:
    """Compare what could be seen with what was reported.

    Args:
        track: reported points.
        times_s: (T,) moments, evenly spaced, rising.
        visible: (T, M) which markers could be seen then.
        rate_hz: of the cameras.
    """
    reported, measured = _states(track, times_s, NEAR_FRAMES / rate_hz)
    samples = int(visible.sum())
    short, survived = 0, 0
    back: list[float] = []
    step_s = float(times_s[1] - times_s[0]) if len(times_s) > 1 else BACK_S
    for column in range(visible.shape[1]):
        for begin, end in _gaps(visible[:, column]):
            again = np.flatnonzero(measured[end:, column])
            wait_s = float(again[0]) * step_s if again.size else float("inf")
            back.append(wait_s)
            if (end - begin) * step_s <= SHORT_S:
                short += 1
                survived += bool(reported[begin:end, column].all() and wait_s <= BACK_S)
    return Survival(
        samples=samples,
        measured=float((measured & visible).sum() / samples) if samples else float("nan"),
        occlusions=short,
        survived=survived / short if short else float("nan"),
        back_s=float(np.median(back)) if back else float("nan"),
    )


def _states(track: PointTrack, times_s: FloatArray, near_s: float) -> tuple[BoolArray, BoolArray]:
    """Return (T, M) whether a marker was reported, and measured, in a set at most so near to each moment."""
    reported = np.zeros((len(times_s), len(track.names)), dtype=np.bool_)
    measured = reported.copy()
    there = np.isfinite(track.positions[:, :, 0])
    after = np.searchsorted(track.t_s, times_s)
    for index in (after - 1, after):
        row = np.clip(index, 0, max(len(track.t_s) - 1, 0))
        if not len(track.t_s):
            break
        near = (np.abs(track.t_s[row] - times_s) <= near_s)[:, None]
        reported |= there[row] & near
        measured |= track.measured[row] & near
    return reported, measured


def _gaps(visible: BoolArray) -> list[tuple[int, int]]:
    """Return first and past-the-last index of each stretch without sight that has sight before and after."""
    change = np.diff(visible.astype(np.int8))
    begins, ends = np.flatnonzero(change == -1) + 1, np.flatnonzero(change == 1) + 1
    gaps = []
    for begin in begins.tolist():
        later = ends[ends > begin]
        if later.size:
            gaps.append((begin, int(later[0])))
    return gaps
