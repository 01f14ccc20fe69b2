"""`rhot start --auto`: a rig that nobody has started or stopped starts by itself, where its rig.toml asks for that."""

from __future__ import annotations

import asyncio
import shutil
import sys
from pathlib import Path

import pytest
from bus_watch import PATIENCE_S
from running.rig_processes import Processes

from rhot.bus import Bus
from rhot.operation.control import broadcast, newest_control

pytestmark = [pytest.mark.integration]


async def start_by_itself(rig: Path) -> str:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rhot", "-q", "start", "--auto", "--rig", str(rig)),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    async with asyncio.timeout(PATIENCE_S):
        said, _ = await process.communicate()
    assert process.returncode == 0, said.decode()
    return said.decode()


async def test_a_session_starts_by_itself_and_a_stopped_rig_stays_stopped(
    rig_bus: Bus, processes: Processes, tmp_path: Path
) -> None:
    rig = tmp_path / "rig"
    shutil.copytree(processes.rig, rig)
    assert "nothing is started" in await start_by_itself(rig)
    text = (rig / "rig.toml").read_text()
    assert text.count("autostart = false") == 1
    (rig / "rig.toml").write_text(text.replace("autostart = false", "autostart = true"))

    await processes.start("fusion")
    assert "sent" in await start_by_itself(rig)
    started = await newest_control(rig_bus)
    assert started is not None
    assert started.action == "start"
    assert f"left as it is: start {started.session}" in await start_by_itself(rig)
    await broadcast(rig_bus, "stop", "", 0.0, 5.0)
    assert "left as it is: stop" in await start_by_itself(rig)
    stopped = await newest_control(rig_bus)
    assert stopped is not None
    assert stopped.action == "stop"
