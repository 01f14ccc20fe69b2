"""`rhot sim` as a user runs it: its figures, its report, Ctrl-C."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import pty
import re
import select
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from bus_watch import PATIENCE_S
from moved_clock import make_clock, move_clock
from running.rig_processes import hand_measured_after, processes_that_name
from wall_clock import figures_in_time, in_time

from rhot.bus import Bus
from rhot.cli import main
from rhot.rig import BusConfig, load_rig
from rhot.rig.toml_edit import change_rig_file
from rhot_sim.running import processes
from rhot_sim.running.processes import free_endpoint

pytestmark = pytest.mark.integration


def run_sim(folder: Path, *more: str) -> tuple[dict[str, Any], str]:
    """Run the simulation for 10 s as a user would; return its report and what it printed."""
    report_path = folder / "r.json"
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    command = [sys.executable, "-m", "rhot", "sim", "--duration", "10", "--headless"]
    done = subprocess.run(
        [*command, "--report", str(report_path), "--listen", endpoint, *more],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr + done.stdout
    assert list(processes_that_name(endpoint)) == []
    return json.loads(report_path.read_text()), done.stdout


def too_slow(report: dict[str, Any]) -> dict[str, float]:
    """Name the figures that depend on the machine being free and are beyond their limits, and how many times.

    Pictures that the simulator's own drawing delivers late, beyond their usual age, are not held against the tracker.
    """
    assert "latency_ms" in report, "no hand at all"
    picture = report["latency_ms"]["parts"]["age when the picture is there"]
    latency_ms = report["latency_ms"]["p99"] - (picture["p99"] - picture["p50"])
    times = {
        f"latency p99 {latency_ms:.1f} ms, limit 30": latency_ms / 30.0,
        f"{report['dropped_late']} dropped late, limit 0": math.inf if report["dropped_late"] else 0.0,
        f"coverage {report['coverage']:.3f}, limit 0.99": 0.0 if report["coverage"] >= 0.99 else math.inf,
        f"rate {report['rate_hz']:.1f} Hz, limit 55": 55.0 / max(report["rate_hz"], 1e-3),
    }
    return {words: times for words, times in times.items() if not times <= 1.0}


def cpu_times() -> tuple[int, int]:
    """Return the idle and all time of all processors since the machine started, in ticks."""
    values = [int(word) for word in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    return values[3], sum(values)


@pytest.mark.real_time
def test_tracks_within_its_figures(tmp_path: Path) -> None:
    """All limits hold in one and the same run; something else on the machine may spoil a run, not all.

    Rendering two cameras at 60 Hz takes most of two cores. Where there are no more, or the machine is left with less
    than a quarter of its time (setting up, which keeps one core busy, takes the first of it), latency and losses are
    its own and not the tracker's, and the same limits are asked of cameras at 30 Hz.
    """
    slow = ("--rate", "30")
    rate = slow if (os.cpu_count() or 1) <= 2 else ()
    runs = []
    for _ in range(4):
        idle, total = cpu_times()
        runs.append(run_sim(tmp_path, *rate))
        if not too_slow(runs[-1][0]):
            break
        if (cpu_times()[0] - idle) / (cpu_times()[1] - total) < 0.25:
            rate = slow
    report, printed = min(runs, key=lambda run: max(too_slow(run[0]).values(), default=0.0))
    assert report["coverage_samples"] > 500
    assert report["fingertip_error_mm"]["median"] <= 5.0
    assert all(finger["median"] <= 5.0 for finger in report["fingertip_error_mm"]["per_finger"].values())
    assert report["object_error_mm"]["median"] <= 1.0
    assert {"p50", "p99", "parts"} <= set(report["latency_ms"])
    assert f"{report['fingertip_error_mm']['median']:.2f} mm" in printed, "what is printed stands in the report"
    figures_in_time(too_slow(report))


async def tracks(endpoint: str) -> None:
    """Wait until a rig tracks a hand."""
    async with await Bus.open(BusConfig(connect=(endpoint,)), timeout_s=PATIENCE_S) as bus:
        await hand_measured_after(bus, time.time_ns())


def started(rig: Path, endpoint: str) -> subprocess.Popen[str]:
    """Start the simulation of a rig that is there already, and wait until it tracks."""

    command = [sys.executable, "-m", "rhot", "sim", "--rig", str(rig), "--duration", "600", "--headless"]
    process = subprocess.Popen(
        [*command, "--listen", endpoint], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        asyncio.run(tracks(endpoint))
        assert process.poll() is None
    except BaseException:
        process.kill()
        raise
    return process


@pytest.mark.real_time
def test_ctrl_c_ends_everything_within_two_seconds(simulated_rig: tuple[Path, str]) -> None:
    rig, endpoint = simulated_rig
    with started(rig, endpoint) as process:
        assert process.stdout is not None
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
        process.wait(timeout=10)
        took_s = time.monotonic() - begun
        rest = process.stdout.read()
    assert process.returncode == 130
    assert "Traceback" not in rest
    assert list(processes_that_name(endpoint)) == []
    in_time(took_s, 2.0, "the end")


@pytest.mark.real_time
def test_a_parent_that_is_killed_leaves_no_child(simulated_rig: tuple[Path, str]) -> None:
    rig, endpoint = simulated_rig
    with started(rig, endpoint) as process:
        assert len(list(processes_that_name(endpoint))) > 4
        process.kill()
    begun = time.monotonic()
    while list(processes_that_name(endpoint)):
        assert time.monotonic() < begun + PATIENCE_S, "a child outlived its parent"
        time.sleep(0.05)
    in_time(time.monotonic() - begun, 3.0, "the children's end")


def test_the_rig_stays_after_the_summary_while_a_person_watches(
    simulated_rig: tuple[Path, str], free_port: int
) -> None:
    """In a terminal: summary, next commands, and the pages go on until Ctrl-C."""
    rig, endpoint = simulated_rig
    terminal, slave = pty.openpty()
    command = [sys.executable, "-m", "rhot", "sim", "--rig", str(rig), "--duration", "8", "--listen", endpoint]
    said = b""
    with subprocess.Popen(
        [*command, "--page-port", str(free_port)], stdin=slave, stdout=slave, stderr=slave, start_new_session=True
    ) as process:
        os.close(slave)
        try:
            deadline = time.monotonic() + PATIENCE_S
            # One page where Grasp is not built.
            while len(re.findall(rb"The page (?:for working on the rig )?is at", said)) < 2:
                assert time.monotonic() < deadline, said.decode(errors="replace")
                if select.select([terminal], [], [], 1.0)[0]:
                    said += os.read(terminal, 65536)
            page = re.findall(rb"(?:rig|page) is at \S*?(http://localhost:\d+)", said)[-1].decode()
            with urllib.request.urlopen(page, timeout=10.0) as answer:
                assert answer.status == 200, "the page is still there"
            process.send_signal(signal.SIGINT)
            while process.poll() is None:
                assert time.monotonic() < deadline
                if select.select([terminal], [], [], 0.1)[0]:
                    with contextlib.suppress(OSError):
                        os.read(terminal, 65536)
        finally:
            process.kill()
            os.close(terminal)
    assert process.returncode == 0
    assert list(processes_that_name(endpoint)) == []
    text = said.decode()
    assert "This machine kept up" in text or "This machine did not keep up" in text
    assert "runs on until Ctrl-C" in text
    assert all(next_command in text for next_command in ("rhot status", "rhot record --out", "rhot init myrig"))


def test_a_clock_that_is_set_while_it_runs_does_not_end_it(tmp_path: Path) -> None:
    make_clock(tmp_path / "clock")
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    command = [sys.executable, "-m", "moved_clock", str(tmp_path / "clock"), "sim", "--duration", "15", "--headless"]
    search = f"{Path(__file__).parents[1] / 'support'}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    with subprocess.Popen(
        [*command, "--rate", "15", "--listen", endpoint],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONPATH": search},
    ) as process:
        asyncio.run(tracks(endpoint))
        begun = time.monotonic()
        move_clock(tmp_path / "clock", 3600.0)
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    assert "Summary" in said
    assert time.monotonic() - begun > 2.0, "an hour has not passed"


@pytest.mark.parametrize("after_s", [0.3, 1.0, 3.0])
def test_sigterm_at_the_start_leaves_neither_a_folder_nor_a_child(tmp_path: Path, after_s: float) -> None:
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    command = [sys.executable, "-m", "rhot", "sim", "--headless", "--listen", endpoint]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**os.environ, "TMPDIR": str(tmp_path)}) as process:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
        process.terminate()
        process.wait(PATIENCE_S)
    assert list(processes_that_name(str(tmp_path))) == []
    assert list(tmp_path.glob("rhot-sim*")) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("after_s", [0.5, 1.5])
def test_an_interrupted_init_can_be_done_again(tmp_path: Path, after_s: float, number: int) -> None:
    command = [sys.executable, "-m", "rhot", "init", str(tmp_path / "rig"), "--sim"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
        process.send_signal(number)
        process.wait(PATIENCE_S)
    if process.returncode:
        assert not list(tmp_path.iterdir())
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=PATIENCE_S)
    load_rig(tmp_path / "rig")


@pytest.mark.parametrize("said", ["file", "environment"])
async def test_a_rig_with_a_namespace_meets_its_services(
    said: str, simulated_rig: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared, endpoint = simulated_rig
    # The rig is shared with other tests of this process: they would wait in another namespace.
    folder = shutil.copytree(shared, tmp_path / "rig")
    if said == "file":
        change_rig_file(folder, {("bus",): {"namespace": "desk1"}})
    else:
        monkeypatch.setenv("RHOT_NAMESPACE", "desk1")
    met = asyncio.Event()

    async def meet(bus: Bus) -> None:
        met.set()

    command = ["truth", "--rig", str(folder), "--connect", endpoint]
    monkeypatch.setattr(processes, "_UP_LIMIT_S", PATIENCE_S)
    await processes.with_processes(
        processes.bus_of(load_rig(folder), endpoint), {"truth/main": command}, tmp_path, meet
    )
    assert met.is_set()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--report", "/nonexistent/r.json"], "does not exist"),
        (["--duration", "0"], "duration"),
        (["--cameras", "1"], "cameras"),
        (["--rig", "/nonexistent"], "rhot init"),
    ],
)
def test_wrong_words_get_one_clear_error(arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["sim", *arguments])
    assert ended.value.code != 0
    said = capsys.readouterr().err
    assert says in said
    assert "Traceback" not in said
