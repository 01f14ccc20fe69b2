"""The objects service on a real bus, with a SteamVR that moves its space, fails or hangs."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from bus_watch import wait_for_status
from devices.fake_steamvr import FakeSteamVr, OpenVRError
from wall_clock import in_time

from rhot.bus import Bus
from rhot.clock import SystemClock
from rhot.errors import HungDeviceError
from rhot.messages import Control, ObjectPose, decode
from rhot.rig import BusConfig, RegistrationFile, Rig, RigidTransform, load_rig
from rhot.rig.folder import write_json_model
from rhot.service import runner
from rhot.service.clock_sync import serve_clock
from rhot.service.runner import serve
from rhot_objects import assemble
from rhot_objects import service as objects_service
from rhot_objects.service import ObjectsService
from rhot_objects.sources import steamvr as steamvr_source

LIMIT_S = 60.0


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, steamvr: FakeSteamVr) -> None:
    monkeypatch.setattr(runner, "_STATUS_INTERVAL_S", 0.05)
    monkeypatch.setattr(objects_service, "_RETRY_S", 0.05)
    monkeypatch.setattr(objects_service, "CLOSE_LIMIT_S", 0.3)
    real = steamvr_source.SteamVrSource
    monkeypatch.setattr(assemble, "SteamVrSource", lambda ids: real(ids, load=lambda: steamvr))


@pytest.fixture
def rig(rig_folder: Path) -> Rig:
    text = (rig_folder / "rig.toml").read_text()
    (rig_folder / "rig.toml").write_text(text + '\n[objects.cup]\nsource = "steamvr"\nserial = "LHR-CUP"\n')
    return load_rig(rig_folder)


@asynccontextmanager
async def running(rig: Rig, router: BusConfig) -> AsyncIterator[tuple[Bus, asyncio.Task[int]]]:
    async with await Bus.open(router) as bus:
        serve_clock(bus)
        task = asyncio.create_task(serve(ObjectsService(rig), router, SystemClock()))
        try:
            await say(bus, "start", "one")
            yield bus, task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def say(bus: Bus, action: str, session: str) -> None:
    control = bus.publisher("rhot/control", Control, reliable=True)
    assert await control.wait_for_reader(LIMIT_S)
    now_ns = time.time_ns()
    control.put(Control.model_validate({"t_ns": now_ns, "action": action, "session": session, "start_t_ns": now_ns}))


async def cup(bus: Bus) -> ObjectPose:
    async with asyncio.timeout(LIMIT_S):
        async for sample in bus.latest("rhot/object/cup"):
            return decode(sample.payload, ObjectPose)
    raise AssertionError("the bus was closed")


async def test_after_its_space_moved_nothing_is_published_until_it_is_registered_again(
    rig: Rig, router: BusConfig, steamvr: FakeSteamVr
) -> None:
    async with running(rig, router) as (bus, _):
        assert (await cup(bus)).position[0] == 0.0
        steamvr.reset_standing_position(0.4)
        said = await wait_for_status(bus, "objects/main", lambda status: bool(status.problem))
        assert "standing space has moved" in said.problem
        assert "rhot calibrate objects" in said.problem
        reads = said.counts["reads"]
        assert (await wait_for_status(bus, "objects/main", lambda status: status.t_ns > said.t_ns)).counts[
            "reads"
        ] == reads
        registration = RegistrationFile(
            T_rig_tracker=RigidTransform(position=(0.4, 0.0, 0.0), orientation=(0.0, 0.0, 0.0, 1.0))
        )
        write_json_model(rig.path / "registration.json", registration)
        await wait_for_status(bus, "objects/main", lambda status: not status.problem and status.counts["reads"] > reads)
        assert (await cup(bus)).position[0] == pytest.approx(0.0)


async def test_a_new_session_with_the_old_registration_says_that_its_poses_are_wrong(
    rig: Rig, router: BusConfig, steamvr: FakeSteamVr
) -> None:
    async with running(rig, router) as (bus, _):
        await cup(bus)
        steamvr.set_up_room()
        await wait_for_status(bus, "objects/main", lambda status: "universe has changed" in status.problem)
        await say(bus, "stop", "one")
        await wait_for_status(bus, "objects/main", lambda status: status.state == "waiting")
        await say(bus, "start", "two")
        # Registering live needs the poses.
        await cup(bus)
        assert (
            "poses are wrong"
            in (await wait_for_status(bus, "objects/main", lambda status: status.session == "two")).problem
        )


async def test_what_openvr_raises_costs_a_reading_and_not_the_service(
    rig: Rig, router: BusConfig, steamvr: FakeSteamVr, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(rig, router) as (bus, task):
        await cup(bus)
        with monkeypatch.context() as patch:

            def fail(*_: object) -> None:
                raise OpenVRError("VRInitError_IPC_Failed")

            patch.setattr(steamvr, "getDeviceToAbsoluteTrackingPose", fail)
            said = await wait_for_status(bus, "objects/main", lambda status: "IPC_Failed" in status.problem)
            assert said.counts["device_errors"] >= 1
        await wait_for_status(bus, "objects/main", lambda status: not status.problem)
        assert not task.done()


@pytest.fixture
def hung(steamvr: FakeSteamVr) -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


async def test_a_read_that_hangs_ends_the_service(
    rig: Rig, router: BusConfig, steamvr: FakeSteamVr, hung: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(objects_service, "_READ_LIMIT_S", 0.3)
    async with running(rig, router) as (bus, task):
        await cup(bus)
        steamvr.hang = hung
        with pytest.raises(HungDeviceError, match="steamvr: read"):
            await asyncio.wait_for(task, LIMIT_S)


@pytest.mark.real_time
async def test_a_read_that_hangs_at_the_stop_does_not_block_the_event_loop(
    rig: Rig, router: BusConfig, steamvr: FakeSteamVr, hung: threading.Event
) -> None:
    async with running(rig, router) as (bus, task):
        await cup(bus)
        steamvr.hang = hung
        assert await asyncio.to_thread(steamvr.hanging.wait, LIMIT_S)
        lags: list[float] = []

        async def tick() -> None:
            while True:
                before = time.monotonic()
                await asyncio.sleep(0.01)
                lags.append(time.monotonic() - before)

        ticking = asyncio.create_task(tick())
        await say(bus, "stop", "one")
        with pytest.raises(HungDeviceError, match="steamvr: close"):
            await asyncio.wait_for(task, LIMIT_S)
        ticking.cancel()
        in_time(max(lags), 0.25, "the event loop while a driver hangs")
