"""The newest sample of each key, and whether it is sent as it is, kept, faded or omitted."""

from __future__ import annotations

import dataclasses
from typing import Final

from rhot.messages import Side
from rhot.rig import BridgeConfig
from rhot_bridge.scene import Body, Hand, Scene, Thing, Tracked

MOST_KEYS: Final = 64
"""Largest number of keys of one bridge; a rig has about ten."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Arrived:
    tracked: Tracked
    at_ns: int


class Newest:
    """The newest sample of each key; all times are on one monotonic clock, passed in by the caller."""

    def __init__(self, config: BridgeConfig) -> None:
        self.config = config
        self._arrived: dict[str, _Arrived] = {}
        self._fading = False

    @property
    def fading(self) -> bool:
        """Whether something faded in the last scene."""
        return self._fading

    def put(self, key: str, tracked: Tracked, now_ns: int) -> None:
        """Store a sample; a predicted one only if `predicted = "send"`."""
        if tracked.state == "predicted" and self.config.predicted == "absent":
            return
        # Removed and added again, so that the dict is ordered by arrival, oldest first.
        if self._arrived.pop(key, None) is None and len(self._arrived) >= MOST_KEYS:
            silent = next(iter(self._arrived))
            if self._weight((now_ns - self._arrived[silent].at_ns) / 1e9)[1]:
                return
            # The oldest is absent: it is only kept or fading.
            del self._arrived[silent]
        self._arrived[key] = _Arrived(tracked, now_ns)

    def clear(self) -> None:
        """Discard all samples, as at a session's start."""
        self._arrived.clear()

    def scene(self, now_ns: int) -> Scene:
        """Return the scene to send now, rig axes; samples that have faded out are discarded."""
        hands: dict[Side, Hand] = {}
        feet: dict[Side, Thing] = {}
        objects: dict[str, Thing] = {}
        head: Thing | None = None
        body: Body | None = None
        newest_ns = 0
        self._fading = False
        for key, arrived in list(self._arrived.items()):
            weight, present = self._weight((now_ns - arrived.at_ns) / 1e9)
            if weight <= 0.0:
                del self._arrived[key]
                continue
            tracked = arrived.tracked
            if not present:
                self._fading = self._fading or weight < 1.0
                tracked = dataclasses.replace(tracked, state="kept", weight=weight)
            newest_ns = max(newest_ns, tracked.t_ns)
            kind, _, name = key.removeprefix("rhot/").partition("/")
            if isinstance(tracked, Hand):
                hands["left" if name == "left" else "right"] = tracked
            elif isinstance(tracked, Body):
                body = tracked
            elif kind == "foot":
                feet["left" if name == "left" else "right"] = tracked
            elif kind == "head":
                head = tracked
            else:
                objects[name] = tracked
        return Scene("rig", newest_ns, hands, objects, head, feet, body)

    def _weight(self, age_s: float) -> tuple[float, bool]:
        """Return the weight of a sample of an age, 0 = not sent, and whether it counts as present."""
        config = self.config
        absent_s = age_s - config.absent_after_s
        if absent_s <= 0.0:
            return 1.0, True
        if config.absent == "keep":
            return 1.0, False
        if config.absent == "fade":
            return 1.0 - absent_s / config.fade_s, False
        return 0.0, False
