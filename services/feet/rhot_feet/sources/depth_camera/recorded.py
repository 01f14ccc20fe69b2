"""A depth recording, delivered at the pace at which it was taken."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rhot_feet.frames import DepthFrame
from rhot_feet.sources.depth_camera.recorded_frames import DepthRecording


class RecordedDepthSource:
    """Replays a recording as if it were live.

    The first frame's time becomes the start of the session; the distances between frames stay. Frames that nobody asked
    for in time are left out, as a camera would.
    """

    def __init__(
        self,
        load: Callable[[], DepthRecording],
        now_ns: Callable[[], int],
        *,
        loop: bool = False,
    ) -> None:
        """Prepare; `open` looks at the files.

        Args:
            load: finds the recording.
            now_ns: rig time.
            loop: start again at the end.
        """
        self._load = load
        self._now_ns = now_ns
        self._loop = loop
        self._recording: DepthRecording | None = None
        self._start_ns = 0
        self._next = 0
        self._closed = threading.Event()

    def open(self, start_ns: int) -> None:
        """Find the pictures; the first one is due at `start_ns`.

        Raises:
            ConfigError: the recording cannot be used.
        """
        self._recording = self._load()
        self._start_ns, self._next = start_ns, 0
        self._closed.clear()

    @property
    def finished(self) -> bool:
        """Whether the last frame was delivered."""
        recording = self._recording
        return recording is not None and not self._loop and self._next >= len(recording)

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Wait for the next frame that is due and return the newest."""
        recording = self._recording
        if recording is None or self.finished:
            return None
        newest = self._newest_due(recording)
        if newest < self._next:
            if self._closed.wait(
                max(0.0, min(timeout_s, 1e-9 * (self._due_ns(recording, self._next) - self._now_ns())))
            ):
                return None
            newest = self._newest_due(recording)
            if newest < self._next:
                return None
        self._next = newest + 1
        frame = recording.frame(newest % len(recording))
        return replace(frame, t_ns=self._due_ns(recording, newest), index=newest)

    def close(self) -> None:
        """Stop; a waiting `read` returns None."""
        self._closed.set()
        self._recording = None

    def _period_ns(self, recording: DepthRecording) -> int:
        """Return how long one pass takes: one more mean step after the last frame."""
        length_ns = int(recording.t_ns[-1] - recording.t_ns[0])
        return length_ns + max(1, length_ns // max(1, len(recording) - 1))

    def _due_ns(self, recording: DepthRecording, number: int) -> int:
        passes, index = divmod(number, len(recording))
        return self._start_ns + passes * self._period_ns(recording) + int(recording.t_ns[index] - recording.t_ns[0])

    def _newest_due(self, recording: DepthRecording) -> int:
        """Return the number of the newest frame that is due; −1 before the first."""
        elapsed_ns = self._now_ns() - self._start_ns
        if elapsed_ns < 0:
            return -1
        passes, within_ns = divmod(elapsed_ns, self._period_ns(recording)) if self._loop else (0, elapsed_ns)
        index = int(np.searchsorted(recording.t_ns - recording.t_ns[0], within_ns, side="right")) - 1
        return passes * len(recording) + index
