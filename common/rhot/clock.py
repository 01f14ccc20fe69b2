"""The rig clock: how a node's own clock is mapped to the clock of the machine that runs fusion.

A node sends a query at its own time t0; the owner of the rig clock notes t1 when it arrives and t2 when the answer
leaves (rig time); the node notes t3 when the answer is there (own time). With the delay of both ways equal,

    offset = rig − node = ((t1 − t0) + (t2 − t3)) / 2,        round trip = (t3 − t0) − (t2 − t1),

and whatever the delays were, the true offset lies within ± round trip / 2 of that (Mills, RFC 5905 section 8). The
exchanges with the shortest round trips of the last minute therefore count; a line through them gives the drift. What
is stated as uncertainty is how far the bounds of all of them together let the truth be from that.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import BusError

WINDOW: Final = 120
"""Exchanges kept: one minute at two a second."""
MAX_DRIFT: Final = 200e-6
"""No quartz is worse; bounds how the uncertainty grows between exchanges."""
_DRIFT_STEP: Final = 4e-6
"""Between the drifts that are tried; half of it is more than a quartz wanders in a minute indoors."""
_DRIFTS: Final = np.arange(-MAX_DRIFT, MAX_DRIFT + 0.5 * _DRIFT_STEP, _DRIFT_STEP)
_FIT_SPAN_NS: Final = 10_000_000_000
"""A drift is fitted only over at least this long; over less it would be noise."""
_UNINTERRUPTED_NS: Final = 20_000
"""Three readings of clocks take 1 µs on a PC, 3 µs on a Raspberry Pi; an interruption takes longer than this."""
_READINGS: Final = 5
"""Tries to read clocks without an interruption."""


class NodeClock(Protocol):
    """A node's own clock: monotonic, arbitrary origin."""

    def now_ns(self) -> int:
        """Return the node's time, nanoseconds."""
        ...


class SystemClock:
    """The machine's monotonic clock."""

    def now_ns(self) -> int:
        """Return `time.monotonic_ns`."""
        return time.monotonic_ns()


class SkewedClock:
    """The clock of a simulated node: off by an offset and running at its own rate.

    node = true + offset + drift · (true − origin), with `time.time_ns` as true time.
    """

    def __init__(self, offset_ns: int, drift_ppm: float) -> None:
        self._offset_ns = offset_ns
        self._drift = drift_ppm * 1e-6
        self._origin_ns = time.time_ns()

    def now_ns(self) -> int:
        """Return the simulated node's time, nanoseconds."""
        return self.from_true_ns(time.time_ns())

    def from_true_ns(self, true_ns: int) -> int:
        """Return what this clock shows at a true time."""
        return true_ns + self._offset_ns + round(self._drift * (true_ns - self._origin_ns))


def difference_ns(clock: Callable[[], int], other: Callable[[], int]) -> int:
    """Return `clock` minus `other`, nanoseconds.

    `clock` is read between two readings of `other`. Where the process was interrupted among them, they are read again:
    a difference of two readings that lie milliseconds apart would put a picture at a wrong time.
    """
    narrowest_ns, difference = None, 0
    for _ in range(_READINGS):
        before_ns, reading_ns, after_ns = other(), clock(), other()
        if narrowest_ns is None or after_ns - before_ns < narrowest_ns:
            narrowest_ns, difference = after_ns - before_ns, reading_ns - (before_ns + after_ns) // 2
        if narrowest_ns < _UNINTERRUPTED_NS:
            break
    return difference


class RigClock(Protocol):
    """Rig time as one node knows it."""

    @property
    def ready(self) -> bool:
        """Whether rig time is known at all."""
        ...

    @property
    def offset_ns(self) -> int | None:
        """Rig minus node clock, now; None before it is known."""
        ...

    @property
    def uncertainty_ns(self) -> int | None:
        """Bound of the error of `offset_ns`; None before it is known."""
        ...

    def now_ns(self) -> int:
        """Return rig time now."""
        ...

    def to_rig_ns(self, node_ns: int) -> int:
        """Return the rig time of a moment on the node's clock."""
        ...


