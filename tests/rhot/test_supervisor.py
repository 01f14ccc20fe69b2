"""`rhot up` keeps its services: one that ends by itself is restarted, one that cannot run ends the whole."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

import pytest

from rhot.errors import EXIT_AGAIN
from rhot.operation import supervisor as module
from rhot.operation.supervisor import Child, Supervisor

LIMIT_S = 30.0


class Programs(Supervisor):
    """Runs lines of Python in place of `rhot …`."""

    def command(self, module: str, arguments: Sequence[str]) -> list[str]:
        return [sys.executable, "-c", *arguments]


@pytest.fixture
async def programs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> AsyncIterator[Programs]:
    monkeypatch.setattr(module, "_AGAIN_FIRST_S", 0.01)
    programs = Programs(tmp_path)
    yield programs
    await programs.stop()


def counting(folder: Path, ends: str) -> list[str]:
    """Return a program that adds a line to a file at each start, ends by `ends` the first time, and then stays."""
    file = folder / "starts"
    return [
        "import os, signal, sys, time\n"
        f"with open({str(file)!r}, 'a') as f: f.write('x')\n"
        f"if os.path.getsize({str(file)!r}) == 1: {ends}\n"
        "time.sleep(600)"
    ]


async def until_started(folder: Path, times: int) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not (folder / "starts").exists() or (folder / "starts").stat().st_size < times:
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("ends", [f"sys.exit({EXIT_AGAIN})", "os.kill(os.getpid(), signal.SIGSEGV)"])
async def test_a_service_whose_driver_hung_or_crashed_is_restarted(
    programs: Programs, tmp_path: Path, ends: str, caplog: pytest.LogCaptureFixture
) -> None:
    other = await programs.start("other", ["import time; time.sleep(600)"])
    await programs.start("feet", counting(tmp_path, ends))
    keeping = asyncio.create_task(programs.keep_running())
    await until_started(tmp_path, 2)
    assert not keeping.done()
    assert other.process.returncode is None
    assert "feet ended by itself" in caplog.text
    keeping.cancel()


async def test_a_service_that_ran_and_then_failed_is_restarted(
    programs: Programs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PROVEN_S", 0.0)
    await programs.start("feet", counting(tmp_path, "raise KeyError(4711)"))
    keeping = asyncio.create_task(programs.keep_running())
    await until_started(tmp_path, 2)
    assert not keeping.done()
    keeping.cancel()


@pytest.mark.parametrize("program", ["raise SystemExit(2)", "raise KeyError(4711)"])
async def test_a_service_that_cannot_run_is_returned(programs: Programs, program: str) -> None:
    await programs.start("other", ["import time; time.sleep(600)"])
    await programs.start("feet", [program])
    failed = await asyncio.wait_for(programs.keep_running(), LIMIT_S)
    assert failed.name == "feet"
    assert f"exit code {failed.process.returncode}" in str(programs.failure(failed))


async def test_a_configuration_that_became_wrong_ends_it_however_long_it_ran(
    programs: Programs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PROVEN_S", 0.0)
    await programs.start("feet", ["raise SystemExit(2)"])
    assert (await asyncio.wait_for(programs.keep_running(), LIMIT_S)).name == "feet"


async def test_one_that_crashes_again_and_again_is_given_up(programs: Programs) -> None:
    await programs.start("feet", ["import os, signal; os.kill(os.getpid(), signal.SIGKILL)"])
    failed: Child = await asyncio.wait_for(programs.keep_running(), LIMIT_S)
    assert failed.process.returncode == -signal.SIGKILL


async def test_what_was_restarted_ends_with_the_rest(programs: Programs, tmp_path: Path) -> None:
    await programs.start("feet", counting(tmp_path, f"sys.exit({EXIT_AGAIN})"))
    keeping = asyncio.create_task(programs.keep_running())
    await until_started(tmp_path, 2)
    async with asyncio.timeout(LIMIT_S):
        # A program that has started may not be known yet; one that is not is ended when its start is cancelled.
        while not programs.children:
            await asyncio.sleep(0.01)
    keeping.cancel()
    await asyncio.gather(keeping, return_exceptions=True)
    await programs.stop()
    assert [child.process.returncode is not None for child in programs.children] == [True]
