"""Which markers are known, which views back them, and since when."""

from __future__ import annotations

import numpy as np

from rhot_fusion.schedule import Schedule
from rhot_fusion.views.sightings import BoolArray, FloatArray, IndexArray

_FRESH_PERIODS = 1.5
_FRESH_S = 0.04
"""A camera backs a marker as long as its newest frame is no older than the longer of these."""


class Presence:
    """Of M markers before C cameras; times in seconds since the stream's start, −∞ = never.

    Attributes:
        tracked: (M,) markers whose place is known.
        fresh: (C, M) whether each camera's newest frame showed the marker where it may be.
        sure: (C, M) whether that is near to where it was expected and the frame before showed it too; a marker that was
            just found again may be something else.
        frame_s: time of each camera's newest frame.
        seen_s: (M,) when any camera last saw the marker.
        backed_s: (M,) when two views last backed it.
    """

    def __init__(self, cameras: int, markers: int) -> None:
        self.tracked: BoolArray = np.zeros(markers, dtype=bool)
        self.fresh: BoolArray = np.zeros((cameras, markers), dtype=bool)
        self.sure: BoolArray = np.zeros((cameras, markers), dtype=bool)
        self.frame_s: list[float] = [-np.inf] * cameras
        self.seen_s: FloatArray = np.full(markers, -np.inf)
        self.backed_s: FloatArray = np.full(markers, -np.inf)

    def clear(self) -> None:
        """Forget all markers."""
        self.tracked[:] = False
        self.fresh[:] = self.sure[:] = False
        self.frame_s = [-np.inf] * len(self.frame_s)
        self.seen_s[:] = self.backed_s[:] = -np.inf

    def show(self, camera: int, t_s: float, shown: IndexArray, backed: IndexArray) -> None:
        """Take a camera's next frame: which markers it showed where they may be, and which where they were expected."""
        fresh, sure = self.fresh[camera], self.sure[camera]
        sure[:] = False
        sure[backed] = fresh[backed]
        fresh[:] = False
        fresh[shown] = True
        self.frame_s[camera] = t_s
        self.seen_s[shown] = t_s

    def find(self, found: IndexArray, views: BoolArray, t_s: float) -> None:
        """Take markers (N,) that views (C, N) have confirmed."""
        self.tracked[found] = True
        self.seen_s[found] = self.backed_s[found] = t_s
        self.fresh[:, found] = views
        self.sure[:, found] = False

    def backing(self, t_s: float, schedule: Schedule) -> tuple[list[int], list[int]]:
        """Return how many cameras (M,) show each marker at a moment, and how many of them are sure."""
        near = [
            t_s - seen_s <= max(_FRESH_PERIODS * schedule.period_s(place), _FRESH_S)
            for place, seen_s in enumerate(self.frame_s)
        ]
        return _counted(self.fresh, near), _counted(self.sure, near)


def _counted(flags: BoolArray, near: list[bool]) -> list[int]:
    """Return of how many of the near cameras (C,) each marker's flag (C, M) is set."""
    rows = [row for row, here in zip(flags.tolist(), near, strict=True) if here]
    return [sum(column) for column in zip(*rows, strict=True)] or [0] * flags.shape[1]
