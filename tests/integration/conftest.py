"""A simulated rig of real processes on this machine."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from running.rig_processes import Processes

from rhot.bus import Bus
from rhot.rig import BusConfig
from rhot.rig.folder import RIG_FILE
from rhot_sim.rig.folder import write_simulated_rig
from rhot_sim.running.processes import free_endpoint


@pytest.fixture(scope="session")
def simulated_rig(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> tuple[Path, str]:
    """A simulated rig folder and its router's endpoint.

    With the parameter `still` its hand never moves, and its cameras run at 15 Hz: two cores that draw both at 60 are
    busy with nothing else. With `slow` its cameras leave the machine to other tests.
    """
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    path = tmp_path_factory.mktemp("rig")
    kind = getattr(request, "param", None)
    write_simulated_rig(path, endpoint=endpoint, rate_hz=15.0 if kind in ("slow", "still") else 60.0)
    if kind == "still":
        rig_file = path / RIG_FILE
        text = rig_file.read_text()
        assert text.count("[sim]\n") == 1
        rig_file.write_text(text.replace("[sim]\n", '[sim]\nmotion = "still"\n'))
    return path, endpoint


@pytest.fixture(autouse=True)
def _shared_rig_unchanged(request: pytest.FixtureRequest) -> Iterator[None]:
    """Later tests get the same rig: who needs another takes a copy."""
    if "simulated_rig" not in request.fixturenames:
        yield
        return
    rig_file = request.getfixturevalue("simulated_rig")[0] / RIG_FILE
    before = rig_file.read_text()
    yield
    assert rig_file.read_text() == before, f"{request.node.name} changed the rig that tests share"


@pytest.fixture
async def processes(simulated_rig: tuple[Path, str], tmp_path: Path) -> AsyncIterator[Processes]:
    """No service runs yet; all are ended with the test."""
    made = Processes(simulated_rig[0], tmp_path)
    try:
        yield made
    finally:
        await made.supervisor.stop()


@pytest.fixture
async def rig_bus(simulated_rig: tuple[Path, str], processes: Processes) -> AsyncIterator[Bus]:
    """A session of the test's own; opens when the router is up."""
    await processes.start("router")
    async with await Bus.open(BusConfig(connect=(simulated_rig[1],)), timeout_s=15.0) as bus:
        yield bus
