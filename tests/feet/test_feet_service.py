"""The feet service on a real bus with devices that can be pulled out."""

from __future__ import annotations

import asyncio
import termios
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from bus_watch import wait_for_status
from still_feet import FEET, head, picture, standing_samples

from rhot.bus import Bus
from rhot.clock import SystemClock
from rhot.errors import ConfigError, DeviceError
from rhot.messages import Control, FootPose, HeadPose, Side, decode
from rhot.rig import BusConfig, Rig, load_rig
from rhot.service import runner
from rhot.service.runner import serve
from rhot_feet import service as feet_service
from rhot_feet.frames import DepthFrame
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.service import FeetService
from rhot_sim.walker.folder import write_walker_rig

LIMIT_S = 60.0


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the status nor a device that is absent is waited for longer than needed."""
    monkeypatch.setattr(runner, "_STATUS_INTERVAL_S", 0.05)
    monkeypatch.setattr(feet_service, "_RETRY_S", 0.05)
    monkeypatch.setattr(feet_service, "_HEADLESS_S", 0.2)


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return write_walker_rig(tmp_path / "rig", endpoint="tcp/127.0.0.1:1")


class Camera:
    """Shows the standing person twenty times a second, unless it is pulled out."""

    finished = False

    def __init__(self) -> None:
        self.plugged = True
        self.index = 0

    def open(self, start_ns: int) -> None:
        if not self.plugged:
            raise DeviceError("no camera on any port")

    def read(self, timeout_s: float) -> DepthFrame | None:
        if not self.plugged:
            raise DeviceError("the camera went away")
        time.sleep(0.05)
        self.index += 1
        return picture(self.index, time.time_ns() - 30_000_000)

    def close(self) -> None:
        return


class Sensor:
    """Stands still, unless it is pulled out."""

    def __init__(self) -> None:
        self.plugged = True
        self.last_ns = 0

    def open(self, start_ns: int) -> None:
        if not self.plugged:
            raise DeviceError("no sensor on any port")

    def read(self, now_ns: int) -> ImuSamples:
        if not self.plugged:
            raise DeviceError("the sensor went away")
        # Also where the clock was set back.
        self.last_ns = min(max(self.last_ns, now_ns - 50_000_000), now_ns)
        count = (now_ns - self.last_ns) // 10_000_000
        samples = standing_samples(self.last_ns + 10_000_000, int(count))
        self.last_ns += 10_000_000 * int(count)
        return samples

    def close(self) -> None:
        return


class Head:
    """Where the headset's poses come from: held still, told so late, or not at all."""

    def __init__(self, late_s: float = 0.0) -> None:
        self.late_s = late_s
        self.tracked = True

    async def hold(self, bus: Bus) -> None:
        publisher = bus.publisher("rhot/head", HeadPose)
        told_ns = time.time_ns()
        while True:
            now_ns = time.time_ns() - round(1e9 * self.late_s)
            # However seldom this task gets its turn, no pose is left out.
            told_ns = min(max(told_ns, now_ns - 500_000_000), now_ns)
            while told_ns < now_ns:
                told_ns += 15_000_000
                if self.tracked:
                    publisher.put(head(told_ns))
            await asyncio.sleep(0.015)


