"""Settings of capture services as the page reads and changes them."""

from __future__ import annotations

import asyncio

import pytest
from bus_watch import settled, until

from rhot.bus import Answer, Bus
from rhot.rig import BusConfig
from rhot_viewer.rig.capture_settings import CameraState, CaptureSettings


@pytest.mark.parametrize("answer", [b"[" * 100_000, b"[1, 2]", b"\xff\xfe"])
async def test_an_answer_that_is_no_map_of_settings_is_told_and_ends_nothing(router: BusConfig, answer: bytes) -> None:
    settings = CaptureSettings(("left",))
    async with await Bus.open(router) as bus, await Bus.open(router) as stranger:
        stranger.queryable("rhot/config/capture/left", lambda _: Answer(answer, "application/json"))
        await settled(stranger)
        running = asyncio.create_task(settings.run(bus))
        settings.ask("left", {})
        await until(lambda: settings.cameras["left"].version)
        assert settings.cameras["left"].refusal == "the answer is not a map of settings"
        assert not running.done()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_a_camera_that_was_silent_is_read_when_it_answers(router: BusConfig) -> None:
    settings = CaptureSettings(("left",))
    async with await Bus.open(router) as bus, await Bus.open(router) as camera:
        running = asyncio.create_task(settings.run(bus))
        settings.ask("left", {})
        await until(lambda: settings.cameras["left"].version)
        assert settings.cameras["left"].unread
        assert "no answer" in settings.cameras["left"].refusal

        camera.queryable("rhot/config/capture/left", lambda _: Answer(b'{"gain": 2.0}', "application/json"))
        await settled(camera)
        settings.ask("left", {})
        await until(lambda: settings.cameras["left"].version > 1)
        assert settings.cameras["left"] == CameraState({"gain": 2.0}, version=2)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
