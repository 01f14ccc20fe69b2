"""The newest text of each key, and the rate control of each browser; reads no clock."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import Final

MOST_KEYS: Final = 64
"""Largest number of keys of each kind (`hand`, `object`, …): any sender may choose the last part of a key, which must
neither let the table grow nor displace other kinds."""
_HAND: Final = "rhot/hand/"


class Newest:
    """The newest text of each key; `version` counts the texts stored."""

    def __init__(self) -> None:
        self.version = 0
        self._texts: dict[str, dict[str, tuple[int, str, float]]] = {}

    def put(self, key: str, text: str, bus_ms: float = math.nan) -> None:
        """Store a text in place of the key's last one.

        Args:
            key: on the bus.
            text: JSON.
            bus_ms: time of arrival from the bus, rig clock, milliseconds; NaN if its latency is not measured.
        """
        self.version += 1
        texts = self._texts.setdefault(key.split("/", 2)[1], {})
        # Removed and added again, so that the dict is ordered by arrival, oldest first.
        if texts.pop(key, None) is None and len(texts) >= MOST_KEYS:
            del texts[next(iter(texts))]
        texts[key] = (self.version, text, bus_ms)

    def since(self, version: int, without: tuple[str, ...] = ()) -> str:
        """Return a frame, JSON, with the texts stored after a version; empty if there are none.

        Its `bus` is the arrival time of the older hand in it; without a hand, the newest arrival time.

        Args:
            version: last version that a browser was sent.
            without: keys to omit.
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
    """Rate control of one browser, by its requested rate and its acknowledgements.

    A browser acknowledges each frame. Otherwise frames would accumulate in network buffers, and a slow browser would
    show old poses.

    Attributes:
        rate_hz: most frames per second.
        ahead: most unacknowledged frames: with two, one is drawn while the next is in transit, which takes some
            milliseconds over Wi-Fi; a browser that requests each frame uses one.
        version: last version sent.
    """

    rate_hz: float = 90.0
    ahead: int = 2
    version: int = 0
    _under_way: int = field(default=0, init=False)
    _due_s: float = field(default=0.0, init=False)

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until the next frame may be sent, seconds; None while an acknowledgement is awaited."""
        return None if self._under_way >= self.ahead else max(0.0, self._due_s - now_s)

    def sent(self, now_s: float, version: int) -> None:
        """Note that a frame was sent."""
        self.version = version
        self._under_way += 1
        # May be sent a quarter of a period early, because poses do not arrive at exact intervals.
        self._due_s = max(self._due_s + 1.0 / self.rate_hz, now_s + 0.75 / self.rate_hz)

    def taken(self) -> None:
        """Note that the browser has acknowledged a frame."""
        self._under_way = max(0, self._under_way - 1)
