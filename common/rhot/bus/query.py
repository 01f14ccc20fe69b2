"""Answering queries: what a queryable gets, what it gives back, and how that reaches Zenoh."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import zenoh

from rhot.bus.zenoh_config import MAX_REPLIES, MAX_REPLY_BYTES
from rhot.errors import RhotError
from rhot.messages import Message, encode, encoding_of
from rhot.text import SparingLog, printable

logger = logging.getLogger(__name__)
_sparing = SparingLog()

JSON_ENCODING: Final = "application/json"
ACT: Final = "do"
"""The parameter that asks for more than an answer, as in `rhot/keep/capture/left?do=save`."""


@dataclass(frozen=True, slots=True)
class Request:
    """One query.

    Attributes:
        key: key expression that was asked for; it may hold wildcards.
        parameters: what stood behind `?` in the selector; `do` is left out of a question with wildcards.
        payload: what came with the query; left out of a question with wildcards. Whoever wants something done names
            the one who shall do it, so that the router can judge whether they may.
        arrived_ns: `time.time_ns` on arrival, taken before anything else was done.
    """

    key: str
    parameters: Mapping[str, str] = field(default_factory=dict)
    payload: bytes = b""
    arrived_ns: int = 0

    @property
    def wants_json(self) -> bool:
        """Whether `?format=json` was asked for."""
        return self.parameters.get("format") == "json"


@dataclass(frozen=True, slots=True)
class Answer:
    """What goes back: a payload and its encoding."""

    payload: bytes
    encoding: str


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer as the asking side receives it.

    Attributes:
        key: key of the answer, printable; empty for an error.
        payload: bytes of the answer.
        encoding: its Zenoh encoding.
        error: the other side's words where it refused, printable.
    """

    key: str
    payload: bytes
    encoding: str
    error: str = ""


@dataclass(frozen=True, slots=True)
class TimedAnswer:
    """One answer, with when it was asked for and when it arrived, on the asker's clock, nanoseconds."""

    payload: bytes
    sent_ns: int
    arrived_ns: int


Answerer = Callable[[Request], Answer | None]
"""Answers a request, on a thread that is not the event loop's; None = nothing to say; RhotError = refusal."""


def json_answer(value: Any) -> Answer:
    """Return an answer that holds a plain value as JSON."""
    return Answer(json.dumps(value, allow_nan=False).encode(), JSON_ENCODING)


def message_answer(message: Message, request: Request) -> Answer:
    """Return a message as the request wants it: msgpack, or JSON for `?format=json`."""
    if request.wants_json:
        return Answer(message.model_dump_json(exclude_none=True).encode(), JSON_ENCODING)
    return Answer(encode(message), encoding_of(type(message)))


def respond(query: zenoh.Query, key: str, answerer: Answerer, arrived_ns: int) -> None:
    """Answer one Zenoh query; whatever goes wrong reaches the asker as an error, never as a timeout."""
    # A query that is not dropped keeps the asker waiting until its timeout.
    with query:
        asked = str(query.key_expr)
        parameters = dict(_parameters(str(query.parameters)))
        if asked != key:
            parameters.pop(ACT, None)
        request = Request(
            key=printable(asked),
            parameters=parameters,
            payload=query.payload.to_bytes() if query.payload is not None and asked == key else b"",
            arrived_ns=arrived_ns,
        )
        try:
            answer = answerer(request)
            if answer is not None:
                query.reply(key, answer.payload, encoding=zenoh.Encoding(answer.encoding))
        except RhotError as error:
            query.reply_err(str(error).encode(), encoding=zenoh.Encoding("text/plain"))
        except Exception as error:
            if (quiet := _sparing.due(key)) is not None:
                logger.exception("%s: answering a query failed (%d similar messages suppressed)", key, quiet)
            query.reply_err(f"internal error: {error}".encode(), encoding=zenoh.Encoding("text/plain"))


def refuse(query: zenoh.Query, reason: str) -> None:
    """Answer a query with a refusal."""
    with query:
        query.reply_err(reason.encode(), encoding=zenoh.Encoding("text/plain"))


def received(replies: Iterable[zenoh.Reply], timeout_s: float, asked_s: float) -> list[Reply]:
    """Return the replies to a query, and one error at the end when somebody was asked and stayed silent.

    The router and the session of the asker each have a timer for the same query, and either may win, or both, so the
    number of Zenoh's own `Timeout` replies says nothing: now and then, beside load, there is none. Where nobody was
    asked, the replies end at once.

    Args:
        replies: of Zenoh; ends when all have answered or the time is over.
        timeout_s: how long the query lasts.
        asked_s: when it was sent, `time.monotonic`.
    """
    found: list[Reply] = []
    silent = False
    left_bytes = MAX_REPLY_BYTES
    for reply in replies:
        if len(found) >= MAX_REPLIES or left_bytes < 0:
            logger.warning(
                "a question has over %d answers or %d bytes; the rest is left out", MAX_REPLIES, MAX_REPLY_BYTES
            )
            break
        if reply.ok is not None:
            sample = reply.ok
            left_bytes -= len(sample.payload)
            key, encoding = printable(str(sample.key_expr)), printable(str(sample.encoding))
            found.append(Reply(key, sample.payload.to_bytes(), encoding))
            continue
        text = reply.err.payload.to_string() if reply.err is not None else "no answer"
        if text == "Timeout":
            silent = True
        else:
            found.append(Reply("", b"", "", error=printable(text)))
    silent |= time.monotonic() - asked_s >= timeout_s
    return [*found, Reply("", b"", "", error=f"no answer within {timeout_s:g} s")] if silent else found


def _parameters(text: str) -> list[tuple[str, str]]:
    # Zenoh separates by `;`; people who come from the web write `&`.
    pairs = [part.partition("=") for part in text.replace("&", ";").split(";") if part]
    return [(name, value) for name, _, value in pairs]
