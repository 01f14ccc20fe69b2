"""A bus session that puts recorded bytes back as they were."""

from __future__ import annotations

from typing import cast

import zenoh

from rhot.bus import Answer, Bus, Request, json_answer
from rhot.errors import BusError, ConfigError
from rhot.messages import unpack
from rhot.recording.mcap.reader import RecordedSample
from rhot.rig import BusConfig


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
