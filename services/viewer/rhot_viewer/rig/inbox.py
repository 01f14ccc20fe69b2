"""The newest sample of every key that the page shows, decoded on access."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Protocol, TypeVar

import numpy as np

from rhot.arrays import FloatArray
from rhot.bus import Bus, LatestSubscriber, Sample
from rhot.errors import WireError
from rhot.messages import Message, ServiceStatus, decode
from rhot.service import Node

# The last two minutes of every service as rows of figures, for charts.

SECONDS: Final = 120
_LOST: Final = ("dropped_late", "missed", "invalid", "overwritten", "failed")
"""Counts of lost samples: late, lost by the source, invalid, overwritten unread, failed in processing."""
MOST_ROWS: Final = 64
"""Rows of one chart; any sender may choose names. The row of a stopped service is removed after `SECONDS`."""
OWN_FIGURES: Final = "viewer"
"""Service that the charts omit, because it does not track."""


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart.

    Attributes:
        x_s: (n,) seconds before now, negative.
        rows: (n,) values by name; 0 without a status.
    """

    x_s: FloatArray
    rows: Mapping[str, FloatArray]


def rate_hz(status: ServiceStatus) -> float:
    """Return the messages per second that a service publishes; NaN if unknown."""
    return status.rates.get("output", status.rates.get("frames", float("nan")))


def latency_ms(status: ServiceStatus, percentile: str = "p99") -> float:
    """Return a percentile of the age of a service's output when it is published, milliseconds; NaN if unknown."""
    return 1e3 * status.latency_s.get("output_age", {}).get(percentile, float("nan"))


def lost(status: ServiceStatus) -> int:
    """Return the number of samples lost in a service since it started."""
    return sum(status.counts.get(name, 0) for name in _LOST)


class History:
    """Figures of the last `SECONDS` seconds, one per second."""

    def __init__(self) -> None:
        self._rows: dict[str, dict[str, deque[float]]] = {kind: {} for kind in ("rate", "latency", "lost", "error")}
        self._lost_before: dict[str, int] = {}
        self._count = 0

    def add(self, statuses: Mapping[str, ServiceStatus], errors_mm: Mapping[str, float]) -> None:
        """Add the figures of one second.

        Args:
            statuses: recent statuses by `service/instance`.
            errors_mm: errors by name, millimetres.
        """
        self._count = min(self._count + 1, SECONDS)
        shown = {name: s for name, s in statuses.items() if s.service != OWN_FIGURES}
        self._append("rate", {name: rate_hz(s) for name, s in shown.items()})
        self._append("latency", {name: latency_ms(s) for name, s in shown.items()})
        # A count decreases when a service restarts.
        self._append("lost", {n: max(0, lost(s) - self._lost_before.get(n, lost(s))) for n, s in shown.items()})
        totals = self._lost_before | {name: lost(s) for name, s in shown.items()}
        self._lost_before = {name: total for name, total in totals.items() if name in self._rows["lost"]}
        self._append("error", errors_mm)

    def _append(self, kind: str, values: Mapping[str, float]) -> None:
        rows = self._rows[kind]
        for name in values:
            if name not in rows and len(rows) < MOST_ROWS:
                rows[name] = deque([0.0] * (self._count - 1), maxlen=SECONDS)
        for name, row in rows.items():
            row.append(float(np.nan_to_num(values.get(name, 0.0))))
        for name in [name for name, row in rows.items() if len(row) == SECONDS and name not in values and not any(row)]:
            del rows[name]

    def chart(self, kind: str) -> Chart:
        """Return a chart: `rate` (1/s), `latency` (p99, ms), `lost` (1/s) or `error` (mm)."""
        rows = {name: np.array(row) for name, row in sorted(self._rows[kind].items())}
        return Chart(np.arange(1 - self._count, 1, dtype=np.float64), rows)


M = TypeVar("M", bound=Message)

MOVING_KEYS: Final = (
    "rhot/hand/*",
    "rhot/points",
    "rhot/object/*",
    "rhot/head",
    "rhot/foot/*",
    "rhot/body",
    "rhot/truth",
)
"""Keys of moving things, received without delay."""
MARKER_KEYS: Final = "rhot/markers/*"
STATUS_KEYS: Final = "rhot/status/*/*"
ALIVE_KEYS: Final = "rhot/alive/*/*"
_IDLE_S: Final = 0.1
_MAX_KEYS: Final = 1024
"""Largest number of keys: any sender may choose the last part of a key."""


