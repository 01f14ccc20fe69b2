"""What bridges cost: one process that sends everything a rig tracks to four other programs at once.

The poses are the simulated world's, put on a bus with a router of its own; the four programs are sockets of the
measuring process. From the bus to the wire is what the bridge itself measures, from the arrival of a pose on Zenoh's
thread to the return of the last `send`.
"""

from __future__ import annotations

import asyncio
import re
import socket
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.bus import Bus
from rhot.messages import (
    BodyJoint,
    BodyPose,
    Control,
    FootPose,
    HandPose,
    HeadPose,
    Joint,
    Message,
    ObjectPose,
    ServiceStatus,
    Side,
    Space,
    decode,
)
from rhot.operation.supervisor import Supervisor
from rhot.rig import BusConfig, Rig
from rhot.rig.folder import RIG_FILE
from rhot.rig.template import rig_template
from rhot.service.clock_sync import serve_clock
from rhot_bench.speed.process_costs import process_cost
from rhot_sim.running.processes import free_endpoint
from rhot_sim.world.world import World
from rhot_tools.measures.rows import Row, Section

_RATE_HZ: Final = 90.0
_TARGETS: Final = ("vmc", "vrchat", "vmt", "json")
_MOST_MS: Final = 1.0
_MOST_CORE: Final = 15.0
_LEAST_HZ: Final = 89.0
_LIMIT_S: Final = 30.0
_WARM_UP_S: Final = 2.0
_STAMP: Final = re.compile(rb'"t":([0-9.]+)')
_ROOT_ADDRESS: Final = {
    "vmc": b"/VMC/Ext/OK",
    "vrchat": b"trackers/1/position",
    "vmt": b"/VMT/Room/Driver\0\0\0\0,iifffffff",
    "json": b"",
}
"""What stands in exactly one packet of each frame."""
_HERE: Final = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
_UPRIGHT: Final = (0.0, 0.0, 0.0, 1.0)
_BODY: Final = (
    "hips",
    *(f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle", "foot")),
)


def bridges_section(rig: Rig, seconds: float) -> Section:
    """Measure each bridge by itself, then all four in one process."""
    rows: list[Row] = []
    for target in _TARGETS:
        alone = asyncio.run(_measured(rig, seconds / 4.0, (target,)))
        rows += [
            Row(f"from the bus to the wire, {target} alone, p50", alone.wire_ms(target, "p50"), "ms"),
            Row(f"from the bus to the wire, {target} alone, p99", alone.wire_ms(target, "p99"), "ms", most=_MOST_MS),
        ]
    four = asyncio.run(_measured(rig, seconds, _TARGETS))
    for target in _TARGETS:
        rows.append(Row(f"from the bus to the wire, {target} with the others, p99", four.wire_ms(target, "p99"), "ms"))
    rows += [Row(f"frames per second, {target}", four.rates[target], "Hz", least=_LEAST_HZ) for target in _TARGETS]
    note = "both hands, head, object, two feet, hips and legs, each at 90 Hz"
    rows.append(Row("processor time of all four together", four.core, "% of a core", most=_MOST_CORE, note=note))
    for share, percent in (("p50", 50), ("p99", 99)):
        value = float(np.percentile(four.through_ms, percent)) if four.through_ms else float("nan")
        rows.append(Row(f"from `put` to the other program, json, {share}", value, "ms", note="bus and router included"))
    return Section(f"Bridges: four programs at {_RATE_HZ:g} Hz", tuple(rows))


@dataclass(frozen=True, slots=True)
class _Measured:
    """One run.

    Attributes:
        wire: by target, percentiles from the arrival of a pose to its last packet, seconds.
        rates: frames per second that each program got.
        core: processor time of the bridges' process, percent of a core.
        through_ms: from `put` to the arrival of JSON, milliseconds.
    """

    wire: Mapping[str, Mapping[str, float]]
    rates: Mapping[str, float]
    core: float
    through_ms: list[float]

    def wire_ms(self, target: str, share: str) -> float:
        """Return a percentile from bus to wire, milliseconds."""
        return 1e3 * self.wire.get(target, {}).get(share, float("nan"))


class _Program:
    """One other program: a socket that counts frames, and notes when each stamp of JSON arrives."""

    def __init__(self, target: str) -> None:
        self._mark = _ROOT_ADDRESS[target]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.1)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, name=target)
        self.port = int(self._socket.getsockname()[1])
        self.frames = 0
        self.arrived_ns: dict[int, int] = {}

    def __enter__(self) -> _Program:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._socket.close()

    def _read(self) -> None:
        while not self._ended.is_set():
            try:
                packet = self._socket.recv(65536)
            except TimeoutError:
                continue
            now_ns = time.monotonic_ns()
            if self._mark in packet:
                self.frames += 1
                if (stamp := _STAMP.search(packet)) is not None:
                    self.arrived_ns.setdefault(round(float(stamp[1]) * 1e6), now_ns)


