"""Rejects implausible frames before they reach the tracks, and counts them by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame

_FUTURE_NS = 500_000_000
"""A frame further ahead of the stream than this is doubted until frames agree with it."""
_BACK_NS = 1_000_000_000
"""The same for a frame from before the stream's newest; the network reorders by far less."""
_AGREEING_AHEAD = 3
"""So many doubted frames in a row that follow each other are a stream that had paused."""
_AGREEING_BACK = 8
"""The same for frames from before the stream: one that was started again."""


class StreamGuard:
    """Judges frames by their camera's name, size and order and by the stream's time.

    A single time far in the past or future must not poison the tracks, yet a restarted stream, or one that paused, must
    be followed: frames that leave the stream's time are refused until several in a row agree with each other.

    Attributes:
        counts: refused frames by reason.
    """

    def __init__(self, cameras: Mapping[str, CameraModel], counts: Counter[str]) -> None:
        self._cameras = cameras
        self.counts = counts
        self._newest_ns: int | None = None
        self._last: dict[str, int] = {}
        self._doubted_ns: int | None = None
        self._doubted = 0

    def judge(self, frame: MarkerFrame) -> str:
        """Return `accept`, `refuse`, or `restart` when this frame begins a new stream."""
        camera = self._cameras.get(frame.camera)
        if camera is None:
            return self._refuse("unknown_camera")
        if (frame.width, frame.height) != (camera.width, camera.height):
            return self._refuse("wrong_size")
        if self._newest_ns is not None and not -_BACK_NS <= frame.t_ns - self._newest_ns <= _FUTURE_NS:
            return self._hold_back(frame)
        last = self._last.get(frame.camera)
        if last is not None and frame.t_ns <= last:
            # The same or an older time, within what the network may reorder: nothing new for this camera.
            return self._refuse("duplicate" if frame.t_ns == last else "late")
        self._take(frame)
        return "accept"

    def _hold_back(self, frame: MarkerFrame) -> str:
        follows = self._doubted_ns is not None and 0 <= frame.t_ns - self._doubted_ns <= _FUTURE_NS
        self._doubted = self._doubted + 1 if follows else 1
        self._doubted_ns = frame.t_ns
        ahead = self._newest_ns is not None and frame.t_ns > self._newest_ns
        if self._doubted < (_AGREEING_AHEAD if ahead else _AGREEING_BACK):
            return self._refuse("wrong_time")
        self._last.clear()
        self._newest_ns = None
        self._take(frame)
        self.counts["restarts"] += 1
        return "restart"

    def _take(self, frame: MarkerFrame) -> None:
        self._last[frame.camera] = frame.t_ns
        self._newest_ns = frame.t_ns if self._newest_ns is None else max(self._newest_ns, frame.t_ns)
        self._doubted = 0
        self._doubted_ns = None

    def _refuse(self, reason: str) -> str:
        self.counts[reason] += 1
        return "refuse"
