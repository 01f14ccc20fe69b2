"""The newest sample of each key, and whether it is sent as it is, kept, faded or omitted."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

from rhot.messages import Side
from rhot.rig import BridgeConfig
from rhot_bridge.scene import Body, BridgedHand, Scene, Thing, Tracked

# Decides when a frame is sent.

KIND_ABSENT_NS: Final = 100_000_000
"""A kind without a sample for this long no longer blocks lower ones: six frames at 60 Hz."""


class Pace:
    """Limits the rate without delaying samples.

    A frame is sent with a sample of the triggering kind: the first kind, in the target's order, with a recent sample.
    So a hand is sent at once, together with the newest samples of other kinds. A sample that comes before the rate
    limit allows is not sent: the next one replaces it. Up to one period is made up for, so that samples at 100 Hz and
    a limit of 90 Hz give 90 Hz, not 50.
    """

    def __init__(self, rate_hz: float, triggers: Sequence[str]) -> None:
        """Set the limit.

        Args:
            rate_hz: most frames per second.
            triggers: kinds of samples (`hand`, `foot`, …) that trigger a frame, by priority.
        """
        self._period_ns = round(1e9 / rate_hz)
        self._rank = {kind: rank for rank, kind in enumerate(triggers)}
        self._heard_ns = [-KIND_ABSENT_NS] * len(self._rank)
        self._due_ns = 0
        self.sent_ns = 0

    def due(self, now_ns: int, kind: str | None = None) -> bool:
        """Return whether a frame may go out now.

        Args:
            now_ns: monotonic clock.
            kind: of the sample that has just arrived; None for a repetition without a new sample.
        """
        if kind is not None:
            rank = self._rank.get(kind)
            if rank is None:
                return False
            self._heard_ns[rank] = now_ns
            for heard_ns in self._heard_ns[:rank]:
                if now_ns - heard_ns < KIND_ABSENT_NS:
                    return False
        return now_ns >= self._due_ns

    def sent(self, now_ns: int) -> None:
        """Note that a frame was sent."""
        self._due_ns = max(self._due_ns + self._period_ns, now_ns)
        self.sent_ns = now_ns


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
        hands: dict[Side, BridgedHand] = {}
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
            if isinstance(tracked, BridgedHand):
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
