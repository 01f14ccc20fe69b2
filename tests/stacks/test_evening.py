"""The page `docs/evening.md`, followed to the letter: its commands are typed as they stand there.

On the simulated rig that the page names for those who have no cameras, to its end; before two loopback webcams to the
running rig, as an emulated machine is too slow to track. What a person does at each step (hold the board, click, move)
is a line of `AT_STEP`.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pytest
from machine.stacks import SHARE, in_guest

from rhot.rig import load_rig
from rhot.rig.toml_edit import change_rig_file
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.running.processes import free_endpoint
from rhot_sim.world.world import World

PAGE: Final = Path(__file__).parents[2] / "docs/evening.md"
AT_STEP: Final = {6: "board", 8: "still", 9: "script", 10: "script"}
"""What the cameras see from a step on."""
LASTING: Final = ("rhot up", "rhot sim", "rhot bridge")
"""Commands that run on while the next ones are typed."""
RUNNING: Final = 5
"""Step after which the rig runs."""
PATIENCE_S: Final = 400.0
HANDS_S: Final = 5.0
"""From the start of a session until somebody's hands are where they belong."""


def steps() -> dict[int, list[str]]:
    """Return the commands of each step of the page."""
    found: dict[int, list[str]] = {}
    parts = re.split(r"^\*\*(\d+)\. ", PAGE.read_text(), flags=re.MULTILINE)
    for number, text in zip(parts[1::2], parts[2::2], strict=True):
        blocks = re.findall(r"^```sh\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
        found[int(number)] = [line for block in blocks for line in block.splitlines()]
    return found


def test_the_page_has_twelve_steps_and_all_its_commands_are_known() -> None:
    assert list(steps()) == list(range(1, 13))
    assert sum(map(len, steps().values())) >= 12


class Evening:
    """Somebody who types what the page says."""

    def __init__(self, folder: Path, instead: Mapping[str, str], picks: Sequence[str], record: Any) -> None:
        self.folder = folder
        self.instead = instead
        self.picks = picks
        self.record = record
        self.lasting: list[subprocess.Popen[str]] = []
        self.environment = {**os.environ, "COLUMNS": "160"}

    def follow(self, show: Callable[[str], None], last: int = 12) -> None:
        begun = time.monotonic()
        for number, commands in steps().items():
            if number > last:
                return
            if number in AT_STEP:
                show(AT_STEP[number])
            for command in commands:
                self.type(number, command)
            self.record(f"after step {number}", f"{time.monotonic() - begun:.0f} s")

    def type(self, number: int, command: str) -> None:
        words = shlex.split(self.instead.get(command, command))
        if words[-1] == "…":
            words[-1:] = [word for pick in self.picks for word in ("--pick", pick)][1:]
        assert words[0] == "rhot"
        line = [sys.executable, "-m", "rhot", *words[1:]]
        log = self.folder / f"step{number}-{words[1]}.txt"
        if command.startswith(LASTING):
            with log.open("w") as output:
                kind = {"stdout": output, "stderr": subprocess.STDOUT, "cwd": self.folder, "text": True}
                self.lasting.append(subprocess.Popen(line, env=self.environment, **kind))  # type: ignore[call-overload]
            if words[1] != "bridge":
                self.wait_for(log, "session .* runs|Ctrl-C ends it")
            return
        answer = "1\n" if "--webcams" in words else None
        done = subprocess.run(
            line, env=self.environment, cwd=self.folder, input=answer, capture_output=True, text=True, check=False,
            timeout=PATIENCE_S,
        )  # fmt: skip
        log.write_text(done.stdout + done.stderr)
        if words[1] == "start":
            time.sleep(HANDS_S)
        assert done.returncode == 0, f"step {number}: {command}\n{done.stdout}\n{done.stderr}"

    def wait_for(self, log: Path, pattern: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not re.search(pattern, log.read_text()):
            assert time.monotonic() < deadline, log.read_text()
            assert self.lasting[-1].poll() is None, log.read_text()
            time.sleep(0.2)

    def end(self) -> None:
        for process in self.lasting:
            process.send_signal(signal.SIGINT)
        for process in self.lasting:
            process.wait(timeout=30)


def bones_that_move(port: int) -> set[str]:
    """Receive VMC for a while, and return the bones whose rotation changes."""
    seen: dict[str, set[bytes]] = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", port))
        receiver.settimeout(60.0)
        until = time.monotonic() + 20.0
        while time.monotonic() < until:
            packet = receiver.recv(65536)
            for match in re.finditer(rb"/VMC/Ext/Bone/Pos\0+,sfffffff\0+", packet):
                name, _, _ = packet[match.end() :].partition(b"\0")
                start = -(-(len(name) + 1) // 4) * 4
                seen.setdefault(name.decode(), set()).add(packet[match.end() + start : match.end() + start + 28])
    return {name for name, poses in seen.items() if len(poses) > 3}


def judge(evening: Evening) -> None:
    """Is each step as the page says that it is when right?"""
    rig = load_rig(evening.folder / "evening")
    assert {"cameras.json", "colors.json", "hand.json"} <= {file.name for file in rig.path.iterdir()}
    assert '"measured"' in (evening.folder / "step9-get.txt").read_text()
    moving = bones_that_move(39539)
    assert {"RightIndexProximal", "RightIndexIntermediate", "RightMiddleProximal"} <= moving, moving


@pytest.mark.faults
def test_on_the_simulated_rig(tmp_path: Path, record_property: Any) -> None:
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    instead = {
        "rhot init evening --webcams": "rhot init evening --sim --uncalibrated",
        "rhot up --rig evening": f"rhot sim --rig evening --listen {endpoint}",
    }
    folder = tmp_path / "evening"
    picks: list[str] = []
    evening = Evening(tmp_path, instead, picks, record_property)
    evening.environment["RHOT_CONNECT"] = endpoint

    def show(motion: str) -> None:
        change_rig_file(folder, {("sim",): {"motion": motion}})
        evening.type(0, "rhot stop")
        evening.type(0, "rhot start --rig evening")
        if motion == "still":
            rig = load_rig(folder)
            for name, camera in true_cameras(rig).items():
                views = MarkerCoverage(camera, World.from_rig(rig)).at(0.0)
                picks.extend(f"{marker}={view.u:.0f},{view.v:.0f}@{name}" for marker, view in views.items())

    try:
        evening.follow(show)
        judge(evening)
    finally:
        evening.end()


FEEDER = """
import sys, time
from pathlib import Path
import numpy as np
pictures = np.load(sys.argv[1])
outputs = {name: open(path, 'wb', buffering=0) for name, path in (('left', sys.argv[2]), ('right', sys.argv[3]))}
while True:
    for name, output in outputs.items():
        output.write(pictures[name].tobytes())
    time.sleep(0.2)
"""


@contextlib.contextmanager
def webcams() -> Iterator[None]:
    """Two webcams that see a hand."""
    devices = ["/dev/video20", "/dev/video21"]
    options = ["video_nr=20,21", "card_label=left,right", "exclusive_caps=1,1"]
    subprocess.run(["modprobe", "v4l2loopback", *options], check=True)
    time.sleep(2.0)
    for device in devices:
        wanted = "width=640,height=480,pixelformat=YUYV"
        subprocess.run(["v4l2-ctl", "-d", device, f"--set-fmt-video-out={wanted}"], check=True)
    try:
        with subprocess.Popen([sys.executable, "-c", FEEDER, SHARE / "played/pictures.npz", *devices]) as process:
            yield
            process.kill()
    finally:
        subprocess.run(["rmmod", "v4l2loopback"], check=False)


@pytest.mark.stacks
def test_with_two_webcams(tmp_path: Path, record_property: Any) -> None:
    in_guest()
    with webcams():
        evening = Evening(tmp_path, {}, [], record_property)
        try:
            evening.follow(lambda _: None, last=RUNNING)
        finally:
            evening.end()
    cameras = load_rig(tmp_path / "evening").config.cameras
    assert {name: camera.video_path for name, camera in cameras.items()} == {
        "left": "/dev/video20",
        "right": "/dev/video21",
    }
    assert all(camera.source == "v4l2" for camera in cameras.values())
    status = (tmp_path / "step5-status.txt").read_text()
    assert re.search(r"capture/left +running", status), status
    assert re.search(r"capture/right +running", status), status
    # The loopback driver has no such controls, and each says so.
    assert (tmp_path / "step3-init.txt").read_text().count("not locked: pixel format MJPG") == 2
