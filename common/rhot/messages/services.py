"""Messages between services: start and stop, the rig clock, status."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from rhot.messages.base import Count, Label, Message, Name, Sentence, TimeNs


class Control(Message):
    """The broadcast that starts and stops all services.

    Attributes:
        action: `start` or `stop`.
        session: identifies the run; a stop without a session stops whatever runs.
        start_t_ns: rig time at which everybody starts; it lies in the future when the message is sent, so that
            all cameras begin with the same moment.
        revision: one more than that of the newest control message that any service knew; orders messages whose times
            do not, because the rig clock was set back in between. 0 from a sender that did not ask.
    """

    action: Literal["start", "stop"]
    session: Label = ""
    start_t_ns: TimeNs = 0
    revision: Annotated[int, Field(ge=0, lt=1 << 53)] = 0


class ClockReply(Message):
    """Answer to a clock query: two of the four timestamps of the exchange.

    Attributes:
        t_ns: rig time when the answer left.
        received_t_ns: rig time when the query arrived.
        instance: identifies the clock, so that a restart of the machine that owns it is noticed.
    """

    received_t_ns: TimeNs
    instance: Name


class ServiceStatus(Message):
    """Once a second from every service.

    Attributes:
        service, instance: who.
        state: what it does now.
        session: id of the running session.
        uptime_s: seconds since the process started.
        rates: events per second over the last interval, by name.
        counts: events since start, by name: `invalid`, `dropped_late`, `missed`, …
        latency_s: percentiles over the last seconds, by stage: `{"total": {"p50": …, "p99": …}}`.
        figures: other figures of this kind of service, such as `epipolar_px`, the mean epipolar residual.
        problem: what is wrong with the rig as a whole right now, one sentence; empty when nothing is.
        last_error: newest error, empty when none.
        config_digest: changes when the configuration does.
        clock_offset_s: rig clock minus this node's clock.
        clock_uncertainty_s: bound of the remaining error of that offset; absent before the first exchange.
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
