"""A simulated rig of real processes on this machine."""

from __future__ import annotations

from collections.abc import AsyncIterator, Generator
from pathlib import Path

import pytest
from rig_processes import Processes
from wall_clock import ForeignLoad, excuse

from rhot.bus import Bus
from rhot.rig import BusConfig
from rhot.rig.folder import RIG_FILE
from rhot_sim.rig.folder import write_simulated_rig
from rhot_sim.running.run import free_endpoint

LOAD = pytest.StashKey[ForeignLoad]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    """Watch who else uses the machine during tests whose limits are times on the clock."""
    if item.get_closest_marker("real_time") is None:
        return (yield)
    load = item.stash[LOAD] = ForeignLoad()
    load.start()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Do not judge a limit on the wall clock that was missed while others used the machine; say so instead."""
    report = yield
    if call.when == "call" and LOAD in item.stash:
        others = item.stash[LOAD].stop()
        if report.failed and call.excinfo is not None and (reason := excuse(call.excinfo.value, others)):
            report.outcome, report.longrepr = "skipped", (str(item.path), item.location[1] or 0, reason)
    return report


@pytest.fixture(scope="session")
def simulated_rig(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> tuple[Path, str]:
    """A simulated rig folder and its router's endpoint; with the parameter `still` its hand never moves."""
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    path = tmp_path_factory.mktemp("rig")
    write_simulated_rig(path, endpoint=endpoint)
    if getattr(request, "param", None) == "still":
        rig_file = path / RIG_FILE
        text = rig_file.read_text()
        assert text.count("[sim]\n") == 1
        rig_file.write_text(text.replace("[sim]\n", '[sim]\nmotion = "still"\n'))
    return path, endpoint


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
