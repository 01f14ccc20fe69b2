"""Messages between services: control, rig clock, status."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from rhot.messages.base import Count, Label, Message, Name, Sentence, TimeNs


class Control(Message):
    """The broadcast that starts and stops all services.

    Attributes:
        action: `start` or `stop`.
        session: id of the session; a stop without a session stops any session.
        start_t_ns: rig time at which all services start; in the future when the message is sent, so that all cameras
            start at the same time.
        revision: one more than that of the newest control message known to any service; orders messages even if the
            rig clock was set back in between. 0 if the sender did not query it.
    """

    action: Literal["start", "stop"]
    session: Label = ""
    start_t_ns: TimeNs = 0
    revision: Annotated[int, Field(ge=0, lt=1 << 53)] = 0


class ClockReply(Message):
    """Answer to a clock query: two of the four timestamps of the exchange.

    Attributes:
        t_ns: rig time at which the answer was sent.
        received_t_ns: rig time at which the query arrived.
        instance: id of the clock, which changes when its machine restarts.
    """

    received_t_ns: TimeNs
    instance: Name


class ServiceStatus(Message):
    """Status of a service, published once a second.

    Attributes:
        service, instance: names of the service and its instance.
        state: present state.
        session: id of the running session; empty when none.
        uptime_s: seconds since the process started.
        rates: events per second over the last interval, by name.
        counts: events since the start of the process, by name: `invalid`, `dropped_late`, `missed`, …
        latency_s: percentiles over the last seconds, by part of the way: `{"total": {"p50": …, "p99": …}}`.
        figures: other figures of this service, such as `epipolar_px`, the mean epipolar residual.
        problem: present problem of the rig, one sentence; empty when none.
        last_error: newest error; empty when none.
        config_digest: hash of the configuration.
        clock_offset_s: rig clock minus this node's clock.
        clock_uncertainty_s: bound of the error of that offset; absent before the first exchange.
    """

    service: Name
    instance: Name
    state: Literal["starting", "waiting", "running", "stopping"]
    session: Label = ""
    uptime_s: Annotated[float, Field(ge=0.0)] = 0.0
    rates: Annotated[dict[Name, float], Field(max_length=256)] = {}
    counts: Annotated[dict[Name, Count], Field(max_length=256)] = {}
    latency_s: Annotated[dict[Name, dict[Name, float]], Field(max_length=64)] = {}
    figures: Annotated[dict[Name, float], Field(max_length=64)] = {}
    problem: Sentence = ""
    last_error: Sentence = ""
    config_digest: Label = ""
    clock_offset_s: float | None = None
    clock_uncertainty_s: float | None = None
