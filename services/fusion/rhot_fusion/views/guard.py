"""Rejects implausible frames before they are processed, and counts them by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame

_FUTURE_NS = 500_000_000
"""A frame further ahead of the newest one than this is rejected until several frames agree."""
_BACK_NS = 1_000_000_000
"""The same for a frame that is older than the newest one; the network reorders by far less."""


class StreamGuard:
    """Checks a frame's camera name, size, order and time.

    A single frame with a time far in the past or future must not corrupt the tracks, but a stream that paused or was
    restarted must be accepted. Frames far from the stream's time are therefore rejected until several consecutive ones
    agree with each other.

    Attributes:
        counts: rejected frames by reason.
    """

    def __init__(self, cameras: Mapping[str, CameraModel], counts: Counter[str]) -> None:
        self._cameras = cameras
        self.counts = counts
        self._newest_ns: int | None = None
        self._last: dict[str, int] = {}
        self._suspect_ns: int | None = None
        self._suspects = 0

    def judge(self, frame: MarkerFrame) -> str:
        """Return `accept`, `refuse`, or `restart` if this frame begins a new stream."""
        camera = self._cameras.get(frame.camera)
        if camera is None:
            return self._refuse("unknown_camera")
        if (frame.width, frame.height) != (camera.width, camera.height):
            return self._refuse("wrong_size")
        if self._newest_ns is not None and not -_BACK_NS <= frame.t_ns - self._newest_ns <= _FUTURE_NS:
            return self._judge_suspect(frame)
        last = self._last.get(frame.camera)
        if last is not None and frame.t_ns <= last:
            # Reordered or repeated by the network: not newer than this camera's last frame.
            return self._refuse("duplicate" if frame.t_ns == last else "late")
        self._accept(frame)
        return "accept"

    def _judge_suspect(self, frame: MarkerFrame) -> str:
        follows = self._suspect_ns is not None and 0 <= frame.t_ns - self._suspect_ns <= _FUTURE_NS
        self._suspects = self._suspects + 1 if follows else 1
        self._suspect_ns = frame.t_ns
        ahead = self._newest_ns is not None and frame.t_ns > self._newest_ns
        # Number of consecutive such frames ahead after which the stream is considered to have paused.
        # Number of consecutive such older frames after which the stream is considered to have been restarted.
        if self._suspects < (3 if ahead else 8):
            return self._refuse("wrong_time")
        self._last.clear()
        self._newest_ns = None
        self._accept(frame)
        self.counts["restarts"] += 1
        return "restart"

    def _accept(self, frame: MarkerFrame) -> None:
        self._last[frame.camera] = frame.t_ns
        self._newest_ns = frame.t_ns if self._newest_ns is None else max(self._newest_ns, frame.t_ns)
        self._suspects = 0
        self._suspect_ns = None

    def _refuse(self, reason: str) -> str:
        self.counts[reason] += 1
        return "refuse"