async def _measured(rig: Rig, seconds: float, targets: Sequence[str]) -> _Measured:
    supervisor = Supervisor()
    with tempfile.TemporaryDirectory(prefix="rhot-bench-") as folder, ExitStack() as stack:
        programs = {target: stack.enter_context(_Program(target)) for target in targets}
        path = Path(folder) / "rig"
        path.mkdir()
        endpoint = free_endpoint("tcp/127.0.0.1:0")
        text = rig_template(folder="rig", name="bench", connect=(endpoint,), listen=(endpoint,))
        for target, program in programs.items():
            text += f'\n[bridges.{target}]\ntarget = "{target}"\nport = {program.port}\n'
            text += 'transport = "udp"\n' if target == "json" else ""
        (path / RIG_FILE).write_text(text, encoding="utf-8")
        try:
            await supervisor.start("router", ["-q", "router", "--rig", str(path)])
            child = await supervisor.start("bridge", ["-q", "bridge", "--rig", str(path)])
            async with await Bus.open(BusConfig(connect=(endpoint,)), timeout_s=_LIMIT_S) as bus:
                return await _run(bus, child.process.pid, rig, programs, seconds)
        finally:
            await supervisor.stop()


async def _run(bus: Bus, pid: int, rig: Rig, programs: Mapping[str, _Program], seconds: float) -> _Measured:
    serve_clock(bus)
    bus.publisher("rhot/space/stage", Space).put(Space(t_ns=1, T_rig_space=_HERE, source="bench"))
    control = bus.publisher("rhot/control", Control, reliable=True)
    async with asyncio.timeout(_LIMIT_S):
        while len(await bus.who_is_alive("rhot/alive/bridge/*")) < len(programs):  # noqa: ASYNC110
            await asyncio.sleep(0.05)
    now_ns = time.time_ns()
    control.put(Control(t_ns=now_ns, action="start", session="bench", start_t_ns=now_ns))
    models = {side: HandModel.from_file(rig.hand, side) for side in _SIDES}
    frames = round((_WARM_UP_S + seconds) * _RATE_HZ)
    moments = [_messages(World(1, models, {}, ("cube",)), models, number / _RATE_HZ) for number in range(frames)]
    publishers = {key: bus.publisher(key, type(message)) for key, message in moments[0].items()}
    put_ns: dict[int, int] = {}
    begun = time.perf_counter()
    counted, used_s, since_s = dict.fromkeys(programs, 0), 0.0, begun
    for number, moment in enumerate(moments):
        if number == round(_WARM_UP_S * _RATE_HZ):
            counted = {target: program.frames for target, program in programs.items()}
            used_s, since_s = _cpu_s(pid), time.perf_counter()
        t_ns = time.time_ns()
        put_ns[round(t_ns / 1e3)] = time.monotonic_ns()
        for key, message in moment.items():
            publishers[key].put(message.model_copy(update={"t_ns": t_ns}))
        await asyncio.sleep(max(0.0, begun + (number + 1) / _RATE_HZ - time.perf_counter()))
    took_s = time.perf_counter() - since_s
    core = 100.0 * (_cpu_s(pid) - used_s) / took_s
    rates = {target: (program.frames - counted[target]) / took_s for target, program in programs.items()}
    statuses = await _statuses(bus)
    # Stamps are compared to a microsecond: JSON carries no more.
    arrived_ns = programs["json"].arrived_ns if "json" in programs else {}
    through_ms = [(at_ns - put_ns[stamp]) / 1e6 for stamp, at_ns in arrived_ns.items() if stamp in put_ns]
    wire = {target: status.latency_s.get("to_wire", {}) for target, status in statuses.items()}
    return _Measured(wire, rates, core, through_ms)


def _cpu_s(pid: int) -> float:
    cost = process_cost(pid)
    return float("nan") if cost is None else cost.cpu_s


async def _statuses(bus: Bus) -> dict[str, ServiceStatus]:
    # Published once a second: the one after the last frame.
    await asyncio.sleep(1.1)
    replies = await bus.get("rhot/status/bridge/*", timeout_s=_LIMIT_S)
    found = [decode(reply.payload, ServiceStatus) for reply in replies if not reply.error]
    return {status.instance: status for status in found}


_SIDES: Final[tuple[Side, Side]] = ("left", "right")


def _messages(world: World, models: Mapping[Side, HandModel], t_s: float) -> dict[str, Message]:
    truth = world.truth(t_s, 0)
    found: dict[str, Message] = {
        f"rhot/hand/{side}": HandPose(
            t_ns=0,
            side=side,
            frame="rig",
            joints={
                name: Joint(position=pose.position, orientation=pose.orientation, radius=float(radius))
                for (name, pose), radius in zip(truth.hands[side].items(), models[side].radii, strict=True)
            },
            angles={},
            residual={},
            state="measured",
        )
        for side in _SIDES
    }
    cube = truth.objects["cube"]
    found["rhot/object/cube"] = ObjectPose(
        t_ns=0, frame="rig", position=cube.position, orientation=cube.orientation, state="measured"
    )
    found["rhot/head"] = HeadPose(t_ns=0, frame="rig", position=(0.0, 1.6, 0.0), orientation=_UPRIGHT, state="measured")
    for side in _SIDES:
        found[f"rhot/foot/{side}"] = FootPose(
            t_ns=0,
            side=side,
            frame="rig",
            position=(0.1, 0.1, 0.0),
            orientation=_UPRIGHT,
            velocity=(0.0, 0.0, 0.0),
            sigma=0.01,
            stage="marker",
            state="measured",
        )
    joints = {name: BodyJoint(position=(0.0, 0.9, 0.0), orientation=_UPRIGHT) for name in _BODY}
    found["rhot/body"] = BodyPose(
        t_ns=0, frame="rig", joints=joints, angles={}, legs=dict.fromkeys(_SIDES, "measured"), state="measured"
    )
    return found
