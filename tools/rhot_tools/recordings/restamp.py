"""Recorded messages with today's times, so that live services take them for their own moment.

A message of capture time t that the recorder got at L was L − t old then. Put out again at rate r when D has come on
the rig clock, it is given the time

    t' = D − (L − skew − t) / r,

so that distances between times follow the pace of the replay and a message is as old as it was. `skew` is how far the
recorder's clock was ahead of the recorded rig's.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, Final, cast

import msgpack
import numpy as np
import zenoh

from rhot.bus import Answer, Bus, Request, json_answer
from rhot.errors import BusError, ConfigError, WireError
from rhot.messages import unpack
from rhot.recording.mcap.reader import RecordedSample
from rhot.recording.mcap.wire_models import MSGPACK_ENCODING
from rhot.recording.player import GIVE_UP_NS
from rhot.rig import BusConfig

# A bus session that puts recorded bytes back as they were.


class ReplayBus(Bus):
    """A session with raw samples beside what every session can."""

    def __init__(self, session: zenoh.Session, config: BusConfig) -> None:
        super().__init__(session, config)
        self._last: dict[str, RecordedSample] = {}
        self._encodings: dict[str, zenoh.Encoding] = {}

    @classmethod
    async def open(cls, config: BusConfig, *, timeout_s: float | None = None) -> ReplayBus:
        """Open a session; see `Bus.open`."""
        return cast(ReplayBus, await super().open(config, timeout_s=timeout_s))

    def answer_with_last(self, key: str) -> None:
        """Answer queries for a key with the sample put last, as its live publisher does."""

        def answer(request: Request) -> Answer | None:
            sample = self._last.get(key)
            return None if sample is None else _as_wanted(sample, request)

        self.queryable(key, answer)

    def put_sample(self, sample: RecordedSample) -> None:
        """Put a sample on its key, from a thread that may wait: nothing is dropped, order is kept over all keys.

        Raises:
            BusError: the key is not valid, or the session is closed.
        """
        encoding = self._encodings.get(sample.encoding)
        if encoding is None:
            encoding = self._encodings[sample.encoding] = zenoh.Encoding(sample.encoding)
        self._last[sample.key] = sample
        try:
            # Straight through the session: a declared publisher drops what it puts before it knows of a reader.
            self._session.put(
                sample.key,
                sample.payload,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.REAL_TIME,
            )
        except zenoh.ZError as error:
            raise BusError(f"{sample.key}: cannot publish: {error}") from error


def _as_wanted(sample: RecordedSample, request: Request) -> Answer:
    if request.wants_json and sample.encoding.startswith("application/msgpack"):
        return json_answer(unpack(sample.payload))
    return Answer(sample.payload, sample.encoding)


def chosen_keys(keys: tuple[str, ...], key_expr: str) -> frozenset[str]:
    """Return the keys that a Zenoh key expression includes.

    Raises:
        ConfigError: it is not a key expression.
    """
    try:
        wanted = zenoh.KeyExpr(key_expr)
    except zenoh.ZError as error:
        raise ConfigError(
            f"--keys {key_expr}: not a Zenoh key expression, such as 'rhot/hand/*' or 'rhot/**'; parts between slashes "
            "must not be empty"
        ) from error
    chosen = set()
    for key in keys:
        try:
            if wanted.includes(zenoh.KeyExpr(key)):
                chosen.add(key)
        except zenoh.ZError:
            # Another program's topic that cannot stand on this bus.
            continue
    return frozenset(chosen)


_TIME_FIELDS: Final = frozenset({"t_ns", "start_t_ns"})
_SKEW_SAMPLES: Final = 500
_SKEW_SHARE: Final = 5.0
"""Percentile of the delays: the quickest messages tell the clocks apart, a single wrong time does not."""


def clock_skew_ns(samples: Iterable[RecordedSample]) -> int:
    """Return how far the recorder's clock was ahead of the rig clock, from the first samples.

    Messages arrive within a second; where they seem to have done so the clocks count as one, else the quickest messages
    count as not delayed at all.
    """
    delays = [
        sample.log_ns - sample.t_ns
        for sample in itertools.islice(samples, _SKEW_SAMPLES)
        if sample.encoding.startswith(MSGPACK_ENCODING) and sample.t_ns not in (0, sample.log_ns)
    ]
    if not delays:
        return 0
    least_ns = int(np.percentile(np.array(delays), _SKEW_SHARE, method="lower"))
    longest_delay_ns = 1_000_000_000
    return 0 if 0 <= least_ns < longest_delay_ns else least_ns


class Restamp:
    """Gives samples, in the order in which they leave, the times of a replay.

    The first one sets the time for all that follow; it is set again when a recording starts over and when the replay
    has fallen behind.
    """

    def __init__(self, rate: float, skew_ns: int, now_ns: Callable[[], int]) -> None:
        """Prepare.

        Args:
            rate: pace of the replay.
            skew_ns: see `clock_skew_ns`.
            now_ns: rig time.
        """
        self._rate = rate
        self._skew_ns = skew_ns
        self._now_ns = now_ns
        self._due_ns = 0
        self._log_ns: int | None = None

    def __call__(self, sample: RecordedSample) -> RecordedSample:
        """Return a sample with the times of now; what is no map in msgpack stays as it is."""
        now_ns = self._now_ns()
        passed_ns = -1 if self._log_ns is None else sample.log_ns - self._log_ns
        due_ns = self._due_ns + round(passed_ns / self._rate)
        if passed_ns < 0 or now_ns - due_ns > GIVE_UP_NS:
            due_ns = now_ns
        self._due_ns, self._log_ns = due_ns, sample.log_ns
        origin_ns = sample.log_ns - self._skew_ns

        def moved(t_ns: int) -> int:
            return max(0, due_ns + round((t_ns - origin_ns) / self._rate))

        return with_times(sample, moved)


def with_times(sample: RecordedSample, moved: Callable[[int], int]) -> RecordedSample:
    """Return a sample all of whose times were mapped; 0 is no time and stays."""
    if not sample.encoding.startswith(MSGPACK_ENCODING):
        return sample
    try:
        value = unpack(sample.payload)
    except WireError:
        # What was wrong on the bus is as wrong in the replay.
        return sample
    if not isinstance(value, dict):
        return sample
    payload: bytes = msgpack.packb(_mapped(value, moved))
    return replace(sample, payload=payload, t_ns=moved(sample.t_ns))


def _mapped(value: dict[str, Any], moved: Callable[[int], int]) -> dict[str, Any]:
    return {name: _mapped_field(name, field, moved) for name, field in value.items()}


def _mapped_field(name: str, field: Any, moved: Callable[[int], int]) -> Any:
    if isinstance(field, dict):
        return _mapped(field, moved)
    if name in _TIME_FIELDS and isinstance(field, int) and field:
        return moved(field)
    return field
