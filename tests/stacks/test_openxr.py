"""The OpenXR layer between the Khronos loader and Monado, read by programs that know nothing of RHOT.

All of it runs in a Debian of its own (`openxr/make.sh`); shared memory is this machine's, where the bridge runs.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from running.rig_processes import next_message

from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot.bus import Bus
from rhot.geometry.rotations import inverse, rotation_from_quaternion
from rhot.messages import HandPose
from rhot.rig import BusConfig, load_rig
from rhot.rig.folder import RIG_FILE
from rhot_bridge.openxr_layer import DISABLE, FLAGS, LIBRARY, manifest, sources
from rhot_sim.rig.folder import write_simulated_rig
from rhot_sim.running.processes import free_endpoint

pytestmark = pytest.mark.stacks

HERE = Path(__file__).parent / "openxr"
REPOSITORY = Path(__file__).parents[2]
ROOT = Path(os.environ.get("RHOT_STACKS", REPOSITORY / ".stacks")) / "openxr"
VALID, TRACKED = 0b0011, 0b1111
"""XrSpaceLocationFlags: orientation and position valid; and tracked."""
MANIFESTS = ROOT / "root/.local/share/openxr/1/api_layers/implicit.d"
IN_ROOT = 'mount --bind /dev/shm "$0/dev/shm" && mount -t proc proc "$0/proc" && exec chroot "$0" /usr/bin/env -i "$@"'
"""Run in namespaces of its own, which take mounts and processes with them."""


class Machine:
    """The Debian, with one memory of hands."""

    def __init__(self, memory: Path) -> None:
        self.memory = memory

    def start(self, *command: str, **variables: str) -> subprocess.Popen[str]:
        """Start a program that has the layer installed."""
        given = {
            "PATH": "/usr/bin:/bin",
            "HOME": "/root",
            "XDG_RUNTIME_DIR": "/run/xdg",
            "XR_RUNTIME_JSON": "/usr/share/openxr/1/openxr_monado.json",
            "PYTHONPATH": "/opt/py:/opt/isaac",
            # It asks for NVIDIA's own runtime first.
            "ISAAC_TELEOP_DISABLE_CXR_ENV_CHECKS": "1",
            "RHOT_HANDS": str(self.memory),
            **variables,
        }
        namespaces = ("unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", IN_ROOT, str(ROOT))
        words = [f"{name}={value}" for name, value in given.items()]
        return subprocess.Popen(
            [*namespaces, *words, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def run(self, *command: str, timeout_s: float = 120.0, **variables: str) -> str:
        """Run a program to its end, which has to be a good one, and return its output."""
        child = self.start(*command, **variables)
        try:
            said, _ = child.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            child.kill()
            raise
        assert child.returncode == 0, said
        return said


class Program:
    """A running reader.py."""

    def __init__(self, machine: Machine, *arguments: str, **variables: str) -> None:
        self.child = machine.start("python3", "/rhot/reader.py", *arguments, **variables)
        self.log: list[str] = []
        self.said = self._answer()

    def _answer(self) -> dict[str, Any]:
        """Return the next line of JSON; what the runtime logs goes by."""
        assert self.child.stdout is not None
        # One that hangs ends here, and fails.
        limit = threading.Timer(20.0, self.child.kill)
        limit.start()
        try:
            for line in self.child.stdout:
                if line.startswith("{"):
                    answer: dict[str, Any] = json.loads(line)
                    return answer
                self.log.append(line)
        finally:
            limit.cancel()
        raise AssertionError("".join(self.log[-40:]))

    def ask(self, do: str, **request: object) -> dict[str, Any]:
        """Let it do something, and return what it says of it."""
        assert self.child.stdin is not None
        self.child.stdin.write(json.dumps({"do": do, **request}) + "\n")
        self.child.stdin.flush()
        return self._answer()

    def locate(self, side: str = "right", space: str = "STAGE", ahead_ms: float = 20.0) -> dict[str, Any]:
        return self.ask("locate", side=side, space=space, ahead_ms=ahead_ms)

    def until(self, active: bool, limit_s: float) -> float:
        """Wait until the right hand is there, or not; return the seconds it took."""
        begun = time.monotonic()
        while self.locate()["active"] != active:
            assert time.monotonic() - begun < limit_s, f"active is not {active} after {limit_s} s"
            time.sleep(0.01)
        return time.monotonic() - begun

    def end(self) -> str:
        """Let it end, and return all it has logged."""
        said, _ = self.child.communicate(timeout=20)
        assert self.child.returncode == 0, said
        return "".join(self.log) + said


@pytest.fixture(scope="module")
def machine() -> Iterator[Machine]:
    """The Debian with the layer built and installed."""
    if os.geteuid() != 0:
        pytest.skip("only root can run a program in a Debian of its own")
    if not (ROOT / ".ready").exists():
        pytest.skip("no Debian with Monado: make stacks STACKS=openxr makes it")
    made = Machine(Path("/dev/shm") / f"rhot_hands.test{os.getpid()}")  # shared memory of a test
    folder = ROOT / "rhot"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(sources(), folder)
    for file in (HERE / "reader.py", HERE / "hammer.c", HERE.with_name("readers") / "isaac.py"):
        shutil.copy(file, folder)
    made.run("cc", *FLAGS, "/rhot/rhot_layer.c", "-o", f"/rhot/{LIBRARY}", "-lm")
    shutil.rmtree(MANIFESTS, ignore_errors=True)
    MANIFESTS.mkdir(parents=True)
    (MANIFESTS / "rhot_hands.json").write_text(json.dumps(manifest(Path("/rhot") / LIBRARY)))
    yield made
    made.memory.unlink(missing_ok=True)


@pytest.fixture(scope="module")
def runtime(machine: Machine) -> Iterator[Machine]:
    """Monado with its simulated headset, without a display."""
    shutil.rmtree(ROOT / "run/xdg", ignore_errors=True)
    (ROOT / "run/xdg").mkdir(mode=0o700)
    service = machine.start(
        "monado-service",
        XRT_COMPOSITOR_NULL="1",
        SIMULATED_ENABLE="1",
        SIMULATED_LEFT="simple",
        SIMULATED_RIGHT="simple",
        XRT_NO_STDIN="1",
    )
    deadline = time.monotonic() + 20.0
    while not (ROOT / "run/xdg/monado_comp_ipc").exists():
        assert service.poll() is None, service.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.05)
    yield machine
    # unshare is deaf to SIGTERM.
    service.kill()
    service.communicate(timeout=20)


WRITER = """
import sys, time
import numpy as np
from rhot_bridge.targets.openxr import JOINT, HandsMemory
memory = HandsMemory()
print("up", flush=True)
while True:
    t_ns = time.monotonic_ns()
    joints = np.zeros(26, JOINT)
    angle = 1e-9 * t_ns
    joints["position"] = 0.1 * np.cos(angle), 1.2, 0.1 * np.sin(angle) - 0.3
    joints["position"][:, 0] += 0.01 * np.arange(26)
    joints["orientation"] = 0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2)
    joints["radius"] = 0.008
    joints["linear_velocity"] = -0.1 * np.sin(angle), 0.0, 0.1 * np.cos(angle)
    joints["angular_velocity"] = 0.0, 1.0, 0.0
    memory.write("right", int(sys.argv[1]), t_ns, joints)
    time.sleep(0.01)
