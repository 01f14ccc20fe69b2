"""What a process holds at a moment: memory, file descriptors, threads, processor time."""

from __future__ import annotations

import asyncio
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rhot.bus import Bus
from rhot.errors import RhotError
from rhot.operation.control import broadcast
from rhot.operation.supervisor import Supervisor
from rhot.rig import BusConfig, Rig
from rhot_sim.running.processes import bus_of, free_endpoint, service_commands
from rhot_tools.measures.rows import Row, Section

# What each service costs as a process: start-up time and memory.

_ENDPOINT: Final = "tcp/127.0.0.1:7457"
_UP_LIMIT_S: Final = 30.0
_POLL_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class ServiceCost:
    """One service process.

    Attributes:
        name: on the bus.
        start_s: from starting the process until it announces itself.
        memory_mb: resident memory after some seconds of work, megabytes.
    """

    name: str
    start_s: float
    memory_mb: float


def processes_section(rig: Rig) -> Section:
    """Start each service of a simulated rig in turn, let all work, and return start-up times and memory."""
    with tempfile.TemporaryDirectory(prefix="rhot-bench-") as folder:
        costs = asyncio.run(_measured(rig, Path(folder)))
    rows = [Row(f"{cost.name}, start-up", cost.start_s, "s") for cost in costs]
    rows += [
        Row(f"{cost.name}, memory", cost.memory_mb, "MB", note="without the renderer" if "capture" in cost.name else "")
        for cost in costs
    ]
    return Section("Services: start-up and resident memory", tuple(rows))


async def _measured(rig: Rig, logs: Path) -> list[ServiceCost]:
    endpoint = free_endpoint(_ENDPOINT)
    supervisor = Supervisor(logs)
    started: dict[str, tuple[float, int]] = {}
    router = BusConfig(mode="router", connect=(), listen=(endpoint,))
    try:
        async with await Bus.open(router), await Bus.open(bus_of(rig, endpoint)) as bus:
            for name, arguments in service_commands(rig, endpoint, ["fusion", "ik", "objects"]).items():
                began = time.perf_counter()
                child = await supervisor.start(name.replace("/", " "), arguments)
                while f"rhot/alive/{name}" not in {reply.key for reply in await bus.who_is_alive(timeout_s=_POLL_S)}:
                    if child.process.returncode is not None:
                        raise supervisor.failure(child)
                    if time.perf_counter() - began > _UP_LIMIT_S:
                        raise RhotError(f"{name} did not come up within {_UP_LIMIT_S:.0f} s; is this machine busy?")
                    await asyncio.sleep(_POLL_S)
                started[name] = (time.perf_counter() - began, child.process.pid)
            await broadcast(bus, "start", "bench", 1.0, wait_s=5.0)
            work_s = 3.0
            await asyncio.sleep(work_s)
            costs = [ServiceCost(name, start_s, _resident_mb(pid)) for name, (start_s, pid) in started.items()]
            await broadcast(bus, "stop", "bench", 0.0, wait_s=5.0)
            return costs
    finally:
        await supervisor.stop()


def _resident_mb(pid: int) -> float:
    """Return the resident memory of a process, megabytes; NaN where the system does not tell."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return float("nan")
    found = [line.split()[1] for line in lines if line.startswith("VmRSS:")]
    return float(found[0]) / 1000.0 if found else float("nan")


if sys.platform == "win32":
    _TICK_S: Final = 0.01  # of nothing: there is no /proc to read
else:
    _TICK_S: Final = 1.0 / os.sysconf("SC_CLK_TCK")
_MEGA: Final = 1e-3
"""The kernel counts in kilobytes."""


@dataclass(frozen=True, slots=True)
class ProcessCost:
    """One process at one moment.

    Attributes:
        rss_mb: resident memory, megabytes.
        pss_mb: the same with shared pages divided by those who share them.
        descriptors: open files, sockets, pipes.
        threads: of the process.
        cpu_s: processor time since its start.
    """

    rss_mb: float
    pss_mb: float
    descriptors: int
    threads: int
    cpu_s: float


def process_cost(pid: int) -> ProcessCost | None:
    """Return what a process holds now; None when it has ended."""
    folder = Path(f"/proc/{pid}")
    try:
        status = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines() if ":" in line)
        memory = dict(line.split(":", 1) for line in (folder / "smaps_rollup").read_text().splitlines()[1:])
        words = (folder / "stat").read_text().rpartition(")")[2].split()
        descriptors = len(list((folder / "fd").iterdir()))
        return ProcessCost(
            rss_mb=int(status["VmRSS"].split()[0]) * _MEGA,
            pss_mb=int(memory["Pss"].split()[0]) * _MEGA,
            descriptors=descriptors,
            threads=int(status["Threads"]),
            cpu_s=(int(words[11]) + int(words[12])) * _TICK_S,
        )
    except (OSError, KeyError):  # it ended, between two of these files perhaps
        return None


class ForeignLoad:
    """How many processors others keep busy, from one look to the next."""

    def __init__(self) -> None:
        self._at_s, self._busy_s, self._own_s = time.monotonic(), _busy_s(), float("nan")

    def since_last(self, own_s: float) -> float:
        """Return the average since the last look; NaN at the first.

        Args:
            own_s: processor time that our processes have used since their start, seconds.
        """
        at_s, busy_s = time.monotonic(), _busy_s()
        others = (busy_s - self._busy_s - (own_s - self._own_s)) / max(at_s - self._at_s, 1e-3)
        self._at_s, self._busy_s, self._own_s = at_s, busy_s, own_s
        return others


def _busy_s() -> float:
    """Return the processor time that anything has used on this machine, and that its host took from it, seconds."""
    words = Path("/proc/stat").read_text(encoding="utf-8").splitlines()[0].split()
    user, nice, system, _, _, irq, softirq, steal = (int(word) for word in words[1:9])
    return (user + nice + system + irq + softirq + steal) * _TICK_S
