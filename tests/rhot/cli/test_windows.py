"""What runs on Windows, as far as that can be seen elsewhere: see as_windows/sitecustomize.py."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from bus_watch import PATIENCE_S
from running.rig_processes import processes_that_name

from rhot_sim.running.processes import free_endpoint

HERE = Path(__file__).parent / "as_windows"
ALL_MODULES = """
import importlib, json, pkgutil, sys
assert sys.platform == "win32"
failed = {}
names = [name for package in PACKAGES for name in (package, *(found.name for found in pkgutil.walk_packages(
    importlib.import_module(package).__path__, package + ".", onerror=lambda name: None)))]
for name in names:
    try:
        importlib.import_module(name)
    except Exception as error:
        failed[name] = f"{type(error).__name__}: {error}"
print(json.dumps([len(names), failed]))
"""
ALL_COMMANDS = """
import click, json
from rhot.cli.main import main
def helped(command, context):
    said = [command.get_help(context)]
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            under = command.get_command(context, name)
            said += helped(under, click.Context(under, parent=context, info_name=name))
    return said
print(json.dumps(len(helped(main, click.Context(main, info_name="rhot")))))
"""
PACKAGES = [
    *("rhot", "rhot_capture", "rhot_fusion", "rhot_ik", "rhot_objects", "rhot_feet", "rhot_viewer", "rhot_bridge"),
    *("rhot_calibration", "rhot_sim", "rhot_tools"),
]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(HERE)}


def run(code: str) -> Any:
    done = subprocess.run([sys.executable, "-c", code], env=environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_every_module_loads_without_unix() -> None:
    count, failed = run(f"PACKAGES = {PACKAGES!r}\n{ALL_MODULES}")
    assert count > 300
    assert failed == {}


def test_every_command_starts_without_unix() -> None:
    assert run(ALL_COMMANDS) > 40


def test_the_whole_rig_runs_without_unix_and_ends_in_time(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    options = ["--duration", "4", "--rate", "15", "--no-viewer", "--report", str(report)]
    command = [sys.executable, "-m", "rhot", "sim", *options]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=90, check=False)
    assert report.exists(), done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr

    rig = tmp_path / "rig"
    init = [sys.executable, "-m", "rhot", "init", str(rig), "--sim"]
    subprocess.run(init, env=environment(), check=True, capture_output=True)
    child = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "rhot",
            "sim",
            "--rig",
            str(rig),
            "--headless",
            "--listen",
            free_endpoint("tcp/127.0.0.1:0"),
        ],
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    deadline = time.monotonic() + PATIENCE_S
    while len(list(processes_that_name(str(rig)))) < 6:
        assert child.poll() is None, child.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.1)
    child.send_signal(signal.SIGINT)
    asked_s = time.monotonic()
    said, _ = child.communicate(timeout=PATIENCE_S)
    assert "Traceback" not in said
    # A renderer that was still loading ends when it sees that its camera is gone.
    while left := list(processes_that_name(str(rig))):
        assert time.monotonic() < asked_s + 2.0, left
        time.sleep(0.01)
