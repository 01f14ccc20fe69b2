"""The newest text of each key, and what each browser has not been sent yet; pure."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Final

MOST_KEYS: Final = 256
"""The last part of a key is an outsider's choice: the table must not grow with it."""


class Newest:
    """Newest wins, per key; `version` counts what has come."""

    def __init__(self) -> None:
        self.version = 0
        self._texts: dict[str, tuple[int, str]] = {}

    def put(self, key: str, text: str) -> None:
        """Keep a text in place of the key's last one."""
        if key not in self._texts and len(self._texts) >= MOST_KEYS:
            return
        self.version += 1
        self._texts[key] = (self.version, text)

    def since(self, version: int, without: tuple[str, ...] = ()) -> str:
        """Return a frame of what has changed since a version, JSON; empty when nothing has.

        Args:
            version: what a browser has been sent last.
            without: keys that it does not want.
        """
        parts = [
            f"{json.dumps(key)}:{text}"
            for key, (changed, text) in self._texts.items()
            if changed > version and key not in without
        ]
        return f'{{"type":"frame","keys":{{{",".join(parts)}}}}}' if parts else ""


@dataclass(slots=True)
class Pace:
    """When one browser is sent the next frame: no faster than it wishes, and not before it has taken the last ones.

    A browser says when it has taken a frame. Without that, frames would pile up in the network's buffers, and a slow
    browser would see the past.

    Attributes:
        rate_hz: most frames per second.
        version: of what it has been sent.
    """

    rate_hz: float = 90.0
    version: int = 0
    _under_way: int = field(default=0, init=False)
    _due_s: float = field(default=0.0, init=False)

    def wait_s(self, now_s: float) -> float | None:
        """Return how long until the next frame may go; None when the browser has to take one first."""
        return None if self._under_way >= _MOST_UNDER_WAY else max(0.0, self._due_s - now_s)

    def sent(self, now_s: float, version: int) -> None:
        """A frame has gone."""
        self.version = version
        self._under_way += 1
        # A quarter of a period early is early enough: poses do not come in exact steps.
        self._due_s = max(self._due_s + 1.0 / self.rate_hz, now_s + 0.75 / self.rate_hz)

    def taken(self) -> None:
        """The browser has taken one."""
        self._under_way = max(0, self._under_way - 1)


_MOST_UNDER_WAY: Final = 2
"""One that is drawn and one on its way; over Wi-Fi a round trip takes some milliseconds."""
