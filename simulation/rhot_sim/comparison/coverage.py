"""How much of what both cameras could see was tracked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot_sim.comparison.collect import PointsSample
from rhot_sim.rendering.coverage import MarkerCoverage

VISIBLE_SHARE: Final = 0.25
"""A marker counts as visible to a camera when at least this share of its whole silhouette is.

Skin hides the rear of a painted fingertip: an unhidden one shows about half of its silhouette.
"""
NEAR_FRAMES: Final = 1.5
"""A sample is tracked when a point set lies this near to it, in frames of a camera."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """Shares of the samples that at least two cameras could see.

    Attributes:
        samples: number of (moment, marker) pairs.
        measured: share that was reported as measured.
        reported: share that was reported, predicted ones included.
        by_marker: measured share per marker.
    """

    samples: int
    measured: float
    reported: float
    by_marker: dict[str, float]


def visible_to_two(cameras: Mapping[str, MarkerCoverage], t_s: float) -> set[str]:
    """Return the markers that at least two cameras can see at a moment."""
    counts: Counter[str] = Counter()
    for camera in cameras.values():
        for name, view in camera.at(t_s).items():
            counts[name] += view.shows(VISIBLE_SHARE)
    return {name for name, number in counts.items() if number >= 2}


def coverage(
    cameras: Mapping[str, MarkerCoverage],
    times_s: NDArray[np.float64],
    points: Sequence[PointsSample],
    points_t_s: NDArray[np.float64],
    rate_hz: float,
) -> Coverage:
    """Compare what could be seen with what was reported.

    Args:
        cameras: what the true cameras see.
        times_s: (N,) moments to look at, seconds since the start.
        points: reported point sets in order of time.
        points_t_s: (M,) their times, seconds since the start.
        rate_hz: of the cameras.
    """
    visible: Counter[str] = Counter()
    measured: Counter[str] = Counter()
    reported: Counter[str] = Counter()
    for t_s in times_s.tolist():
        near = np.flatnonzero(np.abs(points_t_s - t_s) <= NEAR_FRAMES / rate_hz)
        nearest = [points[int(row)] for row in near[np.argsort(np.abs(points_t_s[near] - t_s))][:2]]
        for name in visible_to_two(cameras, t_s):
            visible[name] += 1
            seen = any(name in sample.measured for sample in nearest)
            measured[name] += seen
            reported[name] += seen or any(name in sample.predicted for sample in nearest)
    total = sum(visible.values())
    return Coverage(
        samples=total,
        measured=sum(measured.values()) / total if total else 0.0,
        reported=sum(reported.values()) / total if total else 0.0,
        by_marker={name: measured[name] / number for name, number in sorted(visible.items())},
    )
