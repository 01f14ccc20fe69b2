"""The capture service on a real bus with a camera that falls silent, refuses, or waits for its server."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from bus_watch import wait_for_status
from devices.fake_picamera2 import FakePicamera2

from rhot.bus import Bus
from rhot.clock import SystemClock
from rhot.errors import ConfigError, HungDeviceError
from rhot.messages import Control
from rhot.rig import BusConfig, CameraConfig, Rig, load_rig
from rhot.service import grabber, runner
from rhot.service.clock_sync import serve_clock
from rhot.service.runner import serve
from rhot_capture import service as capture_service
from rhot_capture.service import CaptureService
from rhot_capture.sources import picamera2 as module
from rhot_capture.sources.picamera2 import Picamera2Source

LIMIT_S = 60.0


class Camera:
    """A camera that delivers fifty pictures a second, unless it is silent; each opening finds it again."""

    def __init__(self) -> None:
        self.silent = False
        self.stop_hangs = False
        self.metadata: dict[str, Any] = {}
        self.fails: dict[str, Exception] = {}
        self.opened: list[FakePicamera2] = []
        self._ended = threading.Event()
        threading.Thread(target=self._expose, daemon=True).start()

    def source(self, name: str, rig: Rig, clock: object) -> Picamera2Source:
        fake = FakePicamera2()
        fake.fails, fake.stop_hangs = self.fails, self.stop_hangs
        self.opened.append(fake)
        return Picamera2Source(name, rig.config.cameras[name], fake.modules, lambda: 0)

    def end(self) -> None:
        self._ended.set()
        for fake in self.opened:
            fake.end()

    def _expose(self) -> None:
        while not self._ended.wait(0.02):
            if self.opened and not self.silent:
                self.opened[-1].complete(SystemClock().now_ns(), **self.metadata)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "_STATUS_INTERVAL_S", 0.05)
    monkeypatch.setattr(runner, "_RETRY_FIRST_S", 0.02)
    monkeypatch.setattr(module, "_WAIT_S", 0.05)
    monkeypatch.setattr(module, "_SILENCE_S", 0.3)


@asynccontextmanager
async def running(
    rig_folder: Path,
    router: BusConfig,
    monkeypatch: pytest.MonkeyPatch,
    prepare: Callable[[CaptureService], None] = lambda _: None,
    **camera_fields: Any,
) -> AsyncIterator[tuple[Camera, Bus, asyncio.Task[int]]]:
    rig = load_rig(rig_folder)
    left = CameraConfig.model_validate({**rig.config.cameras["left"].model_dump(), **camera_fields})
    cameras = {**rig.config.cameras, "left": left}
    rig = dataclasses.replace(rig, config=rig.config.model_copy(update={"cameras": cameras}))
    camera = Camera()
    monkeypatch.setattr(capture_service, "open_source", camera.source)
    monkeypatch.setattr(capture_service, "latest_rig", lambda rig: rig)
    service = CaptureService("left", rig, SystemClock())
    prepare(service)
    async with await Bus.open(router) as bus:
        serve_clock(bus)
        task = asyncio.create_task(serve(service, router, SystemClock()))
        try:
            control = bus.publisher("rhot/control", Control, reliable=True)
            assert await control.wait_for_reader(LIMIT_S)
            now_ns = time.time_ns()
            control.put(Control(t_ns=now_ns, action="start", session="s", start_t_ns=now_ns))
            yield camera, bus, task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            camera.end()


async def test_a_camera_that_falls_silent_comes_back(
    rig_folder: Path, router: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(rig_folder, router, monkeypatch) as (camera, bus, task):
        await wait_for_status(bus, "capture/left", lambda status: status.counts.get("frames", 0) > 3)
        camera.silent = True
        said = await wait_for_status(bus, "capture/left", lambda status: "no frame for" in status.last_error)
        assert "camera left" in said.last_error
        assert "ribbon cable" in said.last_error
        await wait_for_status(bus, "capture/left", lambda status: status.counts.get("device_errors", 0) > 0)
        camera.silent = False
        frames = said.counts["frames"]
        await wait_for_status(
            bus, "capture/left", lambda status: status.state == "running" and status.counts["frames"] > frames + 3
        )
        assert len(camera.opened) >= 2
        assert camera.opened[0].calls == ["start", "flush", "stop", "close"]
        assert not task.done()


async def test_a_silent_camera_whose_driver_hangs_ends_the_service(
    rig_folder: Path, router: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(grabber.Grabber.stop, "__defaults__", (0.3,))
    async with running(rig_folder, router, monkeypatch) as (camera, bus, task):
        await wait_for_status(bus, "capture/left", lambda status: status.counts.get("frames", 0) > 3)
        camera.opened[0].stop_hangs = True
        camera.silent = True
        with pytest.raises(HungDeviceError, match="camera left: close"):
            await asyncio.wait_for(task, LIMIT_S)


async def test_what_the_driver_raises_at_a_setting_refuses_the_setting(
    rig_folder: Path, router: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(rig_folder, router, monkeypatch) as (camera, bus, task):
        await wait_for_status(bus, "capture/left", lambda status: status.counts.get("frames", 0) > 3)
        camera.fails["set_controls"] = RuntimeError("Control ColourGains is not advertised by libcamera")
        replies = await bus.get("rhot/config/capture/left", b'{"gain": 2.0}')
        assert "not advertised" in replies[0].error
        said = await wait_for_status(bus, "capture/left", lambda status: status.counts.get("config_refused", 0) > 0)
        frames = said.counts["frames"]
        await wait_for_status(bus, "capture/left", lambda status: status.counts["frames"] > frames + 3)
        assert not task.done()


async def test_a_client_without_a_server_shows_in_the_status(
    rig_folder: Path, router: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_SYNC_WAIT_S", 0.2)
    async with running(rig_folder, router, monkeypatch, sync="client") as (camera, bus, _):
        camera.metadata = {"SyncReady": False}
        assert (
            "unsynchronised"
            in (await wait_for_status(bus, "capture/left", lambda status: bool(status.problem))).problem
        )
        await wait_for_status(bus, "capture/left", lambda status: status.counts.get("frames", 0) > 3)
        camera.metadata = {"SyncReady": True}
        await wait_for_status(bus, "capture/left", lambda status: not status.problem)


def test_colours_that_fail_unexpectedly_are_logged(
    rig_folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("no pixels")

    service = CaptureService("left", load_rig(rig_folder), SystemClock())
    monkeypatch.setattr(service._colors, "has_changed", lambda: True)
    monkeypatch.setattr(service._colors, "reload", fail)
    node: Any = None
    service._look_for_colors(node)
    service._building.submit(lambda: None).result(LIMIT_S)
    assert "new colours failed, the old ones stay: no pixels" in caplog.text


async def test_a_setting_taken_before_the_start_that_the_camera_refuses_ends_no_service(
    rig_folder: Path, router: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise ConfigError("camera left: gain means nothing to this driver")

    def change(service: CaptureService) -> None:
        service.reconfigure(service.config.model_copy(update={"gain": 2.0}))

    monkeypatch.setattr(Picamera2Source, "apply", refuse)
    async with running(rig_folder, router, monkeypatch, prepare=change) as (_, bus, task):
        said = await wait_for_status(bus, "capture/left", lambda status: status.counts.get("frames", 0) > 3)
        assert "gain means nothing" in said.last_error
        replies = await bus.get("rhot/config/capture/left?format=json")
        assert json.loads(replies[0].payload)["gain"] == 4.0
        assert not task.done()