"""
"""A hand on a circle of 0.1 m, once round in 2π seconds, that turns with it; the left one is absent."""


@contextlib.contextmanager
def hand_written(machine: Machine, state: int = 2) -> Iterator[subprocess.Popen[bytes]]:
    """A bridge that writes a hand that moves."""
    variables = {**os.environ, "RHOT_HANDS": str(machine.memory)}
    child = subprocess.Popen([sys.executable, "-c", WRITER, str(state)], env=variables, stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdout.readline() == b"up\n"
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


def on_circle(t_ns: int) -> tuple[FloatArray, FloatArray]:
    """Return where the joints (26, 3) of the written hand are at a time, and their velocity (3,)."""
    angle = 1e-9 * t_ns
    positions = np.tile([0.1 * np.cos(angle), 1.2, 0.1 * np.sin(angle) - 0.3], (26, 1))
    positions[:, 0] += 0.01 * np.arange(26)
    return positions, np.array([-0.1 * np.sin(angle), 0.0, 0.1 * np.cos(angle)])


def test_a_program_gets_the_hand_in_every_space_at_its_time(runtime: Machine) -> None:
    with hand_written(runtime):
        program = Program(runtime)
        assert "Monado" in program.said["runtime"]
        assert program.said["supports"]
        assert len(program.said["offered"]) == 3
        for space in ("STAGE", "LOCAL", "VIEW"):
            for ahead_ms in (-10.0, 0.0, 30.0):
                found = program.locate(space=space, ahead_ms=ahead_ms)
                assert (found["result"], found["active"]) == ("SUCCESS", True)
                stage = np.array(found["stage"])
                R = rotation_from_quaternion(stage[3:])
                positions, velocity = on_circle(found["t_ns"])
                off = np.array(found["positions"]) - (positions @ R.T + stage[:3])
                # Besides rounding, half of acceleration times time squared: 0.1 m/s² over 40 ms.
                assert np.abs(off).max() < 1e-4
                assert found["radii"] == pytest.approx([0.008] * 26)
                if space == "STAGE":
                    assert found["flags"] == [TRACKED]
                    np.testing.assert_allclose(found["linear"], np.tile(velocity, (26, 1)), atol=0.005)
                    np.testing.assert_allclose(found["angular"], np.tile([0.0, 1.0, 0.0], (26, 1)), atol=1e-5)
                    angle = 1e-9 * found["t_ns"]
                    wanted = np.array([0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2)])
                    assert np.abs(np.abs(np.array(found["orientations"]) @ wanted) - 1.0).max() < 1e-5
                assert found["source"] == [True, 1]
                # All joints in a row: thumb and index tips are 5 cm apart.
                assert found["aim"][0] & 0b11 == 0b11
                assert found["aim"][1] == pytest.approx((0.06 - 0.05) / 0.045, abs=0.01)
        absent = program.locate(side="left")
        assert (absent["result"], absent["active"], absent["flags"]) == ("SUCCESS", False, [0])
        program.end()


def test_it_says_what_it_does_not_know(runtime: Machine) -> None:
    with hand_written(runtime):
        program = Program(runtime)
        assert program.locate(ahead_ms=20.0)["flags"] == [TRACKED]
        far = program.locate(ahead_ms=200.0)
        assert (far["active"], far["flags"]) == (True, [VALID]), "carried on for 50 ms, and no further"
        assert np.abs(np.array(far["positions"]) - on_circle(far["t_ns"] - 150_000_000)[0]).max() < 0.003
        program.end()
    with hand_written(runtime, state=1):
        program = Program(runtime)
        assert program.locate()["flags"] == [VALID], "predicted"
        program.end()


def test_bridges_and_programs_come_and_go(runtime: Machine) -> None:
    runtime.memory.unlink(missing_ok=True)
    program, other = Program(runtime), Program(runtime)
    assert not program.locate()["active"]
    with hand_written(runtime) as bridge:
        assert program.until(True, 2.0) < 2.0
        assert other.until(True, 2.0) < 2.0
        other.child.send_signal(signal.SIGKILL)
        other.child.communicate()
        assert program.locate()["active"]
        bridge.send_signal(signal.SIGKILL)
        assert program.until(False, 1.0) < 0.6
    with hand_written(runtime):
        assert program.until(True, 2.0) < 2.0
        # A memory that somebody took away and a new bridge made again.
        runtime.memory.unlink()
    assert program.until(False, 1.0) < 0.6
    with hand_written(runtime):
        assert program.until(True, 2.0) < 2.0
    program.end()


def test_mistakes_of_a_program_are_told_as_the_specification_says(runtime: Machine) -> None:
    with hand_written(runtime):
        program = Program(runtime)
        assert program.ask("bad") == {
            "few": "ERROR_VALIDATION_FAILURE",
            "never": "ERROR_TIME_INVALID",
            "hand": "ERROR_VALIDATION_FAILURE",
            "left": "SUCCESS",
            "again": "ERROR_HANDLE_INVALID",
        }
        program.end()


def test_a_program_without_hands_sees_no_difference(runtime: Machine) -> None:
    with hand_written(runtime):
        with_layer = Program(runtime, "--no-hands")
        without = Program(runtime, "--no-hands", **{DISABLE: "1"})
        assert {**with_layer.said, "offered": []} == {**without.said, "offered": []}
        assert not with_layer.said["supports"]
        assert with_layer.said["function"] == "unsupported"
        with_layer.end()
        without.end()


def test_a_layer_that_is_registered_twice_is_there_once(runtime: Machine) -> None:
    """As after an installation for this user and one for all."""
    twice = MANIFESTS / "rhot_hands_too.json"
    shutil.copy(MANIFESTS / "rhot_hands.json", twice)
    try:
        with hand_written(runtime):
            program = Program(runtime)
            assert program.locate()["flags"] == [TRACKED]
            program.end()
    finally:
        twice.unlink()


def test_isaac_teleop_gets_the_hand_live(runtime: Machine, record_property: Callable[[str, object], None]) -> None:
    if not (ROOT / "opt/isaac/isaacteleop").exists():
        pytest.skip("no Isaac Teleop for this machine")
    with hand_written(runtime):
        lines = runtime.run("python3", "/rhot/isaac.py", "50").splitlines()
    # The runtime talks before.
    said = json.loads(next(line for line in lines if line.startswith("{")))
    assert said["left"] == [None] * 50
    off_mm = []
    for t_ns, right in zip(said["t_ns"], said["right"], strict=True):
        joints = np.array(right)
        off_mm.append(1e3 * np.abs(joints[:, :3] - on_circle(t_ns)[0]).max())
        angle = 1e-9 * t_ns
        wanted = np.array([0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2)])
        assert np.abs(np.abs(joints[:, 3:7] @ wanted) - 1.0).max() < 1e-5
        np.testing.assert_allclose(joints[:, 7:], np.tile([0.008, 1.0], (26, 1)), rtol=1e-6)
    record_property("Isaac Teleop, live, worst joint", f"median {np.median(off_mm):.4f} mm")
    # Of the time of an update, which it does not tell, a millisecond is 0.1 mm.
    assert np.median(off_mm) < 0.1


def test_hello_xr_draws_as_ever(runtime: Machine) -> None:
    said = runtime.start("timeout", "8", "hello_xr", "-g", "Vulkan2").communicate(timeout=60)[0]
    assert "llvmpipe" in said
    assert "Creating swapchain for view 1" in said
    assert not re.search(r"\[Error", said), said[-2000:]


def test_the_validation_layer_has_nothing_to_say(runtime: Machine) -> None:
    with hand_written(runtime):
        name = "XR_APILAYER_LUNARG_core_validation"
        program = Program(runtime, XR_ENABLE_API_LAYERS=name, XR_LOADER_DEBUG="all")
        for space in ("STAGE", "LOCAL", "VIEW"):
            assert program.locate(space=space)["active"]
        said = program.end()
        assert name in said, "the validation layer was not there"
        assert "VALID_ERROR" not in said, said[-3000:]
        assert "VALID_WARN" not in said, said[-3000:]


SANITIZED = {"thread": ("-fsanitize=thread", "-Wno-tsan"), "address": ("-fsanitize=address,undefined",), "": ()}


@pytest.mark.parametrize("sanitizer", SANITIZED)
def test_a_million_calls_beside_a_bridge_that_dies_at_random(
    machine: Machine, sanitizer: str, record_property: Callable[[str, object], None]
) -> None:
    flags = ("-std=c11", "-g", "-Wall", "-Werror", *SANITIZED[sanitizer], "-Wl,--wrap=malloc,--wrap=calloc")
    machine.run("cc", "-O1" if sanitizer else "-O2", *flags, "/rhot/hammer.c", "-o", "/rhot/hammer", "-lm", "-pthread")
    said = machine.run("/rhot/hammer", "500000")
    assert "SUMMARY" not in said
    figures = dict(zip(said.split()[::2], map(float, said.split()[1::2]), strict=True))
    assert figures["calls"] == 1_000_000
    assert figures["tracked"] > 100_000
    assert figures["torn"] == figures["allocations"] == 0
    if not sanitizer:
        record_property("xrLocateHandJointsEXT, median", f"{figures['median_us']} us, p99 {figures['p99_us']} us")
        assert figures["median_us"] < 5.0


def test_the_layer_knows_no_locks(machine: Machine) -> None:
    wanted = machine.run("nm", "-D", "--undefined-only", f"/rhot/{LIBRARY}")
    assert "mmap" in wanted
    assert not re.search(r"mutex|cond_|sem_|futex|printf\b(?<!snprintf)", wanted), wanted


@contextlib.asynccontextmanager
async def running(machine: Machine, *commands: Sequence[object]) -> AsyncIterator[list[asyncio.subprocess.Process]]:
    """Commands of ours, beside each other; the bridge among them writes the machine's memory."""
    variables = {**os.environ, "RHOT_HANDS": str(machine.memory)}
    children = [
        await asyncio.create_subprocess_exec(sys.executable, "-m", "rhot", *map(str, command), env=variables)
        for command in commands
    ]
    try:
        yield children
    finally:
        for child in children:
            with contextlib.suppress(ProcessLookupError):
                child.terminate()
        for child in children:
            await child.wait()