class LocalRigClock:
    """Rig time on the machine that owns it: its system clock."""

    ready = True
    uncertainty_ns = 0

    def __init__(self, node: NodeClock) -> None:
        self._node = node

    @property
    def offset_ns(self) -> int:
        """System clock minus node clock."""
        return difference_ns(time.time_ns, self._node.now_ns)

    def now_ns(self) -> int:
        """Return rig time now."""
        return time.time_ns()

    def to_rig_ns(self, node_ns: int) -> int:
        """Return the rig time of a moment on the node's clock."""
        return node_ns + self.offset_ns


@dataclass(frozen=True, slots=True)
class Exchange:
    """The four timestamps of one query: t0 and t3 on the node's clock, t1 and t2 on the rig's, nanoseconds."""

    t0: int
    t1: int
    t2: int
    t3: int

    @property
    def offset_ns(self) -> int:
        """Rig minus node, with equal delays assumed."""
        return ((self.t1 - self.t0) + (self.t2 - self.t3)) // 2

    @property
    def round_trip_ns(self) -> int:
        """Time on the way, both directions."""
        return (self.t3 - self.t0) - (self.t2 - self.t1)

    @property
    def possible(self) -> bool:
        """Whether it can be true: nobody's clock ran backwards, and the rig did not take longer than the whole."""
        return self.round_trip_ns >= 0 and self.t2 >= self.t1

    @property
    def mid_ns(self) -> int:
        """Middle of the exchange, node clock."""
        return (self.t0 + self.t3) // 2


@dataclass(frozen=True, slots=True)
class _Line:
    """Rig minus node clock as a line through `offset_ns` at the node's time `node_ns`, of the newest exchange.

    Attributes:
        drift: its slope.
        error_ns, drift_error: bounds of the errors of both.
    """

    node_ns: int
    offset_ns: int
    error_ns: float
    drift: float
    drift_error: float


