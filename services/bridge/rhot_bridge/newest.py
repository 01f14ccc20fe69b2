"""What of the newest samples goes out, and how: as it is, kept, faded or not at all."""

from __future__ import annotations

import dataclasses
from typing import Final

from rhot.messages import Side
from rhot.rig import BridgeConfig
from rhot_bridge.scene import Body, Hand, Scene, Thing, Tracked

MOST_KEYS: Final = 64
"""Things that one bridge sends; a rig has about ten."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Arrived:
    tracked: Tracked
    at_ns: int


class Newest:
    """The newest of each key that may be sent; all times are of one monotonic clock, handed in."""

    def __init__(self, config: BridgeConfig) -> None:
        self.config = config
        self._arrived: dict[str, _Arrived] = {}
        self._fading = False

    @property
    def fading(self) -> bool:
        """Whether something faded in the last scene."""
        return self._fading

    def put(self, key: str, tracked: Tracked, now_ns: int) -> None:
        """Keep a sample; a predicted one only where such are sent."""
        if tracked.state == "predicted" and self.config.predicted == "absent":
            return
        # Taken out first, so that the first is the one that has been silent longest.
        if self._arrived.pop(key, None) is None and len(self._arrived) >= MOST_KEYS:
            silent = next(iter(self._arrived))
            if self._weight((now_ns - self._arrived[silent].at_ns) / 1e9)[1]:
                return
            # It has gone, and is only kept or fading.
            del self._arrived[silent]
        self._arrived[key] = _Arrived(tracked, now_ns)

    def clear(self) -> None:
        """Forget all, as at a session's start."""
        self._arrived.clear()

    def scene(self, now_ns: int) -> Scene:
        """Return what is sent now, rig axes; what is over is forgotten."""
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
        """Return how much of a sample of an age is sent, 0 = nothing, and whether it counts as present."""
        config = self.config
        absent_s = age_s - config.absent_after_s
        if absent_s <= 0.0:
            return 1.0, True
        if config.absent == "keep":
            return 1.0, False
        if config.absent == "fade":
            return 1.0 - absent_s / config.fade_s, False
        return 0.0, False
