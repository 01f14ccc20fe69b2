"""Choose the time of the next point set.

It is the time of the newest frame if the frames of all other live cameras are recent enough to be extrapolated to it;
otherwise the time of the oldest of these frames plus the longest permitted extrapolation. If another camera's frame of
the same time is due (synchronised cameras), the schedule waits for it.
"""

from __future__ import annotations

from collections import deque
from statistics import median

_IN_PHASE = 0.15
"""Cameras whose phases differ by less than this share of a period are synchronised: 2.5 ms at 60 fps. Chosen."""
_LONGEST_WAIT_S = 1.0
"""Timeout: a camera without frames for this long is ignored, and longer intervals do not count as a period. Chosen:
five periods of the lowest rate that `rhot sim` accepts, 5 Hz."""


class FrameSchedule:
    """Measures each camera's frame period and chooses output times.

    Attributes:
        newest_s: time of each camera's newest frame, −∞ before the first.
        published_s: the last output time.
    """

    def __init__(self, periods_s: list[float]) -> None:
        """Start with the nominal frame period of each camera, seconds, which is used until frames have arrived."""
        self._nominal = list(periods_s)
        self.clear()

    def clear(self) -> None:
        """Reset to the nominal periods."""
        # Frame intervals stored per camera; the period is their median, correct if fewer than half contain a
        # lost frame.
        self._intervals: list[deque[float]] = [deque(maxlen=9) for _ in self._nominal]
        self._periods = list(self._nominal)
        self._frames_since = [0] * len(self._nominal)
        self.newest_s = [float("-inf")] * len(self._nominal)
        self.published_s = float("-inf")

    def period_s(self, camera: int) -> float:
        """Return a camera's frame period, seconds."""
        return self._periods[camera]

    def arrived(self, camera: int, t_s: float) -> None:
        """Add a camera's frame with time t_s, later than its last one."""
        interval = t_s - self.newest_s[camera]
        if 0.0 < interval < _LONGEST_WAIT_S:
            self._intervals[camera].append(interval)
            self._periods[camera] = median(self._intervals[camera])
        self.newest_s[camera] = t_s
        for other in range(len(self._frames_since)):
            self._frames_since[other] += 1
        self._frames_since[camera] = 0

    def moment(self, extrapolation_share: float) -> float | None:
        """Return the next output time, or None if there is none yet.

        Args:
            extrapolation_share: longest extrapolation of a camera's views, as a share of its period.
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
            if self._frames_since[camera] <= len(self.newest_s) - 1 and min(phase, period - phase) < _IN_PHASE * period:
                return None
            if lag < period:
                moment = min(moment, seen + reach)
        if moment <= self.published_s:
            return None
        self.published_s = moment
        return moment

    @property
    def newest(self) -> float:
        """Time of the newest frame of all cameras, −∞ before the first."""
        return max(self.newest_s)

    @property
    def longest_period_s(self) -> float:
        """The longest of the cameras' frame periods, seconds."""
        return max(self._periods)

    def common_moment(self) -> float:
        """Return the latest time up to which two cameras have frames; −∞ if there is none."""
        return sorted(self.newest_s)[-2]

    def newest_moment(self) -> float | None:
        """Return the newest frame's time, or None while another camera's frame of the same time is due."""
        newest = self.newest
        for camera, seen in enumerate(self.newest_s):
            lag = newest - seen
            if lag == 0.0 or lag >= _LONGEST_WAIT_S:
                continue
            period = self.period_s(camera)
            phase = lag % period
            due = self._frames_since[camera] <= len(self.newest_s) - 1
            if due and lag > 0.5 * period and min(phase, period - phase) < _IN_PHASE * period:
                return None
        if newest <= self.published_s:
            return None
        self.published_s = newest
        return newest
