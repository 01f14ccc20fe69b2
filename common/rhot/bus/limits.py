"""How much of what the network sends may pile up in one process, and how often that much was reached."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Final

MAX_MESSAGE_BYTES: Final = 8 << 20
"""Zenoh puts no larger message together; its default is 1 GiB. Chosen: a preview of 12 megapixels takes 5 MB."""
MAX_SAMPLE_BYTES: Final = 1 << 20
"""A larger sample is not copied: no message of ours may be as large (`rhot.messages.MAX_PAYLOAD_BYTES`)."""
MAX_QUESTION_BYTES: Final = 256 << 10
"""Of what may come with a question: a change of a configuration takes some kB."""
MAX_UNREAD_BYTES: Final = 64 << 20
"""Of samples that one subscriber has not read yet; chosen: 700 pictures of 640x480."""
MAX_KNOWN_KEYS: Final = 64
"""Keys of a latest-only subscriber that have brought valid messages: as many as a rig may have cameras."""
MAX_FOREIGN_KEYS: Final = 64
"""Further keys that it keeps a slot for at any moment."""
MAX_WAITING_ANSWERS: Final = 16
"""Questions that may wait for a worker; chosen: a page per person in a room asks each camera once a second."""
MAX_REPLIES: Final = 4096
MAX_REPLY_BYTES: Final = 64 << 20
"""Of all answers to one question."""


class LimitCounts:
    """How often each limit was reached; the status shows those that were."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def hit(self, name: str, number: int = 1) -> None:
        """Count what a limit kept out; any thread may call it."""
        with self._lock:
            self._counts[name] += number

    def counts(self) -> dict[str, int]:
        """Return what was kept out so far, by name."""
        with self._lock:
            return dict(self._counts)
