"""One figure to quote: two markers a known distance apart, moved through the volume, and how far off that distance is.

This is the sphere-spacing error of VDI/VDE 2634 for a pair that moves, as ASTM E3064 measures motion capture with a
rod: it needs no second tracker and contains calibration, clocks, blur and triangulation, but nothing that shifts both
markers alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.messages import Point
from rhot_tools.measures.rows import Row, Section
from rhot_tools.rig.heard import Heard
from rhot_tools.rig.rows import figure_row
from rhot_tools.rig.statistics import mean, root_mean_square

_MM = 1e3
_LEAST = 100


@dataclass(frozen=True, slots=True)
class Distances:
    """A pair of markers over the moments at which both were measured.

    Attributes:
        error_m: (N,) measured minus true distance, metres.
        sigma_m: (N,) the deviation that fusion states for it, metres; NaN where it states none.
        middle_m: (N, 3) middles of the pair, metres, rig frame.
        share: of the moments at which points were published.
    """

    error_m: FloatArray
    sigma_m: FloatArray
    middle_m: FloatArray
    share: float


def distances(heard: Heard, pair: tuple[str, str], length_m: float | None) -> Distances:
    """Return how far off the distance of two markers was.

    Args:
        heard: while the pair was moved.
        pair: names of the markers.
        length_m: true distance; None = what a simulated rig tells of each moment.

    Raises:
        ConfigError: no true distance is known, or the pair was measured too seldom.
    """
    first, second = pair
    seen = [
        (points.t_ns, points.points[first], points.points[second])
        for points in heard.points
        if all(name in points.points and points.points[name].state == "measured" for name in pair)
    ]
    if len(seen) < _LEAST:
        raise ConfigError(
            f"{first} and {second} were measured together {len(seen)} times, {_LEAST} are the least; are both in the "
            "pictures of two cameras (`rhot status`, or the page's Pictures)?"
        )
    t_ns = np.array([each[0] for each in seen], dtype=np.int64)
    one = np.array([each.position for _, each, _ in seen])
    other = np.array([each.position for _, _, each in seen])
    if length_m is None:
        true_m = _true_distances(heard, pair, t_ns)
        if true_m is None:
            raise ConfigError("--length-mm is missing: measure between the middles of the two markers with a caliper")
    else:
        true_m = np.full(len(t_ns), length_m)
    apart = one - other
    long = np.linalg.norm(apart, axis=1)
    along = apart / np.maximum(long, 1e-9)[:, None]
    variance = np.array([_along(u, a) + _along(u, b) for u, (_, a, b) in zip(along, seen, strict=True)])
    known = np.isfinite(true_m)
    return Distances(
        (long - true_m)[known], np.sqrt(variance)[known], (0.5 * (one + other))[known], len(seen) / len(heard.points)
    )


def distance_section(found: Distances, pair: tuple[str, str]) -> Section:
    """Return the figure to quote and what belongs to it: over which volume, how often seen, how honest the sigma."""
    low, high = np.percentile(found.middle_m, (2.5, 97.5), axis=0)
    volume = " x ".join(f"{_MM * side:.0f}" for side in high - low)
    off = np.abs(found.error_m)
    rows = [
        figure_row(
            "error of the distance, RMS",
            root_mean_square(found.error_m).scaled(_MM),
            "mm",
            note=f"to quote; in a volume of {volume} mm (x, y, z of the rig)",
        ),
        figure_row("error of the distance, mean", mean(found.error_m).scaled(_MM), "mm", note="a scale or a bias"),
        Row("error of the distance, p95", _MM * float(np.percentile(off, 95.0)), "mm"),
        Row("error of the distance, largest", _MM * float(off.max()), "mm"),
        Row("both markers measured", 100.0 * found.share, "%", note="of the moments at which points were published"),
    ]
    ratios = found.error_m / found.sigma_m
    if np.isfinite(ratios).any():
        rows.append(
            Row(
                "error over stated sigma, RMS",
                float(np.sqrt(np.nanmean(ratios**2))),
                note="1 = fusion's uncertainty is honest; less is cautious",
            )
        )
    return Section(f"Distance of {pair[0]} and {pair[1]}", tuple(rows))


def _along(direction: FloatArray, point: Point) -> float:
    """Return a point's variance along a direction (3,), square metres; NaN where it states no covariance."""
    if point.covariance is None:
        return float("nan")
    xx, xy, xz, yy, yz, zz = point.covariance
    return float(direction @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ direction)


def _true_distances(
    heard: Heard, pair: tuple[str, str], t_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
) -> FloatArray | None:
    """Return the true distance (N,), metres, at times; NaN beyond what the simulator told, None where it tells none."""
    known: Mapping[int, float] = {
        each.t_ns: float(np.linalg.norm(np.subtract(each.points[pair[0]], each.points[pair[1]])))
        for each in heard.truth
        if all(name in each.points for name in pair)
    }
    if len(known) < 2:
        return None
    times = np.array(sorted(known), dtype=np.int64)
    true = np.array([known[t] for t in times.tolist()])
    since, wanted = (times - times[0]).astype(np.float64), (t_ns - times[0]).astype(np.float64)
    found: FloatArray = np.interp(wanted, since, true, np.nan, np.nan)
    return found
