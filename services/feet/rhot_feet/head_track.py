"""The head's poses of the last second, interpolated to the times of images."""

from __future__ import annotations

from bisect import bisect_left, insort
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rigid, rotation_from_quaternion, rotation_from_vector, vector_from_rotation
from rhot.messages import HeadPose

_KEPT_NS: Final = 1_000_000_000
_GAP_NS: Final = 100_000_000
"""Longest gap between two poses that is interpolated."""
_AHEAD_NS: Final = 30_000_000
"""Longest extrapolation beyond the newest pose."""


class HeadTrack:
    """Stores measured poses of the head and interpolates between them."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._poses: dict[int, FloatArray] = {}

    def add(self, pose: HeadPose) -> None:
        """Add a pose; predicted ones are ignored, because the camera's rotation has to be accurate to a degree."""
        if pose.state != "measured" or pose.t_ns in self._poses:
            return
        insort(self._times, pose.t_ns)
        rotation = rotation_from_quaternion(np.array(pose.orientation))
        self._poses[pose.t_ns] = rigid(rotation, np.array(pose.position))
        while self._times[-1] - self._times[0] > _KEPT_NS:
            del self._poses[self._times.pop(0)]

    def awaits(self, t_ns: int) -> bool:
        """Return whether poses are arriving, but not yet up to a time."""
        return bool(self._times) and _AHEAD_NS < t_ns - self._times[-1] < _KEPT_NS

    def at(self, t_ns: int) -> FloatArray | None:
        """Return T_rig_head (4, 4), metres, at a time; None if no pose is close enough."""
        times = self._times
        if len(times) < 2 or t_ns < times[0] or t_ns - times[-1] > _AHEAD_NS:
            return None
        after = min(max(bisect_left(times, t_ns), 1), len(times) - 1)
        first_ns, second_ns = times[after - 1], times[after]
        if second_ns - first_ns > _GAP_NS:
            return None
        first, second = self._poses[first_ns], self._poses[second_ns]
        share = (t_ns - first_ns) / (second_ns - first_ns)
        turned = share * vector_from_rotation(first[:3, :3].T @ second[:3, :3])
        position = first[:3, 3] + share * (second[:3, 3] - first[:3, 3])
        return rigid(first[:3, :3] @ rotation_from_vector(turned), position)
