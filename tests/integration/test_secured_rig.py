"""The whole rig over TLS: every service with a certificate, and only an operator starts and stops it."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from bus_watch import PATIENCE_S, answers
from running.rig_processes import Processes, hand_measured_after, start_rig

from rhot.bus import Bus
from rhot.keys import Holder
from rhot.operation.control import newest_control
from rhot.rig.folder import RIG_FILE, load_config
from rhot.rig.toml_edit import change_rig_file
from rhot_sim.rig.folder import write_simulated_rig
from rhot_tools.keys.making import add_holder, make_keys

pytestmark = [pytest.mark.integration]

SERVICES = ("router", "capture left", "capture right", "fusion", "ik")


def secured_rig(folder: Path, port: int) -> None:
    """Write a simulated rig with keys."""
    # Slow cameras leave the machine to other tests.
    write_simulated_rig(folder, rate_hz=15.0)
    make_keys(folder, ["127.0.0.1"], port)
    add_holder(folder, "tablet", Holder(role="tool"))
    change_rig_file(folder, {("bus",): {"listen": [f"tls/127.0.0.1:{port}"]}})
    assert "tcp/" not in "".join(load_config(folder).bus.connect), (folder / RIG_FILE).read_text()


@pytest.fixture
async def secured(tmp_path: Path, free_port: int) -> AsyncIterator[Processes]:
    """A simulated rig with keys, whose services run."""
    secured_rig(tmp_path / "rig", free_port)
    processes = Processes(tmp_path / "rig", tmp_path)
    try:
        for name in SERVICES:
            await processes.start(name)
        yield processes
    finally:
        await processes.supervisor.stop()


async def said_by(rig: Path, identity: str, *words: str) -> tuple[int, str]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rhot", *words, "--rig", str(rig)),
        env={**os.environ, "RHOT_IDENTITY": identity},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    async with asyncio.timeout(PATIENCE_S):
        said, _ = await process.communicate()
    assert process.returncode is not None
    return process.returncode, " ".join(said.decode().split())


async def test_only_an_operator_starts_and_stops_it(secured: Processes) -> None:
    bus_config = load_config(secured.rig).bus.model_copy(update={"listen": ()})
    async with await Bus.open(bus_config, timeout_s=PATIENCE_S) as bus:
        started = await start_rig(bus, PATIENCE_S)
        try:
            await hand_measured_after(bus, started.start_t_ns)
        except TimeoutError:
            pytest.fail(secured.logs())
        strangers = ("camera-left", "tablet")
        refused = await asyncio.gather(*(said_by(secured.rig, identity, "stop") for identity in strangers))
        for identity, (code, said) in zip(strangers, refused, strict=True):
            assert code != 0, (identity, said)
            assert "Traceback" not in said
            assert "only an operator may start and stop" in said, said
        code, said = await said_by(secured.rig, "tablet", "config", "fusion/main")
        assert (code, '"hold_s"' in said) == (0, True), said
        code, said = await said_by(secured.rig, "tablet", "config", "fusion/main", "hold_s=0.3")
        assert (code != 0, "only an operator may change configurations" in said) == (True, True), said
        known = await newest_control(bus)
        assert known is not None
        assert known.action == "start", f"one of {strangers} stopped the rig"
        code, said = await said_by(secured.rig, "operator", "stop")
        assert (code, "sent to 4 services" in said) == (0, True), said


async def test_the_router_lets_holders_into_the_namespace_of_the_environment(
    tmp_path: Path, free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RHOT_NAMESPACE", "desk1")
    rig = tmp_path / "rig"
    secured_rig(rig, free_port)
    processes = Processes(rig, tmp_path)
    try:
        for name in ("router", "fusion"):
            await processes.start(name)
        bus_config = load_config(rig).bus.model_copy(update={"listen": (), "namespace": "desk1"})
        async with await Bus.open(bus_config, timeout_s=PATIENCE_S) as bus:
            await answers(bus, "rhot/status/fusion/main")
    finally:
        await processes.supervisor.stop()
