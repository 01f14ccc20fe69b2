"""Choosing the moment of the next point set.

The moment is as late as it can be: the newest frame's, if every other live camera was there recently enough to be
carried on to it, else that camera's last moment plus the longest allowed extrapolation. Where another camera is due for
the very same moment (cameras in step), its frame is waited for.
"""

from __future__ import annotations

from collections import deque
from statistics import median

_IN_STEP = 0.15
"""Cameras whose phase differs by less than this share of a period count as in step: 2.5 ms at 60 fps. Chosen."""
_INTERVALS = 9
"""Frame intervals kept per camera; their median is the period as long as fewer than half follow a lost frame."""
_LONGEST_WAIT_S = 1.0
"""A camera that has been silent for so long is not waited for, and a longer interval is a pause, not a period. Chosen:
five periods of the slowest rate that `rhot sim` takes, 5 Hz."""


class Schedule:
    """Knows each camera's newest moment and frame period.

    Attributes:
        newest_s: time of each camera's newest frame, −∞ before the first.
        published_s: the last moment given.
    """

    def __init__(self, periods_s: list[float]) -> None:
        """Take the nominal frame period of each camera, seconds, used until a few frames have come."""
        self._nominal = list(periods_s)
        self.clear()

    def clear(self) -> None:
        """Forget all but the nominal periods."""
        self._intervals: list[deque[float]] = [deque(maxlen=_INTERVALS) for _ in self._nominal]
        self._periods = list(self._nominal)
        self._unanswered = [0] * len(self._nominal)
        self.newest_s = [float("-inf")] * len(self._nominal)
        self.published_s = float("-inf")

    def period_s(self, camera: int) -> float:
        """Return a camera's frame period."""
        return self._periods[camera]

    def arrived(self, camera: int, t_s: float) -> None:
        """Note a frame of a camera, true at t_s, later than its last."""
        interval = t_s - self.newest_s[camera]
        if 0.0 < interval < _LONGEST_WAIT_S:
            self._intervals[camera].append(interval)
            self._periods[camera] = median(self._intervals[camera])
        self.newest_s[camera] = t_s
        for other in range(len(self._unanswered)):
            self._unanswered[other] += 1
        self._unanswered[camera] = 0

    def moment(self, extrapolation_share: float) -> float | None:
        """Return the moment to publish, or None when nothing new can be said yet.

        Args:
            extrapolation_share: how far a camera may be carried on, as a share of its period.
        """
        newest = max(self.newest_s)
        moment = newest
        for camera, seen in enumerate(self.newest_s):
            lag = newest - seen
            if lag == 0.0 or lag >= _LONGEST_WAIT_S:
                continue
            period = self.period_s(camera)
            reach = extrapolation_share * period
            if lag <= reach:
                continue
            phase = lag % period
            if self._unanswered[camera] <= len(self.newest_s) - 1 and min(phase, period - phase) < _IN_STEP * period:
                return None
            if lag < period:
                moment = min(moment, seen + reach)
        if moment <= self.published_s:
            return None
        self.published_s = moment
        return moment

    @property
    def newest(self) -> float:
        """Time of the newest frame of all, −∞ before the first."""
        return max(self.newest_s)

    @property
    def longest_period_s(self) -> float:
        """The longest of the cameras' frame periods."""
        return max(self._periods)

    def common_moment(self) -> float:
        """Return the latest moment up to which two cameras have seen; −∞ when there is none."""
        return sorted(self.newest_s)[-2]

    def newest_moment(self) -> float | None:
        """Return the newest frame's moment, or None while another camera's frame of the same moment is due."""
        newest = self.newest
        for camera, seen in enumerate(self.newest_s):
            lag = newest - seen
            if lag == 0.0 or lag >= _LONGEST_WAIT_S:
                continue
            period = self.period_s(camera)
            phase = lag % period
            due = self._unanswered[camera] <= len(self.newest_s) - 1
            if due and lag > 0.5 * period and min(phase, period - phase) < _IN_STEP * period:
                return None
        if newest <= self.published_s:
            return None
        self.published_s = newest
        return newest
