"""Running a service from start to exit code.

connect → announce → (wait for `start` → wait for its start time → run → `stop`)* → close. Everything else that all
services share goes on beside it: status once a second, rig clock, control, configuration, signs of life for systemd.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Protocol

from pydantic import BaseModel

from rhot.bus import Bus, Request
from rhot.bus.query import Answer
from rhot.clock import LocalRigClock, NodeClock, SyncedRigClock, SystemClock
from rhot.errors import BusError, ConfigError, DeviceError, HungDeviceError, RhotError, WireError
from rhot.keys import SERVICES, key_file
from rhot.messages import Control, ServiceStatus
from rhot.rig.sections import BusConfig
from rhot.service import configuration
from rhot.service.clock_sync import ClockWatch, keep_synced, serve_clock, watch_for_rivals
from rhot.service.control import CONTROL_KEY, ControlLink, with_start_in_reach
from rhot.service.node import Node
from rhot.service.status import StatusBoard
from rhot.service.stop import install_stop, notify, run_to_the_end, watchdog_interval_s

logger = logging.getLogger(__name__)

_STATUS_INTERVAL_S: Final = 1.0
_RETRY_FIRST_S: Final = 0.5
_RETRY_MAX_S: Final = 5.0
"""Until a device that failed is opened again; doubled each time, up to the second."""
_LOOP_CHECK_S: Final = 0.1
"""How often the event loop proves that it turns."""


class Service(Protocol):
    """What the runner needs of a service."""

    @property
    def name(self) -> str:
        """Kind of service, such as `capture`."""
        ...

    @property
    def instance(self) -> str:
        """Which one, such as the camera's name."""
        ...

    @property
    def owns_clock(self) -> bool:
        """Whether this machine's clock is the rig clock; true for fusion alone."""
        ...

    @property
    def config(self) -> BaseModel:
        """What `rhot/config/<service>/<instance>` shows."""
        ...

    def reconfigure(self, config: BaseModel) -> None:
        """Take a validated configuration while running; a ConfigError refuses it."""
        ...

    def attach(self, node: Node) -> None:
        """Declare publishers and queryables, once."""
        ...

    async def run(self, node: Node, start: Control) -> None:
        """Work until cancelled (stop), or until the input has ended."""
        ...


def run_service(
    service: Service | Sequence[Service], bus_config: BusConfig, *, node_clock: NodeClock | None = None
) -> int:
    """Run a service, or several in one process, until a signal ends it, and return the process's exit code.

    Raises:
        RhotError: the service cannot work as it is configured, or its device hangs.
    """
    return run_to_the_end(serve(service, bus_config, node_clock or SystemClock()))


async def serve(
    service: Service | Sequence[Service],
    bus_config: BusConfig,
    node_clock: NodeClock,
    on_stop: Callable[[int], None] | None = None,
) -> int:
    """Run a service, or several in one process, on the running event loop until SIGINT or SIGTERM; see `run_service`.

    `on_stop` is called with the exit code as soon as the process is asked to end.
    """
    stop = install_stop()
    services = service if isinstance(service, Sequence) else (service,)
    work = asyncio.create_task(_run_all([_Runner(each, bus_config, node_clock) for each in services]))
    asked = asyncio.create_task(stop.requested.wait())
    try:
        await asyncio.wait((work, asked), return_when=asyncio.FIRST_COMPLETED)
        if asked.done() and on_stop is not None:
            on_stop(stop.exit_code)
    finally:
        asked.cancel()
        work.cancel()
        # Also where the caller was cancelled: no service goes on that nobody awaits.
        await asyncio.wait((work,))
    if not work.cancelled() and (group := work.exception()) is not None:
        raise _first_cause(group) or group from group
    return stop.exit_code


async def _run_all(runners: Sequence[_Runner]) -> None:
    """Run services; those that reach the bus in one way share a session: between them messages take no router."""
    async with contextlib.AsyncExitStack() as open_buses:
        buses: dict[BusConfig, Bus] = {}
        async with asyncio.TaskGroup() as tasks:
            for runner in runners:
                config = runner.bus_config
                if config not in buses:
                    buses[config] = await open_buses.enter_async_context(await Bus.open(config))
                tasks.create_task(runner.run(buses[config]))


