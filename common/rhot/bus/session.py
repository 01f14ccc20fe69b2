"""Opening, using and closing the Zenoh session."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, Protocol, TypeVar

import zenoh

from rhot.bus.publisher import Publisher
from rhot.bus.query import Answerer, Reply, TimedAnswer, received, refuse, respond
from rhot.bus.subscriber import EventSubscriber, LatestSubscriber
from rhot.bus.zenoh_config import MAX_SAMPLE_BYTES, MAX_WAITING_ANSWERS, LimitCounts, plain_reason, session_config
from rhot.errors import BusError
from rhot.messages import Message
from rhot.rig.sections import BusConfig

logger = logging.getLogger(__name__)

M = TypeVar("M", bound=Message)

_OPEN_RETRY_S: Final = 0.25
_CLOSE_LIMIT_S: Final = 1.0
_EVENT_LIMIT: Final = 4096
_MOST_TIMED: Final = 8
"""Timed answers that are kept: a rig has one clock."""


class _Undeclarable(Protocol):
    def undeclare(self) -> None: ...


def _elsewhere(config: BusConfig) -> str:
    """Return what to do about a router on another machine, where this one only looks for one of its own."""
    own = config.connect and all(
        "/127." in each or "/localhost:" in each or "/[::1]" in each for each in config.connect
    )
    return "; if it runs on another machine, bring this one's certificate: `rhot keys install`" if own else ""


CONNECT_S: Final = 3.0
"""How long a command waits for the router; services wait as long as it takes."""


class Bus:
    """One Zenoh session with everything that was declared on it; use `async with await Bus.open(...)`."""

    def __init__(self, session: zenoh.Session, config: BusConfig) -> None:
        self.config = config
        self._session = session
        self._declared: list[_Undeclarable] = []
        self._subscribed: dict[LatestSubscriber | EventSubscriber, list[_Undeclarable]] = {}
        self._workers = ThreadPoolExecutor(max_workers=2, thread_name_prefix="rhot-answer")
        self._room = threading.BoundedSemaphore(MAX_WAITING_ANSWERS)
        self._limits = LimitCounts()
        self._closed = False

    @classmethod
    async def open(cls, config: BusConfig, *, timeout_s: float | None = None) -> Bus:
        """Open a session, waiting for the router as long as it takes or `timeout_s` says.

        Raises:
            BusError: the configuration is unusable, or nobody answered in time.
        """
        zenoh_config = session_config(config)
        started = time.monotonic()
        logged = False
        while True:
            try:
                return cls(await asyncio.to_thread(zenoh.open, zenoh_config), config)
            except zenoh.ZError as error:
                where = ", ".join(config.connect or config.listen)
                if config.mode == "router" and "in use" in str(error):
                    raise BusError(
                        f"no router can listen on {where}: another program does, perhaps a rig that runs already "
                        "(`rhot status` tells); end it, or change [bus] in rig.toml (for `rhot router` and `rhot sim` "
                        "also --listen)"
                    ) from error
                if config.mode == "router" or "invalid" in str(error).lower():
                    raise BusError(f"cannot open a Zenoh {config.mode} on {where}: {plain_reason(error)}") from error
                if timeout_s is not None and time.monotonic() - started >= timeout_s:
                    secured = ", with this certificate" if config.tls else ""
                    raise BusError(
                        f"no Zenoh router answers at {where}{secured}; is the rig running (`rhot sim`, `rhot up`), "
                        f"and does --connect (or [bus] connect in rig.toml) name its machine? "
                        f"(Zenoh: {plain_reason(error)})"
                    ) from error
                if not logged:
                    # A tool waits for a moment and then says what is wrong; a service waits for ever.
                    level = logging.INFO if timeout_s is None else logging.DEBUG
                    logger.log(level, "waiting for the Zenoh router at %s%s", where, _elsewhere(config))
                    logged = True
            await asyncio.sleep(_OPEN_RETRY_S)

    async def __aenter__(self) -> Bus:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def limit_counts(self) -> dict[str, int]:
        """Return how often each limit kept something out, by name; empty when none did."""
        return self._limits.counts()

    def publisher(self, key: str, model: type[M], *, reliable: bool = False, bulk: bool = False) -> Publisher[M]:
        """Declare a publisher; its last value can be queried under the same key.

        Args:
            key: the key.
            model: model of all messages on it.
            reliable: never drop; for control and configuration. A realtime key must not wait for slow readers.
            bulk: large and in no hurry, so that all else goes first: for pictures.
        """
        control = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP
        priority = zenoh.Priority.BACKGROUND if bulk else zenoh.Priority.REAL_TIME
        # Not express: under a Python router it loses samples and is no faster.
        declared = self._session.declare_publisher(
            key,
            congestion_control=control,
            priority=zenoh.Priority.INTERACTIVE_HIGH if reliable else priority,
            reliability=zenoh.Reliability.RELIABLE,
        )
        self._declared.append(declared)
        publisher = Publisher(key, model, declared)
        self.queryable(key, publisher.answer_last)
        return publisher

    def latest(self, *key_exprs: str) -> LatestSubscriber:
        """Subscribe newest-wins: one slot per key; several key expressions share a mailbox and its wake-ups."""
        return self._subscribe(LatestSubscriber(self._limits), *key_exprs)

    def events(self, key_expr: str, limit: int = _EVENT_LIMIT) -> EventSubscriber:
        """Subscribe to every sample, up to `limit` unread ones."""
        return self._subscribe(EventSubscriber(limit, self._limits), key_expr)

    _Mail = TypeVar("_Mail", LatestSubscriber, EventSubscriber)

    def _subscribe(self, mailbox: _Mail, *key_exprs: str) -> _Mail:
        try:
            self._subscribed[mailbox] = [
                # indirect=False: no queue and no thread of zenoh's own between the network and the mailbox.
                self._session.declare_subscriber(key_expr, zenoh.handlers.Callback(mailbox, indirect=False))
                for key_expr in key_exprs
            ]
        except zenoh.ZError as error:
            raise BusError(f"{', '.join(key_exprs)}: {plain_reason(error)}") from error
        return mailbox

    async def unsubscribe(self, mailbox: LatestSubscriber | EventSubscriber) -> None:
        """Take a subscription back, so that its keys no longer travel to this process, and end its mailbox."""
        mailbox.close()
        for subscriber in self._subscribed.pop(mailbox, []):
            await asyncio.to_thread(_undeclare, subscriber)

    def liveliness(self, key_expr: str) -> EventSubscriber:
        """Subscribe to who comes and goes; those already there are reported first."""
        mailbox = EventSubscriber(_EVENT_LIMIT, self._limits)
        handler = zenoh.handlers.Callback(mailbox, indirect=False)
        self._subscribed[mailbox] = [self._session.liveliness().declare_subscriber(key_expr, handler, history=True)]
        return mailbox

    async def who_is_alive(self, key_expr: str = "rhot/alive/**", *, timeout_s: float = 1.0) -> list[Reply]:
        """Return the liveliness tokens that match, one reply each."""

        def ask() -> list[Reply]:
            asked_s = time.monotonic()
            return received(self._session.liveliness().get(key_expr, timeout=timeout_s), timeout_s, asked_s)

        return await asyncio.to_thread(ask)

    def alive(self, key: str) -> None:
        """Declare a liveliness token; it vanishes with this process, however that ends."""
        self._declared.append(self._session.liveliness().declare_token(key))

    def queryable(self, key: str, answerer: Answerer, *, slow: bool = False) -> None:
        """Answer queries on a key.

        Args:
            key: the key.
            answerer: called on Zenoh's thread, so it must be quick and thread-safe.
            slow: call it on a worker thread instead (for pictures).
        """

        def on_query(query: zenoh.Query) -> None:
            arrived_ns = time.time_ns()
            if not slow or self._closed:
                respond(query, key, answerer, arrived_ns)
            elif self._room.acquire(blocking=False):
                self._workers.submit(self._respond_slowly, query, key, answerer, arrived_ns)
            else:
                self._limits.hit("questions_refused")
                refuse(query, f"{key}: {MAX_WAITING_ANSWERS} questions wait already; ask less often")

        handler = zenoh.handlers.Callback(on_query, indirect=False)
        self._declared.append(self._session.declare_queryable(key, handler))

    def _respond_slowly(self, query: zenoh.Query, key: str, answerer: Answerer, arrived_ns: int) -> None:
        try:
            respond(query, key, answerer, arrived_ns)
        finally:
            self._room.release()

    async def get(self, selector: str, payload: bytes = b"", *, timeout_s: float = 2.0) -> list[Reply]:
        """Query everybody who answers a selector (`key?parameters`) and return all replies.

        One reply with an error stands for all who are there but do not answer in time.

        Raises:
            BusError: the key is not valid (it alone is named: parameters are often our own), or the session is closed.
        """
        return await asyncio.to_thread(self._get, selector, payload, timeout_s)

    def _get(self, selector: str, payload: bytes, timeout_s: float) -> list[Reply]:
        asked_s = time.monotonic()
        try:
            replies = self._session.get(
                selector,
                payload=payload or None,
                timeout=timeout_s,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            return received(replies, timeout_s, asked_s)
        except zenoh.ZError as error:
            raise BusError(f"{selector.partition('?')[0]}: {plain_reason(error)}") from error

    async def ask(self, key: str, clock_ns: Callable[[], int], timeout_s: float) -> list[TimedAnswer]:
        """Query everybody who answers one key, and time each answer; before everything else on the link.

        Both times are read from `clock_ns`, in the threads that send and receive, so that a busy event loop does not
        lengthen the round trip. The question is dropped where the link is full: a late one would tell nothing.
        """
        loop = asyncio.get_running_loop()
        ended: asyncio.Future[None] = loop.create_future()
        answers: list[TimedAnswer] = []
        sent_ns = 0

        def finish() -> None:
            if not ended.done():
                ended.set_result(None)

        def on_reply(reply: zenoh.Reply) -> None:
            arrived_ns = clock_ns()
            if reply.ok is not None and len(answers) < _MOST_TIMED and len(reply.ok.payload) <= MAX_SAMPLE_BYTES:
                answers.append(TimedAnswer(reply.ok.payload.to_bytes(), sent_ns, arrived_ns))

        def on_end() -> None:
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(finish)

        def send() -> None:
            nonlocal sent_ns
            handler = zenoh.handlers.Callback(on_reply, drop=on_end, indirect=False)
            sent_ns = clock_ns()
            self._session.get(
                key,
                handler,
                timeout=timeout_s,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
            )

        try:
            # Off the event loop: a link that is dead but not yet closed may hold it for seconds.
            await asyncio.to_thread(send)
        except zenoh.ZError as error:
            raise BusError(f"{key}: {plain_reason(error)}") from error
        await ended
        return answers

    async def put(self, key: str, payload: bytes, encoding: str) -> None:
        """Put raw bytes on a key, reliably; for configuration and for replays.

        Raises:
            BusError: the key is not valid, or the session is closed.
        """
        try:
            await asyncio.to_thread(
                self._session.put,
                key,
                payload,
                encoding=zenoh.Encoding(encoding),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        except zenoh.ZError as error:
            raise BusError(f"{key}: {plain_reason(error)}") from error

    async def close(self) -> None:
        """Undeclare everything and close the session, within a second even where Zenoh hangs."""
        if self._closed:
            return
        self._closed = True
        for mailbox in self._subscribed:
            mailbox.close()
        self._workers.shutdown(wait=False, cancel_futures=True)
        # A daemon thread: a close that hangs must not keep the process alive.
        closed = asyncio.Event()
        loop = asyncio.get_running_loop()
        closer = threading.Thread(target=self._close_session, args=(loop, closed), name="rhot-close", daemon=True)
        closer.start()
        try:
            await asyncio.wait_for(closed.wait(), _CLOSE_LIMIT_S)
            # It has only to return: an interpreter that ends around a living thread aborts.
            closer.join(_CLOSE_LIMIT_S)
        except TimeoutError:
            logger.warning("the Zenoh session did not close within %.0f s", _CLOSE_LIMIT_S)

    def _close_session(self, loop: asyncio.AbstractEventLoop, closed: asyncio.Event) -> None:
        subscribers = [subscriber for declared in list(self._subscribed.values()) for subscriber in declared]
        for declared in reversed([*self._declared, *subscribers]):
            _undeclare(declared)
        try:
            self._session.close()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            logger.debug("close: %s", error)
        with contextlib.suppress(RuntimeError):  # the loop gave up waiting and is closed
            loop.call_soon_threadsafe(closed.set)


def _undeclare(declared: _Undeclarable) -> None:
    try:
        declared.undeclare()
    # RuntimeError: a thread is still inside a `put` on it ("Already borrowed"); it ends with the session.
    except (zenoh.ZError, RuntimeError) as error:
        logger.debug("undeclare: %s", error)
