"""A PC and a Pi in two network namespaces, set up by nothing but the commands of docs/use.md."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from bus_watch import PATIENCE_S

pytestmark = [pytest.mark.integration]

PAGE = Path(__file__).parents[2] / "docs" / "use.md"
PC_ADDRESS, PI_ADDRESS = "192.168.1.10", "192.168.1.20"
"""The PC's as on the page: inside of namespaces nobody else has it."""


class Machine:
    """A network namespace and a folder, in which commands run as they would on a machine of its own."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name = f"rhot-{name}-{uuid.uuid4().hex[:6]}"
        self.folder = folder
        self._running: list[subprocess.Popen[bytes]] = []
        folder.mkdir()
        subprocess.run(["ip", "netns", "add", self.name], check=True, capture_output=True)
        try:
            subprocess.run(["ip", "-n", self.name, "link", "set", "lo", "up"], check=True, capture_output=True)
        except subprocess.CalledProcessError:
            subprocess.run(["ip", "netns", "del", self.name], check=False)
            raise

    def _popen(self, command: str, log: Path) -> subprocess.Popen[bytes]:
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        # Without `uplink` of this machine's own rigs and addresses.
        environment = {"PATH": path, "HOME": str(self.folder), "COLUMNS": "200", "PYTHONUNBUFFERED": "1"}
        return subprocess.Popen(
            ["ip", "netns", "exec", self.name, "sh", "-c", f"exec {command}"],
            cwd=self.folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log.open("ab"),
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    def run(self, command: str) -> str:
        """Run a command to its end and return what it said."""
        log = self.folder / f"{uuid.uuid4().hex}.log"
        process = self._popen(command, log)
        code = process.wait(PATIENCE_S)
        assert code == 0, f"{command}: {log.read_text()}"
        return log.read_text()

    def start(self, command: str) -> None:
        """Start a command that goes on."""
        self._running.append(self._popen(command, self.folder / "running.log"))

    def log(self) -> str:
        """What the commands that go on have said."""
        return (self.folder / "running.log").read_text()

    def end(self) -> None:
        """End everything on this machine, and the machine."""
        for process in self._running:
            os.killpg(process.pid, signal.SIGINT)
        for process in self._running:
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
        subprocess.run(["ip", "netns", "del", self.name], check=True)


@pytest.fixture
def machines(tmp_path: Path) -> Iterator[tuple[Machine, Machine]]:
    """A PC and a Pi, and a cable between them."""
    made: list[Machine] = []
    try:
        try:
            for name in ("pc", "pi"):
                made.append(Machine(name, tmp_path / name))  # noqa: PERF401  # kept at once: ended if the next fails
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f"no network namespaces can be made here: {error}")
        pc, pi = made
        ends = f"r{uuid.uuid4().hex[:8]}", f"r{uuid.uuid4().hex[:8]}"
        subprocess.run(["ip", "link", "add", ends[0], "type", "veth", "peer", "name", ends[1]], check=True)
        for machine, end, address in zip(made, ends, (PC_ADDRESS, PI_ADDRESS), strict=True):
            subprocess.run(["ip", "link", "set", end, "netns", machine.name], check=True)
            subprocess.run(["ip", "-n", machine.name, "addr", "add", f"{address}/24", "dev", end], check=True)
            subprocess.run(["ip", "-n", machine.name, "link", "set", end, "up"], check=True)
        yield pc, pi
    finally:
        for machine in made:
            machine.end()


def page_commands(heading: str) -> list[str]:
    """Return the commands of the first block of the page after a text."""
    after = PAGE.read_text(encoding="utf-8").partition(heading)[2]
    block = re.search(r"```\n(.*?)```", after, re.DOTALL)
    assert block is not None, heading
    return [line.partition(" #")[0].strip() for line in block[1].splitlines()]


def test_the_commands_of_the_page_connect_a_pi(machines: tuple[Machine, Machine]) -> None:
    pc, pi = machines
    on_pc, on_pi = page_commands("**Cameras on Raspberry Pis.**"), page_commands("On each Pi, here the left one.")
    assert [command.split()[:2] for command in on_pc[:2]] == [["rhot", "init"], ["rhot", "keys"]]
    for command in on_pc:
        if command.startswith("rhot init"):
            # Cameras are simulated here, and slow ones leave the machine to other tests.
            pc.run(f"{command} --sim")
            rig = pc.folder / "myrig" / "rig.toml"
            rig.write_text(re.sub(r"rate_hz = 60(\.0)?\b", "rate_hz = 15.0", rig.read_text()))
        elif command.startswith("scp "):
            shutil.copy(pc.folder / command.split()[1], pi.folder)
        elif command.startswith("rhot up"):
            pc.start(command)
        else:
            pc.run(command)
    # One Pi with both cameras: what it must not need is the PC's rig folder.
    for camera in ("left", "right"):
        for command in on_pi:
            here = command.replace("camera-left", f"camera-{camera}").replace("--camera left", f"--camera {camera}")
            here = here.replace("myrig", f"rig-{camera}")
            if here.startswith("rhot capture"):
                pi.start(here)
            else:
                pi.run(here)
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            told = pc.run("rhot get rhot/hand/right --rig myrig")
            hand = json.loads(told.splitlines()[-1])["value"]
            if hand["state"] == "measured":
                break
        except (AssertionError, KeyError, ValueError, IndexError):
            pass
        assert time.monotonic() < deadline, f"PC:\n{pc.log()}\nPi:\n{pi.log()}"
        time.sleep(0.5)
    status = pc.run("rhot status --rig myrig")
    assert "capture/left" in status
    assert "capture/right" in status


def test_who_forgets_the_certificates_is_told_on_both_machines(machines: tuple[Machine, Machine]) -> None:
    pc, pi = machines
    pc.run("rhot init myrig --sim")
    shutil.copytree(pc.folder / "myrig", pi.folder / "myrig")
    pc.start("rhot router --rig myrig")
    pi.start("rhot capture --camera left --rig myrig")
    doctor = "rhot doctor --rig myrig || true"
    for machine, says in (
        (pc, "for cameras on other machines: rhot keys make"),
        (pi, "bring its certificate from the"),
    ):
        assert says in machine.run(f"sh -c '{doctor}'")
    deadline = time.monotonic() + PATIENCE_S
    while "bring this one's certificate: `rhot keys install`" not in pi.log():
        assert time.monotonic() < deadline, pi.log()
        time.sleep(0.1)
