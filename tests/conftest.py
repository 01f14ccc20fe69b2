"""Fixtures that every part may use: a router of one's own, a rig folder, the real data."""

from __future__ import annotations

import os
import tempfile
from collections.abc import AsyncIterator, Callable, Generator, Iterator
from functools import partial
from pathlib import Path

import pytest

# As the program itself does, before numpy is loaded: BLAS threads that wait for each other cost more than they bring.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import marker_streams
from running.free_ports import free_ports
from running.simulated_colors import copy_or_learn
from wall_clock import MachineWatch, excuse

from rhot.bus import Bus
from rhot.rig import BusConfig, Rig
from rhot.rig.template import rig_template
from rhot_sim.rig import folder as simulated_rig_folder

# Time on the clock is judged by tests marked `real_time` alone: an example of 0.2 s is a machine that stood still.
hypothesis.settings.register_profile("rhot", deadline=None)
hypothesis.settings.load_profile("rhot")

REPOSITORY = Path(__file__).resolve().parents[1]
WATCH = pytest.StashKey[MachineWatch]()
REAL_TIME = (REPOSITORY / "tests" / "integration", REPOSITORY / "tests" / "faults")
"""Where `make test` looks for tests that want the machine to themselves."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse a test of the real-time phase that stands where that phase would not find it.

    Raises:
        pytest.UsageError: there is one.
    """
    for item in items:
        alone = item.get_closest_marker("integration") and item.get_closest_marker("real_time")
        if alone and not any(item.path.is_relative_to(folder) for folder in REAL_TIME):
            where = " or ".join(str(folder.relative_to(REPOSITORY)) for folder in REAL_TIME)
            raise pytest.UsageError(f"{item.nodeid}: tests that are integration and real_time belong into {where}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    """Watch the machine during tests whose limits are times on the clock: who else uses it, and how fast it is."""
    if item.get_closest_marker("real_time") is None:
        return (yield)
    watch = item.stash[WATCH] = MachineWatch()
    watch.start()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Do not judge a limit on the wall clock by a machine that is busy or too slow for it; say so instead."""
    report = yield
    if call.when == "call" and WATCH in item.stash:
        others, slowness = item.stash[WATCH].stop()
        if report.failed and call.excinfo is not None and (reason := excuse(call.excinfo.value, others, slowness)):
            report.outcome, report.longrepr = "skipped", (str(item.path), item.location[1] or 0, reason)
    return report


@pytest.fixture(scope="session", autouse=True)
def _colors_learnt_once(pytestconfig: pytest.Config) -> Iterator[None]:
    """Simulated rigs that are alike share the colours that the first of them has learnt, in whichever test run."""
    assert pytestconfig.cache is not None
    kept = pytestconfig.cache.mkdir("colors")
    with pytest.MonkeyPatch.context() as patch:
        learn = partial(copy_or_learn, simulated_rig_folder.calibrate_colors, kept)
        patch.setattr(simulated_rig_folder, "calibrate_colors", learn)
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data; tests that need it are skipped where it is absent."""
    path = REPOSITORY.parent / "shared" / "data"
    if not path.is_dir():
        pytest.skip(f"no real data at {path}")
    return path


@pytest.fixture(scope="session")
def thesis_rig(shared_data: Path) -> Path:
    """The real rig of 2018."""
    return shared_data / "thesis_rig"


@pytest.fixture
def make_rig(tmp_path: Path) -> Callable[..., Rig]:
    """A maker of rigs in a folder of this test's own."""
    return partial(marker_streams.make_rig, tmp_path)


@pytest.fixture(scope="session")
def _free_ports() -> Iterator[int]:
    return free_ports()


@pytest.fixture
def free_port(_free_ports: Iterator[int]) -> int:
    """A port of the loopback interface that nobody uses, and that no outgoing connection can take."""
    return next(_free_ports)


@pytest.fixture
def rig_folder(tmp_path: Path) -> Path:
    """A rig folder as `rhot init` makes it."""
    folder = tmp_path / "rig"
    folder.mkdir()
    (folder / "rig.toml").write_text(rig_template(folder="rig", name="test"))
    return folder


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A Unix socket for a router; short, because the kernel allows about 100 characters."""
    with tempfile.TemporaryDirectory(prefix="rhot-") as folder:
        yield f"unixsock-stream/{folder}/z.sock"


@pytest.fixture
async def router(endpoint: str) -> AsyncIterator[BusConfig]:
    """A running router; yields how a client reaches it."""
    async with await Bus.open(BusConfig(mode="router", connect=(), listen=(endpoint,))):
        yield BusConfig(connect=(endpoint,))
