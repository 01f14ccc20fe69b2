"""The offline reference: a cubic spline per camera and marker through the row times, and triangulation.

Nothing but interpolation: no model of motion, noise or the hand. It sees past and future and is what `--smooth` has to
beat on the same tracks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from rhot.arrays import FloatArray, IntArray
from rhot_bench.motion.references.views import Views, triangulated
from rhot_tools.measures.estimates import MEASURED, Estimates

_SHORTEST: Final = 4
"""A cubic needs four points; shorter tracks are left out."""


@dataclass(frozen=True, slots=True)
class SplineSettings:
    """How far the spline is believed.

    Attributes:
        gap_periods: frame periods between two views of one camera over which its spline is still read; chosen so that
            three frames lost in a row (once in 125 at the worst loss of the family, 20 %) do not break it.
    """

    gap_periods: float = 4.5


def spline_reference(views: Views, markers: int, settings: SplineSettings | None = None) -> Estimates:
    """Return the points at every row time of every camera at which another camera's spline can be read."""
    settings = settings or SplineSettings()
    origin = int(views.t_ns.min()) if len(views.t_ns) else 0
    parts: list[tuple[IntArray, IntArray, FloatArray]] = []
    for marker in range(markers):
        of_marker = np.flatnonzero(views.marker == marker)
        if not len(of_marker):
            continue
        t_ns = views.t_ns[of_marker]
        t_s = (t_ns - origin) * 1e-9
        xy = np.full((len(of_marker), len(views.P), 2), np.nan)
        for camera in range(len(views.P)):
            own = views.camera[of_marker] == camera
            xy[own, camera] = views.xy[of_marker[own]]
            if own.sum() >= _SHORTEST:
                longest_s = settings.gap_periods * views.period_s[camera]
                xy[~own, camera] = _read(t_s[own], views.xy[of_marker[own]], t_s[~own], longest_s)
        found = triangulated(xy, views.P)
        there = np.isfinite(found[:, 0])
        parts.append((t_ns[there], np.full(int(there.sum()), marker), found[there]))
    if not parts:
        return _estimates(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)))
    t_all, marker_all, position = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(t_all, kind="stable")
    return _estimates(t_all[order], marker_all[order], position[order])


def _estimates(t_ns: IntArray, marker: IntArray, position: FloatArray) -> Estimates:
    count = len(t_ns)
    return Estimates(t_ns, marker, position, np.full((count, 3, 3), np.nan), np.full(count, MEASURED))


def _read(t_s: FloatArray, xy: FloatArray, wanted_s: FloatArray, longest_s: float) -> FloatArray:
    """Return the spline (M, 2) through xy (N, 2) at times (M,); NaN outside and where views are too far apart."""
    read = np.full((len(wanted_s), 2), np.nan)
    # A gap breaks the track: through a longer one a cubic swings far out, on either side of it too.
    breaks = np.flatnonzero(np.diff(t_s) > longest_s) + 1
    for part in np.split(np.arange(len(t_s)), breaks):
        if len(part) < _SHORTEST:
            continue
        inside = (wanted_s >= t_s[part[0]]) & (wanted_s <= t_s[part[-1]])
        read[inside] = CubicSpline(t_s[part], xy[part])(wanted_s[inside])
    return read
