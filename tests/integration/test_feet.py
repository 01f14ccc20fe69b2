"""`rhot sim --feet` as a user runs it: real processes from the drawn picture to the knee, its report, Ctrl-C."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from running.rig_processes import processes_that_name
from wall_clock import figures_in_time, in_time

from rhot_sim.running.processes import free_endpoint

pytestmark = pytest.mark.integration

_COMMAND = [sys.executable, "-m", "rhot", "sim", "--feet", "--headless", "--rate", "15"]


def run_feet(folder: Path) -> dict[str, Any]:
    """Let somebody stand for 7 s; return the report."""
    report_path, endpoint = folder / "r.json", free_endpoint("tcp/127.0.0.1:0")
    options = ["--walk", "still", "--duration", "7", "--report", str(report_path), "--listen", endpoint]
    done = subprocess.run([*_COMMAND, *options], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "foot error, median" in done.stdout
    assert list(processes_that_name(endpoint)) == []
    report: dict[str, Any] = json.loads(report_path.read_text())
    return report


def too_slow(report: dict[str, Any]) -> dict[str, float]:
    """Name the figures that fall when pictures are drawn or looked at too late, and how many times below they are."""
    limits = {"measured": 0.9, "rate_hz": 40.0}
    times = {
        f"{name} {report[name]:.3g}, limit {limit}": limit / max(report[name], 1e-3) for name, limit in limits.items()
    }
    return {words: times for words, times in times.items() if not times < 1.0}


@pytest.mark.real_time
def test_feet_and_knees_of_a_standing_person(tmp_path: Path) -> None:
    """All limits hold in one and the same run; something else on the machine may spoil a run, not all."""
    for _ in range(3):
        report = run_feet(tmp_path)
        if not too_slow(report):
            break
    assert report["foot_error_mm"]["median"] < 5.0
    assert report["foot_error_mm"]["max"] < 30.0
    assert report["knee_error_mm"]["median"] < 80.0
    assert report["knees_backwards"] == 0
    figures_in_time(too_slow(report))
    in_time(report["latency_ms"]["p50"], 60.0, "latency", "ms")


def test_ctrl_c_ends_every_process(tmp_path: Path) -> None:
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    command = [*_COMMAND, "--duration", "600", "--listen", endpoint]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path
    ) as process:
        deadline = time.monotonic() + 60.0
        while len(list(processes_that_name(endpoint))) < 5 and time.monotonic() < deadline:
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20.0) == 130
    assert list(processes_that_name(endpoint)) == []
