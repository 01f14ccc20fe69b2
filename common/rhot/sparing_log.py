"""Saying the same thing at most once in a while: what others send must not fill a disk with our logs."""

from __future__ import annotations

import threading
import time
from typing import Final

INTERVAL_S: Final = 5.0


class SparingLog:
    """Tells whether a topic's turn to be logged has come; may be asked from any thread."""

    def __init__(self, interval_s: float = INTERVAL_S) -> None:
        self._interval_s = interval_s
        self._lock = threading.Lock()
        self._logged_at: dict[str, float] = {}
        self._kept_quiet: dict[str, int] = {}

    def due(self, topic: str) -> int | None:
        """Return how often the topic was kept quiet since it was last due; None when it is not due yet."""
        now = time.monotonic()
        with self._lock:
            # Topics are keys, which an outsider may choose: the table must not grow with them.
            most_topics = 64
            if topic not in self._logged_at and len(self._logged_at) >= most_topics:
                topic = "…"
            last = self._logged_at.get(topic)
            if last is not None and now - last < self._interval_s:
                self._kept_quiet[topic] = self._kept_quiet.get(topic, 0) + 1
                return None
            self._logged_at[topic] = now
            return self._kept_quiet.pop(topic, 0)