@dataclass(slots=True)
class _Slot:
    """The newest sample of a key; `message` is None until it is decoded, and if it is invalid.

    Attributes:
        mailbox: its subscriber.
        trusted: whether any message of this key has been valid.
    """

    sample: Sample
    mailbox: LatestSubscriber
    trusted: bool
    decoded: bool = False
    message: Message | None = None


class Audience(Protocol):
    """The connected browsers of a page."""

    async def looked_at(self) -> None:
        """Return once a browser is connected."""

    async def left(self) -> None:
        """Return once no browser is connected."""


class Inbox:
    """The newest sample of each key, and the services that are alive."""

    def __init__(self) -> None:
        self._refuse: Callable[[str, WireError], None] = lambda key, error: None
        self._slots: dict[str, _Slot] = {}
        self.alive: set[str] = set()

    async def run(self, node: Node, audience: Audience) -> None:
        """Receive until cancelled; invalid messages are counted in the service's status.

        Without a browser only statuses are subscribed: unread samples of moving things take 7 % of a core.

        Args:
            node: connection to the bus.
            audience: the connected browsers.
        """
        self._refuse = node.refuse
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._receive(node.bus.latest(STATUS_KEYS), rest_s=_IDLE_S))
            tasks.create_task(self._follow_alive(node.bus))
            tasks.create_task(self._follow_while_looked_at(node.bus, audience))

    async def _follow_while_looked_at(self, bus: Bus, audience: Audience) -> None:
        while True:
            await audience.looked_at()
            moving, markers = bus.latest(*MOVING_KEYS), bus.latest(MARKER_KEYS)
            async with asyncio.TaskGroup() as reading:
                reading.create_task(self._receive(moving, rest_s=0.0))
                reading.create_task(self._receive(markers, rest_s=_IDLE_S))
                await audience.left()
                await bus.unsubscribe(moving)
                await bus.unsubscribe(markers)

    async def _receive(self, mailbox: LatestSubscriber, rest_s: float) -> None:
        """Store the newest sample of each key; during a pause of `rest_s`, newer samples replace unread older ones."""
        rested_s = -math.inf
        async for sample in mailbox:
            if time.monotonic() - rested_s >= rest_s > 0.0:
                # One pause for all waiting samples: one for each would delay a status by seconds.
                await asyncio.sleep(rest_s)
                rested_s = time.monotonic()
            if sample.deleted:
                continue
            # Removed and added again, so that the dict is ordered by arrival.
            before = self._slots.pop(sample.key, None)
            if len(self._slots) >= _MAX_KEYS:
                self._make_room()
            self._slots[sample.key] = _Slot(sample, mailbox, trusted=before is not None and before.trusted)

    def _make_room(self) -> None:
        """Discard the keys without a valid message; if there are none, the least recent quarter."""
        trusted = {key: slot for key, slot in self._slots.items() if slot.trusted}
        if len(trusted) == len(self._slots):
            trusted = dict(list(trusted.items())[len(trusted) // 4 :])
        self._slots = trusted

    async def _follow_alive(self, bus: Bus) -> None:
        async for sample in bus.liveliness(ALIVE_KEYS):
            name = sample.key.removeprefix("rhot/alive/")
            if sample.deleted:
                self.alive.discard(name)
            else:
                self.alive.add(name)

    def newest(self, key: str, model: type[M], max_age_s: float) -> M | None:
        """Return the newest message of a key; None if there is none, it is too old, or invalid (which is counted)."""
        slot = self._slots.get(key)
        if slot is None or time.monotonic_ns() - slot.sample.arrived_ns > max_age_s * 1e9:
            return None
        if not slot.decoded:
            slot.decoded = True
            try:
                slot.message = decode(slot.sample.payload, model)
                slot.trusted = True
                slot.mailbox.keep_slot_of(key)
            except WireError as error:
                self._refuse(key, error)
        return slot.message if isinstance(slot.message, model) else None

    def all_newest(self, prefix: str, model: type[M], max_age_s: float) -> dict[str, M]:
        """Return the newest messages of all keys with a prefix, by the rest of the key."""
        found = {
            key[len(prefix) :]: self.newest(key, model, max_age_s) for key in self._slots if key.startswith(prefix)
        }
        return {name: message for name, message in sorted(found.items()) if message is not None}
