"""Recording from the page."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from rhot.bus import Bus
from rhot.errors import ConfigError
from rhot.messages import PointSet
from rhot.recording.mcap.reader import open_mcap
from rhot.rig import BusConfig
from rhot_viewer.rig.live_recording import LiveRecording, explain

SENT = 40


async def test_every_message_of_a_session_is_in_the_file(router: BusConfig, rig_folder: Path, tmp_path: Path) -> None:
    recording = LiveRecording(router, rig_folder)
    running = asyncio.create_task(recording.run())
    async with await Bus.open(router) as bus:
        points = bus.publisher("rhot/points", PointSet)
        recording.start(tmp_path / "recordings")
        recording.start(tmp_path / "recordings")
        assert await points.wait_for_reader(60.0)
        for number in range(SENT):
            points.put(PointSet(t_ns=number, frame="rig", points={}))
        async with asyncio.timeout(60.0):
            while recording.tally.messages < SENT:
                await asyncio.sleep(0.02)
        recording.stop()
        async with asyncio.timeout(60.0):
            while recording.running:
                await asyncio.sleep(0.02)
    running.cancel()
    assert (recording.problem, recording.tally.lost) == ("", 0)
    assert recording.rate_hz > 0.0
    assert recording.file is not None
    assert recording.megabytes == pytest.approx(recording.file.stat().st_size / 1e6)
    assert len(list(open_mcap(recording.file).samples())) == SENT
    with pytest.raises(ConfigError, match="marker"):
        await explain(recording.file, "1", rig_folder)


async def test_what_hinders_is_said(tmp_path: Path, rig_folder: Path, router: BusConfig) -> None:
    recording = LiveRecording(router, rig_folder)
    running = asyncio.create_task(recording.run())
    blocked = tmp_path / "file"
    blocked.write_text("")
    recording.start(blocked / "recordings")
    async with asyncio.timeout(60.0):
        while not recording.problem:
            await asyncio.sleep(0.02)
    running.cancel()
    assert "cannot be made" in recording.problem
    assert not recording.running