def _first_cause(first: BaseException | None) -> BaseException | None:
    while isinstance(first, BaseExceptionGroup):
        ours = [error for error in first.exceptions if isinstance(error, RhotError)]
        first = ours[0] if ours else first.exceptions[0]
    return first


def _as_service(config: BusConfig, service: Service) -> BusConfig:
    """Return how a service reaches the bus: on a secured one with its own certificate, else a camera's or services'."""
    if not config.tls:
        return config
    folder = Path(config.keys)
    name = f"camera-{service.instance}" if service.name == "capture" else service.name
    # Objects and feet may run on the PC, with what all services share, or elsewhere, with their own.
    identity = name if service.name == "capture" or key_file(folder, name).exists() else SERVICES
    return config.model_copy(update={"identity": identity})


class _Runner:
    def __init__(self, service: Service, bus_config: BusConfig, node_clock: NodeClock) -> None:
        self._service = service
        self.bus_config = _as_service(bus_config, service)
        self._node_clock = node_clock
        self._control_link = ControlLink()
        self._control = self._control_link.state
        self._status = StatusBoard()
        self._clock_ready = asyncio.Event()
        self._clock_watch = ClockWatch()

    async def run(self, bus: Bus) -> None:
        service = self._service
        clock = LocalRigClock(self._node_clock) if service.owns_clock else SyncedRigClock(self._node_clock)
        node = Node(service.name, service.instance, bus, self._node_clock, clock, self._status)
        self._status.include(bus.limit_counts)
        self._status.watch(lambda: ({}, self._clock_watch.problem))
        service.attach(node)
        own_clock = serve_clock(bus) if service.owns_clock else ""
        if own_clock:
            self._clock_ready.set()
        bus.queryable(CONTROL_KEY, self._control_link.answer)
        loop = asyncio.get_running_loop()
        bus.queryable(self._key("config"), lambda request: self._answer_config(loop, request), slow=True)
        bus.alive(self._key("alive"))
        self._status.state = "waiting"
        logger.info("%s %s is connected and waits for start", service.name, service.instance)
        notify("READY=1")
        # What exists by now lives as long as the process: the collector need not look through it again and again,
        # which costs some ten milliseconds each time.
        gc.collect()
        gc.freeze()
        try:
            async with asyncio.TaskGroup() as tasks:
                if isinstance(clock, SyncedRigClock):
                    tasks.create_task(keep_synced(bus, clock, self._clock_ready, self._clock_watch))
                else:
                    tasks.create_task(watch_for_rivals(bus, self._node_clock, own_clock, self._clock_watch))
                tasks.create_task(self._publish_status(node))
                self._control_link.follow(node, self._clock_ready, tasks)
                tasks.create_task(self._follow_config(node))
                tasks.create_task(self._check_loop())
                node.start_beside(tasks)
                tasks.create_task(self._run_sessions(node))
        finally:
            self._status.state = "stopping"
            notify("STOPPING=1")

    def _key(self, kind: str) -> str:
        return f"rhot/{kind}/{self._service.name}/{self._service.instance}"

    async def _run_sessions(self, node: Node) -> None:
        """Follow the start signal for ever: run while a session is on, wait while none is."""
        while True:
            start = self._control.running
            if start is None:
                self._status.state, self._status.session = "waiting", ""
                await self._control.wait_until_not(None)
                continue
            run = asyncio.create_task(self._run_session(node, start))
            change = asyncio.create_task(self._control.wait_until_not(start.session))
            try:
                await asyncio.wait((run, change), return_when=asyncio.FIRST_COMPLETED)
                if run.done():
                    run.result()
                    self._status.state = "waiting"
                    await change
            finally:
                run.cancel()
                change.cancel()
                # Waited for, not awaited: a signal that arrives meanwhile must still end this task.
                await asyncio.wait((run, change))
            if not run.cancelled() and isinstance(_first_cause(run.exception()), HungDeviceError):
                # The session is over, but the device is lost to this process.
                run.result()

    async def _run_session(self, node: Node, start: Control) -> None:
        """Run one session; a device that fails is tried again until the session ends."""
        await self._clock_ready.wait()
        start = with_start_in_reach(start, node.clock.now_ns())
        delay_s = (start.start_t_ns - node.clock.now_ns()) / 1e9
        if delay_s > 0:
            await asyncio.sleep(delay_s)
        self._status.clear_latencies()
        retry_s, logged = _RETRY_FIRST_S, ""
        logger.info("session %s runs", start.session)
        while True:
            self._status.state, self._status.session = "running", start.session
            try:
                await self._service.run(node, start)
            except (DeviceError, BusError) as error:
                self._status.error(str(error))
                self._status.count("device_errors")
                self._status.state = "waiting"
                if str(error) != logged:
                    logged = str(error)
                    logger.error("%s; trying again, at least every %.0f s", error, _RETRY_MAX_S)
                await asyncio.sleep(retry_s)
                retry_s = min(2 * retry_s, _RETRY_MAX_S)
            else:
                logger.info("session %s: the input has ended", start.session)
                return

    async def _publish_status(self, node: Node) -> None:
        publisher = node.bus.publisher(self._key("status"), ServiceStatus)
        while True:
            clock, board = node.clock, self._status
            offset, uncertainty = clock.offset_ns, clock.uncertainty_ns
            figures, problem = board.figures_and_problem()
            publisher.put(
                ServiceStatus(
                    t_ns=clock.now_ns() if clock.ready else 0,
                    service=node.service,
                    instance=node.instance,
                    state=board.state,  # type: ignore[arg-type]  # validated by the model
                    session=board.session,
                    uptime_s=board.uptime_s(),
                    rates=board.rates(),
                    counts=board.all_counts(),
                    latency_s=board.percentiles(),
                    figures=figures,
                    problem=problem,
                    last_error=board.last_error,
                    # Anew each time: services change settings by themselves, too, such as when files change.
                    config_digest=configuration.digest(self._service.config),
                    clock_offset_s=None if offset is None else offset / 1e9,
                    clock_uncertainty_s=None if uncertainty is None else uncertainty / 1e9,
                )
            )
            await asyncio.sleep(_STATUS_INTERVAL_S)

    async def _check_loop(self) -> None:
        """Keep systemd's watchdog quiet while the event loop turns, and note when it did not."""
        interval_s = watchdog_interval_s()
        loop = asyncio.get_running_loop()
        published_s = loop.time()
        while True:
            before = loop.time()
            await asyncio.sleep(_LOOP_CHECK_S)
            self._status.latency("loop_lag", max(0.0, loop.time() - before - _LOOP_CHECK_S))
            if interval_s is not None and loop.time() - published_s >= interval_s:
                notify("WATCHDOG=1")
                published_s = loop.time()

    def _answer_config(self, loop: asyncio.AbstractEventLoop, request: Request) -> Answer:
        """Answer a query for the configuration; one that carries a payload changes it first."""
        if request.payload:

            async def change() -> None:
                self._reconfigure(request.payload)

            # Services are changed on their own event loop only; this runs on a worker thread.
            # So long may a change of the configuration take; whoever asked waits 2 s.
            asyncio.run_coroutine_threadsafe(change(), loop).result(timeout=1.5)
        return configuration.config_answer(self._service.config, request)

    async def _follow_config(self, node: Node) -> None:
        key = self._key("config")
        async for sample in node.bus.events(key):
            if sample.deleted:
                continue
            try:
                self._reconfigure(sample.payload)
            except WireError as error:
                node.refuse(key, error)
            except ConfigError:
                continue  # counted, logged and shown in the status already

    def _reconfigure(self, payload: bytes) -> None:
        try:
            self._service.reconfigure(configuration.changed(self._service.config, configuration.parse_change(payload)))
        except ConfigError as error:
            self._status.count("config_refused")
            self._status.error(f"{self._key('config')}: {error}")
            logger.warning("%s: %s", self._key("config"), error)
            raise
        logger.info("configuration changed, now %s", configuration.digest(self._service.config))
