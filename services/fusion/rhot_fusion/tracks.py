"""Short histories of what each camera saw of each marker, and reading them at one common moment.

Cameras are not in step and rows are not exposed together, so every observation has its own time. Between two
observations a track is interpolated; after the newest one it is carried on for a bounded time along a line bent by its
last three.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]

DEPTH = 4
"""Observations kept per camera and marker."""
ROWS_SHARE = 0.5
"""Markers in other rows than the frame's middle are carried on this much further, as a share of a period."""
LONGEST_GAP = 3.5
"""Observations further apart than this many periods are not joined."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All tracks at one moment.

    Attributes:
        xy: (C, M, 2) normalised image coordinates; NaN where there is none.
        valid: (C, M) where there is one.
    """

    xy: FloatArray
    valid: BoolArray


class Tracks:
    """Histories of C cameras and M markers; normalised image coordinates and seconds."""

    def __init__(self, cameras: int, markers: int) -> None:
        self._t: FloatArray = np.full((cameras, markers, DEPTH), -np.inf)
        self._xy: FloatArray = np.full((cameras, markers, DEPTH, 2), np.nan)
        self._linked: BoolArray = np.zeros((cameras, markers, DEPTH), dtype=bool)

    @property
    def last_t_s(self) -> FloatArray:
        """(C, M) time of the newest observation, −∞ before the first."""
        return self._t[:, :, -1]

    def append(self, camera: int, markers: IndexArray, t_s: FloatArray, xy: FloatArray, max_rate: float) -> None:
        """Add one frame's observations.

        Args:
            camera: index.
            markers: (K,) indices, each at most once.
            t_s: (K,) times, later than the newest of their tracks.
            xy: (K, 2) normalised coordinates.
            max_rate: fastest believable motion, normalised units per second; a faster step cuts the track, so that
                no speed is taken and nothing interpolated across it.
        """
        interval = t_s - self._t[camera, markers, -1]
        step = np.hypot(*(xy - self._xy[camera, markers, -1]).T)
        for array in (self._t, self._xy, self._linked):
            array[camera, markers, :-1] = array[camera, markers, 1:]
        self._t[camera, markers, -1] = t_s
        self._xy[camera, markers, -1] = xy
        self._linked[camera, markers, -1] = step <= max_rate * interval

    def at(self, t_s: float, max_extrapolation_s: float, max_gap_s: float) -> Snapshot:
        """Read all tracks at a moment.

        Args:
            t_s: the moment.
            max_extrapolation_s: a track whose newest observation is older than this has no value.
            max_gap_s: two observations further apart are neither interpolated between nor used for a speed.
        """
        newest = self._t[:, :, -1]
        ahead = t_s - newest
        xy = self._xy[:, :, -1].copy()
        with np.errstate(invalid="ignore", divide="ignore"):
            valid = (ahead >= 0.0) & (ahead <= max_extrapolation_s)
            carried = valid & (ahead > 0.0)
            if carried.any():
                xy[carried] += self._advance(carried, ahead[carried], max_gap_s)
            behind = t_s < newest
            for place in range(DEPTH - 1, 0, -1) if behind.any() else ():
                late, early = self._t[:, :, place], self._t[:, :, place - 1]
                between = (t_s < late) & (t_s >= early) & self._linked[:, :, place] & (late - early <= max_gap_s)
                share = ((t_s - early) / (late - early))[between][:, None]
                before_xy, after_xy = self._xy[:, :, place - 1][between], self._xy[:, :, place][between]
                xy[between] = (1.0 - share) * before_xy + share * after_xy
                valid = valid | between
        xy[~valid] = np.nan
        return Snapshot(xy, valid)

    def _advance(self, chosen: BoolArray, ahead_s: FloatArray, max_gap_s: float) -> FloatArray:
        """Return the way (K, 2) of the chosen tracks in the time since their newest observations.

        Newton's form of the parabola through the last three observations with half its bend, a line or nothing where
        the track was cut or has gaps. A line misses ½·a·t·(t + T) of an accelerating marker, and in one camera only,
        which a short baseline turns into ten times as much depth; the whole parabola amplifies noise 2.5 times. Half
        had the smallest error over slow and fast motion with cameras 7 ms out of step.
        """
        t, xy, linked = self._t[chosen], self._xy[chosen], self._linked[chosen]
        last, earlier = t[:, -1] - t[:, -2], t[:, -2] - t[:, -3]
        straight = linked[:, -1] & (last <= max_gap_s)
        curved = straight & linked[:, -2] & (earlier <= max_gap_s)
        rate = (xy[:, -1] - xy[:, -2]) / last[:, None]
        rate_before = (xy[:, -2] - xy[:, -3]) / earlier[:, None]
        bend = (rate - rate_before) / (last + earlier)[:, None]
        way = np.where(straight[:, None], rate * ahead_s[:, None], 0.0)
        way += np.where(curved[:, None], 0.5 * bend * (ahead_s * (ahead_s + last))[:, None], 0.0)
        return way

    def clear(self) -> None:
        """Forget everything."""
        self._t.fill(-np.inf)
        self._xy.fill(np.nan)
        self._linked.fill(False)