@asynccontextmanager
async def running(
    rig: Rig, router: BusConfig, camera: Camera, sensor: Sensor, headset: Head | None = None
) -> AsyncIterator[Bus]:
    """Run the service and hold the head; yields a session of the test's own."""
    service = FeetService(rig, open_camera=lambda _rig, _now: camera, sensors=lambda _rig, _feet: {"left": sensor})
    tasks: list[asyncio.Task[int] | asyncio.Task[None]] = [asyncio.create_task(serve(service, router, SystemClock()))]
    try:
        async with await Bus.open(router) as bus:
            tasks.append(asyncio.create_task((headset or Head()).hold(bus)))
            control = bus.publisher("rhot/control", Control, reliable=True)
            assert await control.wait_for_reader(LIMIT_S)
            now_ns = time.time_ns()
            control.put(Control(t_ns=now_ns, action="start", session="s", start_t_ns=now_ns))
            yield bus
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def foot(bus: Bus, wanted: Callable[[FootPose], bool]) -> FootPose:
    mailbox = bus.events("rhot/foot/*")
    async with asyncio.timeout(LIMIT_S):
        async for sample in mailbox:
            pose = decode(sample.payload, FootPose)
            if wanted(pose):
                return pose
    raise AssertionError("no such foot")


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
async def test_feet_are_back_after_the_rig_clock_was_set(
    rig: Rig, router: BusConfig, monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    async with running(rig, router, Camera(), Sensor()) as bus:
        await foot(bus, lambda pose: pose.state == "measured")
        true_ns = time.time_ns
        monkeypatch.setattr(time, "time_ns", lambda: true_ns() + round(1e9 * step_s))
        set_ns = time.time_ns()
        await foot(bus, lambda pose: pose.state == "measured" and 0 <= pose.t_ns - set_ns < 60_000_000_000)


async def gone(bus: Bus, side: Side, besides: Side) -> None:
    """Wait until one foot is published no longer, though the other one is, for half a second of their time."""
    seen_ns = 0

    def alone(pose: FootPose) -> bool:
        nonlocal seen_ns
        seen_ns = max(seen_ns, pose.t_ns) if pose.side == side or not seen_ns else seen_ns
        return pose.side == besides and pose.t_ns > seen_ns + 500_000_000

    await foot(bus, alone)


async def test_a_camera_that_is_pulled_out_comes_back(rig: Rig, router: BusConfig) -> None:
    camera, sensor = Camera(), Sensor()
    async with running(rig, router, camera, sensor) as bus:
        await foot(bus, lambda pose: pose.side == "left" and pose.stage == "marker")
        camera.plugged = False
        pose = await foot(bus, lambda pose: pose.side == "left" and pose.stage == "inertial")
        assert pose.state == "measured", "its sensor feels that it stands"
        await gone(bus, "right", besides="left")
        said = await wait_for_status(bus, "feet/main", lambda status: "camera" in status.problem)
        assert said.counts["device_errors"] >= 1
        camera.plugged = True
        await foot(bus, lambda pose: pose.side == "right" and pose.stage == "marker")
        await wait_for_status(bus, "feet/main", lambda status: not status.problem)


async def test_a_sensor_that_is_pulled_out_comes_back(rig: Rig, router: BusConfig) -> None:
    camera, sensor = Camera(), Sensor()
    async with running(rig, router, camera, sensor) as bus:
        await foot(bus, lambda pose: pose.side == "left" and pose.stationary)
        sensor.plugged = False
        await foot(bus, lambda pose: pose.side == "left" and not pose.stationary and pose.stage == "marker")
        assert "sensor" in (await wait_for_status(bus, "feet/main", lambda status: bool(status.problem))).problem
        sensor.plugged = True
        await foot(bus, lambda pose: pose.side == "left" and pose.stationary)
        await wait_for_status(bus, "feet/main", lambda status: not status.problem)


async def test_what_a_driver_raises_costs_its_device_and_not_the_service(rig: Rig, router: BusConfig) -> None:
    class Odd(Sensor):
        def open(self, start_ns: int) -> None:
            if not self.plugged:
                raise termios.error(5, "Input/output error")

        def read(self, now_ns: int) -> ImuSamples:
            if not self.plugged:
                raise KeyError(4711)
            return super().read(now_ns)

    class OddCamera(Camera):
        def open(self, start_ns: int) -> None:
            if not self.plugged:
                raise RuntimeError("failed to set power state")

        def read(self, timeout_s: float) -> DepthFrame | None:
            if not self.plugged:
                raise IndexError("no such stream")
            return super().read(timeout_s)

    camera, sensor = OddCamera(), Odd()
    async with running(rig, router, camera, sensor) as bus:
        await foot(bus, lambda pose: pose.side == "left" and pose.stationary)
        camera.plugged = sensor.plugged = False
        said = await wait_for_status(
            bus, "feet/main", lambda status: "Input/output error" in status.problem and "power state" in status.problem
        )
        assert "left sensor: open" in said.problem
        assert "depth camera: open" in said.problem
        camera.plugged = sensor.plugged = True
        await foot(bus, lambda pose: pose.side == "left" and pose.stationary)
        await wait_for_status(bus, "feet/main", lambda status: not status.problem)


async def test_a_picture_waits_for_a_head_that_is_told_late(
    rig: Rig, router: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long that takes on a busy machine: what counts is that a marker was used in the end."""
    monkeypatch.setattr(feet_service, "_HEAD_LATE_S", LIMIT_S)
    async with running(rig, router, Camera(), Sensor(), Head(late_s=0.1)) as bus:
        await wait_for_status(bus, "feet/main", lambda status: status.counts.get("right_marker", 0) > 0)


async def test_a_head_that_is_not_tracked_is_told_and_comes_back(rig: Rig, router: BusConfig) -> None:
    headset = Head()
    headset.tracked = False
    async with running(rig, router, Camera(), Sensor(), headset) as bus:
        assert "rhot/head" in (await wait_for_status(bus, "feet/main", lambda status: bool(status.problem))).problem
        headset.tracked = True
        await foot(bus, lambda pose: pose.side == "right" and pose.stage == "marker")
        await wait_for_status(bus, "feet/main", lambda status: not status.problem)


def test_a_rig_without_feet_is_refused(rig_folder: Path) -> None:
    with pytest.raises(ConfigError, match="names no feet"):
        FeetService(load_rig(rig_folder))


def test_without_cameras_its_clock_is_the_rigs(rig: Rig) -> None:
    assert rig.config.feet is not None
    assert FEET.feet.keys() == rig.config.feet.feet.keys()
    assert FeetService(rig).owns_clock