async def test_a_program_shows_the_hand_of_the_rig(
    runtime: Machine, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """From the cameras' pictures of the simulated rig to a program, against the bus."""
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    rig = tmp_path / "rig"
    rig.mkdir()
    write_simulated_rig(rig, endpoint=endpoint, rate_hz=30.0)
    text = (rig / RIG_FILE).read_text()
    (rig / RIG_FILE).write_text(text.replace("[sim]\n", '[sim]\nmotion = "still"\n'))
    draw = ["sim", "--rig", rig, "--duration", "60", "--no-viewer", "--listen", endpoint]
    async with running(runtime, draw, ["bridge", "openxr", "--rig", rig]):
        stage = load_rig(rig).stage
        assert stage is not None
        T_stage_rig = inverse(stage.T_rig_stage.matrix)
        async with await Bus.open(BusConfig(connect=(endpoint,)), timeout_s=20.0) as bus:
            await next_message(bus, "rhot/hand/right", HandPose, lambda _: True)
            program = await asyncio.to_thread(Program, runtime)
            await asyncio.to_thread(program.until, True, 10.0)
            off_mm = []
            for _ in range(30):
                hand = await next_message(bus, "rhot/hand/right", HandPose, lambda _: True)
                # At the time of the sample itself, for which nothing is predicted.
                ahead_ms = (hand.t_ns - time.time_ns()) / 1e6
                found = await asyncio.to_thread(program.locate, "right", "STAGE", ahead_ms)
                assert found["active"]
                assert isinstance(hand, HandPose)
                joints = np.array([hand.joints[name].position for name in JOINTS])
                wanted = joints @ T_stage_rig[:3, :3].T + T_stage_rig[:3, 3]
                off_mm.append(1e3 * np.linalg.norm(np.array(found["positions"]) - wanted, axis=1).max())
        program.end()
    record_property("program against bus, worst joint", f"median {np.median(off_mm):.3f} mm")
    assert np.median(off_mm) < 0.1


async def test_a_program_has_a_sample_as_soon_as_a_reader_of_the_bus(
    runtime: Machine, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """Hands are played back, so that nothing draws beside them: cameras are not on the machine of the headset."""
    endpoint, recording = free_endpoint("tcp/127.0.0.1:0"), tmp_path / "hand.mcap"
    rig = tmp_path / "rig"
    rig.mkdir()
    write_simulated_rig(rig, endpoint=endpoint)
    draw = ["sim", "--rig", rig, "--duration", "12", "--no-viewer", "--listen", endpoint]
    async with running(runtime, draw, ["record", "--rig", rig, "--out", recording, "--duration", "8"]) as children:
        for child in children:
            await child.wait()
    play = ["replay", recording, "--rig", rig, "--only", "hand", "--only", "space", "--now", "--loop"]
    async with (
        running(runtime, ["router", "--rig", rig], ["bridge", "openxr", "--rig", rig], play),
        await Bus.open(BusConfig(connect=(endpoint,)), timeout_s=20.0) as bus,
    ):
        await next_message(bus, "rhot/hand/right", HandPose, lambda _: True)
        program = await asyncio.to_thread(Program, runtime)
        await asyncio.to_thread(program.until, True, 10.0)
        later_ms = await _later_than_the_bus(bus, program)
        program.end()
    assert len(later_ms) > 100
    said = f"median {np.median(later_ms):.2f} ms, p99 {np.percentile(later_ms, 99):.2f} ms of {len(later_ms)} samples"
    record_property("program later than a reader of the bus", said)
    assert np.median(later_ms) < 2.0


async def _later_than_the_bus(bus: Bus, program: Program, seconds: float = 15.0) -> FloatArray:
    """Return by how much later than here each sample of the right hand was in a program, ms."""
    here_ns: list[int] = []

    async def read() -> None:
        hands = bus.latest("rhot/hand/right").messages(HandPose)
        async for _ in hands:
            here_ns.append(time.monotonic_ns())  # noqa: PERF401  # it ends by being cancelled

    reading = asyncio.ensure_future(read())
    followed = await asyncio.to_thread(program.ask, "follow", side="right", seconds=seconds)
    reading.cancel()
    there, here = np.array(followed["came_ns"]), np.array(here_ns)
    nearest = np.abs(there[:, None] - here).argmin(axis=1)
    return np.asarray((there - here[nearest]) / 1e6)
