"""A service whose driver hangs says so and ends, so that systemd or `rhot up` restarts it."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest
from pydantic import BaseModel
from wall_clock import in_time

from rhot.bus import Bus
from rhot.clock import SystemClock
from rhot.errors import EXIT_AGAIN, DeviceError, HungDeviceError
from rhot.messages import Control
from rhot.rig import BusConfig, FusionConfig
from rhot.service import Node
from rhot.service.device_thread import DeviceThread
from rhot.service.grabber import Grabber
from rhot.service.runner import serve

LIMIT_S = 20.0


@pytest.fixture
def released() -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


@dataclass
class Frame:
    index: int


class Hanging:
    """Reads a device that delivers nothing and cannot be closed, or fails first and then cannot be closed."""

    name, instance, owns_clock = "capture", "left", True
    config = FusionConfig()

    def __init__(self, released: threading.Event, *, fails: bool) -> None:
        self.released = released
        self.fails = fails
        self.running = asyncio.Event()

    def reconfigure(self, config: BaseModel) -> None: ...

    def attach(self, node: Node) -> None: ...

    def _frames(self) -> Iterator[Frame | None]:
        if self.fails:
            raise DeviceError("camera left: no frame for 5 s")
        self.released.wait()
        yield None

    def _close(self) -> None:
        self.released.wait()

    async def run(self, node: Node, start: Control) -> None:
        grabber = Grabber[Frame]("camera left", self._frames, self._close)
        grabber.start()
        self.running.set()
        try:
            await grabber.next_frame()
        finally:
            await grabber.stop(limit_s=0.2)


async def _start(bus: Bus) -> None:
    control = bus.publisher("rhot/control", Control, reliable=True)
    assert await control.wait_for_reader(LIMIT_S)
    control.put(Control(t_ns=time.time_ns(), action="start", session="one", start_t_ns=time.time_ns()))


async def test_a_silent_device_that_cannot_be_closed_ends_the_service(
    router: BusConfig, released: threading.Event
) -> None:
    service = Hanging(released, fails=True)
    task = asyncio.create_task(serve(service, router, SystemClock()))
    async with await Bus.open(router) as bus:
        await _start(bus)
        with pytest.raises(HungDeviceError, match="camera left: close"):
            await asyncio.wait_for(task, LIMIT_S)


async def test_a_device_that_hangs_when_the_session_stops_ends_the_service(
    router: BusConfig, released: threading.Event
) -> None:
    service = Hanging(released, fails=False)
    task = asyncio.create_task(serve(service, router, SystemClock()))
    async with await Bus.open(router) as bus:
        await _start(bus)
        await asyncio.wait_for(service.running.wait(), LIMIT_S)
        control = bus.publisher("rhot/control", Control, reliable=True)
        assert await control.wait_for_reader(LIMIT_S)
        control.put(Control(t_ns=time.time_ns(), action="stop", session="one"))
        with pytest.raises(HungDeviceError, match="camera left: close"):
            await asyncio.wait_for(task, LIMIT_S)


@pytest.mark.real_time
def test_the_process_ends_whatever_still_hangs_in_it() -> None:
    program = """
        import asyncio, threading
        from rhot.errors import HungDeviceError
        from rhot.service import stop

        stop._HUNG_END_S = 0.3

        async def work() -> int:
            # A thread that the interpreter waits for at its end, as a driver's own may be.
            threading.Thread(target=threading.Event().wait).start()
            raise HungDeviceError("camera left: close: its driver has not returned")

        stop.run_to_the_end(work())
    """
    begun = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    assert done.returncode == EXIT_AGAIN, done.stderr
    assert "its driver has not returned" in done.stderr
    in_time(time.monotonic() - begun, 10.0, "the end of a process whose driver hangs")


async def test_calls_run_in_order_and_their_errors_are_device_errors() -> None:
    device, order = DeviceThread("tracker"), list[str]()

    def note(what: str, result: int) -> Callable[[], int]:
        def call() -> int:
            order.append(what)
            return result

        return call

    calls = (device.call(what, note(what, result), LIMIT_S) for what, result in (("read", 7), ("close", 8)))
    assert await asyncio.gather(*calls) == [7, 8]
    assert order == ["read", "close"]

    def fail() -> None:
        raise KeyError(4711)

    with pytest.raises(DeviceError, match="tracker: read: KeyError: 4711"):
        await device.call("read", fail, LIMIT_S)
    device.end()


async def test_what_follows_a_call_that_hangs_hangs_too_and_the_loop_goes_on(released: threading.Event) -> None:
    device = DeviceThread("tracker")
    for what, limit_s in (("read", 0.1), ("close", LIMIT_S)):
        with pytest.raises(HungDeviceError, match="tracker: read"):
            await device.call(what, released.wait, limit_s)
    released.set()
    device.end()
