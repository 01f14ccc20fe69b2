"""The newest text of each key, and what each browser has not been sent yet; pure."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import Final

MOST_KEYS: Final = 64
"""Of each kind (`hand`, `object`, …): the last part of a key is an outsider's choice, and must neither make the table
grow nor take another kind's room."""
_HAND: Final = "rhot/hand/"


class Newest:
    """Newest wins, per key; `version` counts what has come."""

    def __init__(self) -> None:
        self.version = 0
        self._texts: dict[str, dict[str, tuple[int, str, float]]] = {}

    def put(self, key: str, text: str, bus_ms: float = math.nan) -> None:
        """Keep a text in place of the key's last one.

        Args:
            key: on the bus.
            text: JSON.
            bus_ms: when the bus handed it over, rig clock; NaN where nobody waits for it.
        """
        self.version += 1
        texts = self._texts.setdefault(key.split("/", 2)[1], {})
        # Taken out first, so that the first is the one that has been silent longest.
        if texts.pop(key, None) is None and len(texts) >= MOST_KEYS:
            del texts[next(iter(texts))]
        texts[key] = (self.version, text, bus_ms)

    def since(self, version: int, without: tuple[str, ...] = ()) -> str:
        """Return a frame of what has changed since a version, JSON; empty when nothing has.

        Its `bus` is when the bus handed over the hand in it, the older one of two; without a hand, the newest of all.

        Args:
            version: what a browser has been sent last.
            without: keys that it does not want.
        """
        changed = {
            key: (text, bus_ms)
            for texts in self._texts.values()
            for key, (at_version, text, bus_ms) in texts.items()
            if at_version > version and key not in without
        }
        if not changed:
            return ""
        parts = ",".join(f"{json.dumps(key)}:{text}" for key, (text, _) in changed.items())
        moments = {key: bus_ms for key, (_, bus_ms) in changed.items() if not math.isnan(bus_ms)}
        hands = [bus_ms for key, bus_ms in moments.items() if key.startswith(_HAND)]
        bus_ms = min(hands) if hands else max(moments.values(), default=math.nan)
        stamp = "" if math.isnan(bus_ms) else f'"bus":{bus_ms:.3f},'
        return f'{{"type":"frame",{stamp}"keys":{{{parts}}}}}'


@dataclass(slots=True)
class Pace:
    """When one browser is sent the next frame: no faster than it wishes, and not before it has taken the last ones.

    A browser says when it has taken a frame. Without that, frames would pile up in the network's buffers, and a slow
    browser would see the past.

    Attributes:
        rate_hz: most frames per second.
        ahead: most frames that are under way: two are one that is drawn and one on its way, as over Wi-Fi a round trip
            takes some milliseconds; a browser that asks for each by itself wants one.
        version: of what it has been sent.
    """

    rate_hz: float = 90.0
    ahead: int = 2
    version: int = 0
    _under_way: int = field(default=0, init=False)
    _due_s: float = field(default=0.0, init=False)

    def wait_s(self, now_s: float) -> float | None:
        """Return how long until the next frame may go; None when the browser has to take one first."""
        return None if self._under_way >= self.ahead else max(0.0, self._due_s - now_s)

    def sent(self, now_s: float, version: int) -> None:
        """A frame has gone."""
        self.version = version
        self._under_way += 1
        # A quarter of a period early is early enough: poses do not come in exact steps.
        self._due_s = max(self._due_s + 1.0 / self.rate_hz, now_s + 0.75 / self.rate_hz)

    def taken(self) -> None:
        """The browser has taken one."""
        self._under_way = max(0, self._under_way - 1)
