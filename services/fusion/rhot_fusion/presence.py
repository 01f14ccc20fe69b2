"""Which markers are known, which views back them, and since when."""

from __future__ import annotations

import numpy as np

from rhot_fusion.schedule import Schedule
from rhot_fusion.sightings import BoolArray, FloatArray, IndexArray

_FRESH_PERIODS = 1.5
_FRESH_S = 0.04
"""A camera backs a marker as long as its newest frame is no older than the longer of these."""


class Presence:
    """Of M markers before C cameras; times in seconds since the stream's start, −∞ = never.

    Attributes:
        tracked: (M,) markers whose place is known.
        fresh: (C, M) whether each camera's newest frame showed the marker where it was expected.
        sure: (C, M) whether the one before did too; a marker that was just found again may be something else.
        frame_s: (C,) time of each camera's newest frame.
        seen_s: (M,) when any camera last saw the marker.
        backed_s: (M,) when two views last backed it.
    """

    def __init__(self, cameras: int, markers: int) -> None:
        self.tracked: BoolArray = np.zeros(markers, dtype=bool)
        self.fresh: BoolArray = np.zeros((cameras, markers), dtype=bool)
        self.sure: BoolArray = np.zeros((cameras, markers), dtype=bool)
        self.frame_s: FloatArray = np.full(cameras, -np.inf)
        self.seen_s: FloatArray = np.full(markers, -np.inf)
        self.backed_s: FloatArray = np.full(markers, -np.inf)

    def clear(self) -> None:
        """Forget all markers."""
        self.tracked[:] = False
        self.fresh[:] = self.sure[:] = False
        for times in (self.frame_s, self.seen_s, self.backed_s):
            times[:] = -np.inf

    def show(self, camera: int, t_s: float, shown: IndexArray) -> None:
        """Take a camera's next frame, in which these markers were where they were expected."""
        fresh = np.zeros(self.fresh.shape[1], dtype=bool)
        fresh[shown] = True
        self.sure[camera] = fresh & self.fresh[camera]
        self.fresh[camera] = fresh
        self.frame_s[camera] = t_s
        self.seen_s[shown] = t_s

    def find(self, found: IndexArray, views: BoolArray, t_s: float) -> None:
        """Take markers (N,) that views (C, N) have confirmed."""
        self.tracked[found] = True
        self.seen_s[found] = self.backed_s[found] = t_s
        self.fresh[:, found] = self.sure[:, found] = views

    def reach(self, t_s: float, schedule: Schedule) -> BoolArray:
        """Return which cameras (C, 1) have shown a frame recently enough to back anything at a moment."""
        reach = np.array([max(_FRESH_PERIODS * schedule.period_s(place), _FRESH_S) for place in range(len(self.fresh))])
        near: BoolArray = (t_s - self.frame_s <= reach)[:, None]
        return near