class ClockEstimator:
    """Offset and drift between a node's clock and the rig's from four-timestamp exchanges; reads no clock itself."""

    def __init__(self) -> None:
        self._exchanges: deque[Exchange] = deque(maxlen=WINDOW)
        # Replaced as a whole: other threads read it.
        self._line: _Line | None = None
        self.steps = 0

    @property
    def ready(self) -> bool:
        """Whether there was an exchange."""
        return self._line is not None

    @property
    def drift_ppm(self) -> float:
        """Rate of the rig clock against the node's, parts per million."""
        return 0.0 if self._line is None else self._line.drift * 1e6

    def add(self, exchange: Exchange) -> bool:
        """Add an exchange; return whether it was accepted.

        One with a negative round trip or a rig clock that ran backwards within it is not. An exchange whose bounds
        exclude the present estimate shows that a clock was set: everything before it is forgotten.
        """
        if not exchange.possible:
            return False
        if self._exchanges:
            distance = abs(exchange.offset_ns - self.offset_at(exchange.mid_ns))
            step_margin_ns = 1_000_000
            allowed = exchange.round_trip_ns / 2 + self.uncertainty_at(exchange.mid_ns) + step_margin_ns
            if distance > allowed:
                self.reset()
                self.steps += 1
        self._exchanges.append(exchange)
        self._fit()
        return True

    def reset(self) -> None:
        """Forget all exchanges: the rig clock is another one now. What was known holds until the next one."""
        self._exchanges.clear()

    def offset_at(self, node_ns: int) -> int:
        """Return rig minus node at a node time, nanoseconds.

        Raises:
            BusError: there was no exchange yet.
        """
        line = self._known()
        return line.offset_ns + round(line.drift * (node_ns - line.node_ns))

    def uncertainty_at(self, node_ns: int) -> float:
        """Return the bound of the offset's error at a node time, nanoseconds."""
        line = self._known()
        return line.error_ns + line.drift_error * max(0, node_ns - line.node_ns)

    def _known(self) -> _Line:
        if self._line is None:
            raise BusError("the rig clock is not known yet: no service answered rhot/clock; is fusion running?")
        return self._line

    def _fit(self) -> None:
        mids = np.array([exchange.mid_ns - self._exchanges[-1].mid_ns for exchange in self._exchanges], dtype=float)
        newest_offset = self._exchanges[-1].offset_ns
        offsets = np.array([exchange.offset_ns - newest_offset for exchange in self._exchanges], dtype=float)
        trips = np.array([exchange.round_trip_ns for exchange in self._exchanges], dtype=float)
        # Asymmetry can hide at most half the round trip: weigh by it, so that the quickest exchanges decide.
        floor = trips.min()
        weights = 1.0 / np.square(trips - 0.9 * floor + 1_000.0)
        total = weights.sum()
        mean_mid, mean_offset = (weights @ mids) / total, (weights @ offsets) / total
        drift = 0.0
        if mids[-1] - mids[0] >= _FIT_SPAN_NS:
            centred = mids - mean_mid
            spread = weights @ np.square(centred)
            if spread > 0:
                drift = float(np.clip((weights @ (centred * (offsets - mean_offset))) / spread, -MAX_DRIFT, MAX_DRIFT))
        estimate = mean_offset - drift * mean_mid
        # Nothing of that is more than a best guess, so it is held to what the bounds of all exchanges leave possible.
        left = _possible(mids, offsets, trips)
        if left is None:
            # No steady clocks can have given these: one of them changed its rate. Only what is newer counts.
            for _ in range(len(self._exchanges) // 2):
                self._exchanges.popleft()
            self._fit()
            return
        (least_ns, most_ns), (slowest, fastest) = left
        estimate = min(max(estimate, least_ns), most_ns)
        drift = min(max(drift, slowest), fastest)
        self._line = _Line(
            node_ns=self._exchanges[-1].mid_ns,
            offset_ns=newest_offset + round(estimate),
            error_ns=max(most_ns - estimate, estimate - least_ns),
            drift=drift,
            drift_error=max(fastest - drift, drift - slowest),
        )


def _possible(
    mids: FloatArray, offsets: FloatArray, trips: FloatArray
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return the least and most that the offset at time 0 and the drift can be, whatever the delays were.

    With a steady drift d each exchange i says o_i − h_i ≤ x + d·m_i ≤ o_i + h_i, h_i half its round trip. All d of a
    grid are tried; the bounds are widened by what lies between two of them, so that the true one is never missed.

    Args:
        mids: (N,) m_i, nanoseconds, none after 0.
        offsets: (N,) o_i, nanoseconds.
        trips: (N,) nanoseconds.
    """
    half_widths = trips / 2 + 0.5 * _DRIFT_STEP * np.abs(mids) + 1.0
    moved = offsets - _DRIFTS[:, None] * mids
    lower, upper = (moved - half_widths).max(axis=1), (moved + half_widths).min(axis=1)
    possible = lower <= upper
    if not possible.any():
        return None
    drifts = _DRIFTS[possible]
    half = 0.5 * _DRIFT_STEP
    return (
        (float(lower[possible].min()), float(upper[possible].max())),
        (float(drifts[0]) - half, float(drifts[-1]) + half),
    )


class SyncedRigClock:
    """Rig time on a node that estimates it."""

    def __init__(self, node: NodeClock) -> None:
        self.node = node
        self.estimator = ClockEstimator()

    @property
    def ready(self) -> bool:
        """Whether rig time is known at all."""
        return self.estimator.ready

    @property
    def offset_ns(self) -> int | None:
        """Rig minus node clock, now."""
        return self.estimator.offset_at(self.node.now_ns()) if self.ready else None

    @property
    def uncertainty_ns(self) -> int | None:
        """Bound of the error of the offset, now."""
        return round(self.estimator.uncertainty_at(self.node.now_ns())) if self.ready else None

    def now_ns(self) -> int:
        """Return rig time now."""
        return self.to_rig_ns(self.node.now_ns())

    def to_rig_ns(self, node_ns: int) -> int:
        """Return the rig time of a moment on the node's clock."""
        return node_ns + self.estimator.offset_at(node_ns)
