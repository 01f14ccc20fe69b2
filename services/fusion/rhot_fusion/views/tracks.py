"""Short histories of the observations per camera and marker, evaluated at a common time.

Cameras are not synchronised and the rows of an image are not exposed together, so every observation has its own time.
A track is interpolated linearly between two observations and extrapolated for a bounded time after the newest one, from
its last three.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray

DEPTH = 4
"""Observations kept per camera and marker."""
ROWS_SHARE = 0.5
"""Additional extrapolation, as a share of a frame period: the rows of an image are exposed at different times."""
LONGEST_GAP = 3.5
"""No interpolation between observations further apart than this many frame periods."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All tracks at one time.

    Attributes:
        xy: (C, M, 2) normalised image coordinates; NaN where not valid.
        valid: (C, M) which tracks have a value.
    """

    xy: FloatArray
    valid: BoolArray


class Tracks:
    """Histories of C cameras and M markers; normalised image coordinates and seconds."""

    def __init__(self, cameras: int, markers: int) -> None:
        # (C, DEPTH, M), the newest last: operations over all markers then access contiguous memory.
        self._t: FloatArray = np.full((cameras, DEPTH, markers), -np.inf)
        self._xy: FloatArray = np.full((cameras, DEPTH, markers, 2), np.nan)
        self._linked: BoolArray = np.zeros((cameras, DEPTH, markers), dtype=bool)
        self._camera: IndexArray = np.arange(cameras)[:, None]
        self._marker: IndexArray = np.arange(markers)

    @property
    def last_t_s(self) -> FloatArray:
        """(C, M) time of the newest observation, −∞ before the first."""
        return self._t[:, -1]

    def append(self, camera: int, markers: IndexArray, t_s: FloatArray, xy: FloatArray, max_rate: float) -> None:
        """Add one frame's observations.

        Args:
            camera: index.
            markers: (K,) indices, ascending.
            t_s: (K,) times, later than the newest of their tracks.
            xy: (K, 2) normalised coordinates.
            max_rate: highest plausible image speed, normalised units per second. A faster step splits the track: it is
                neither interpolated nor used for a velocity.
        """
        rows = slice(None) if len(markers) == len(self._marker) else markers
        past_t, past_xy, past_linked = self._t[camera], self._xy[camera], self._linked[camera]
        way = max_rate * (t_s - past_t[-1, rows])
        step = xy - past_xy[-1, rows]
        step *= step
        for past in (past_t, past_xy, past_linked):
            past[:-1, rows] = past[1:, rows]
        past_t[-1, rows] = t_s
        past_xy[-1, rows] = xy
        past_linked[-1, rows] = step[:, 0] + step[:, 1] <= way * way

    def at(self, t_s: float, max_extrapolation_s: float, max_gap_s: float) -> Snapshot:
        """Return all tracks at a time.

        Args:
            t_s: the time.
            max_extrapolation_s: a track whose newest observation is older than this has no value.
            max_gap_s: observations further apart are neither interpolated nor used for a velocity.
        """
        ahead = t_s - self._t[:, -1]
        with np.errstate(invalid="ignore", divide="ignore"):
            extrapolated = (ahead >= 0.0) & (ahead <= max_extrapolation_s)
            xy = self._extrapolated(ahead, max_gap_s)
            valid = extrapolated
            if (ahead < 0.0).any():
                between_xy, between = self._interpolated(t_s, max_gap_s)
                xy = np.where(between[:, :, None], between_xy, xy)
                valid = extrapolated | between
        if not valid.all():
            xy[~valid] = np.nan
        return Snapshot(xy, valid)

    def _interpolated(self, t_s: float, max_gap_s: float) -> tuple[FloatArray, BoolArray]:
        """Return tracks (C, M, 2) interpolated between the observations before and after t_s, and which are valid."""
        late = np.count_nonzero(self._t <= t_s, axis=1)
        known = (late > 0) & (late < DEPTH)
        late = np.minimum(np.maximum(late, 1), DEPTH - 1)
        before, after = (self._camera, late - 1, self._marker), (self._camera, late, self._marker)
        early_s, gap = self._t[before], self._t[after] - self._t[before]
        known &= self._linked[after] & (gap <= max_gap_s)
        share = ((t_s - early_s) / gap)[:, :, None]
        return (1.0 - share) * self._xy[before] + share * self._xy[after], known

    def _extrapolated(self, ahead_s: FloatArray, max_gap_s: float) -> FloatArray:
        """Return tracks (C, M, 2) extrapolated by (C, M) seconds after their newest observations.

        Uses Newton's form of the parabola through the last three observations, with half its quadratic term; after a
        split or a gap, a line or a constant. A line errs by ½·a·t·(t + T) for a marker with acceleration a, in one
        camera only, and a short baseline amplifies this tenfold in depth. The whole parabola amplifies noise 2.5 times.
        Half had the smallest error over slow and fast motion with cameras 7 ms out of phase.
        """
        t, xy, linked = self._t, self._xy, self._linked
        interval = t[:, -2:] - t[:, -3:-1]
        joined = linked[:, -2:] & (interval <= max_gap_s)
        rate = (xy[:, -2:] - xy[:, -3:-1]) / interval[:, :, :, None]
        earlier, last = interval[:, 0], interval[:, 1]
        bend = (rate[:, 1] - rate[:, 0]) * (0.5 * ahead_s * (ahead_s + last) / (last + earlier))[:, :, None]
        way = rate[:, 1] * ahead_s[:, :, None]
        way += np.where((joined[:, 0] & joined[:, 1])[:, :, None], bend, 0.0)
        extrapolated: FloatArray = xy[:, -1] + np.where(joined[:, 1, :, None], way, 0.0)
        return extrapolated

    def clear(self) -> None:
        """Discard all observations."""
        self._t.fill(-np.inf)
        self._xy.fill(np.nan)
        self._linked.fill(False)
