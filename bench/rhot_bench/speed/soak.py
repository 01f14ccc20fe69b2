"""Hours of a running rig: what its processes hold, how late its hand is and what gets lost, minute by minute.

Router, fusion and ik are the real processes; the cameras are played (`played_camera`), so that two cores are enough.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Final

import numpy as np

from rhot.bus import Bus, EventSubscriber
from rhot.errors import RhotError, WireError
from rhot.messages import HandPose, MarkerFrame, Message, PointSet, decode
from rhot.operation.control import broadcast
from rhot.operation.status import fetch_status
from rhot.operation.supervisor import Supervisor
from rhot.rig import BusConfig
from rhot.rig.folder import write_text_atomic
from rhot_bench.speed.played_camera import write_played_rig
from rhot_bench.speed.process_costs import ForeignLoad, ProcessCost, process_cost
from rhot_sim.running.processes import free_endpoint
from rhot_tools.measures.rows import Row, Section

_ENDPOINT: Final = "tcp/127.0.0.1:7467"
_UP_LIMIT_S: Final = 60.0
_RATE_HZ: Final = 60.0
SAMPLE_S: Final = 60.0
WARM_UP_S: Final = 120.0
"""Left out of the comparison: buffers fill, allocators find their size; chosen."""
WINDOW_S: Final = 600.0
"""What the first and the last figures are taken from; a quarter of the whole where that is less."""
MEMORY_GROWTH: Final = 0.05
P99_GROWTH: Final = 0.10
_BUSY: Final = "where this is over 0.3 of two processors, the ages tell of the machine and not of the tracker"
PLAYER: Final = "rhot_bench.speed.played_camera"
SERVICES: Final = ("capture/left", "capture/right", "fusion/main", "ik/main")
_MODELS: Final[dict[str, type[Message]]] = {
    "rhot/markers/left": MarkerFrame,
    "rhot/markers/right": MarkerFrame,
    "rhot/points": PointSet,
    "rhot/hand/right": HandPose,
}


@dataclass(frozen=True, slots=True)
class SoakSample:
    """One stretch of the soak.

    Attributes:
        at_s: its end, seconds from the start.
        processes: by name, what each holds at that end.
        hands: hand poses that arrived.
        p50_ms, p99_ms, max_ms: age of the hand at the reader, milliseconds; NaN without any.
        lost: messages that the numbering of each key misses.
        counts: what the services counted since their start, by `service: count`.
        others: processors that others kept busy meanwhile; they make the ages, not the memory.
    """

    at_s: float
    processes: dict[str, ProcessCost]
    hands: int
    p50_ms: float
    p99_ms: float
    max_ms: float
    lost: dict[str, int]
    counts: dict[str, int]
    others: float


@dataclass(slots=True)
class _Reader:
    """Listens as a program that uses the hand would, and counts."""

    ages_ms: list[float] = field(default_factory=list)
    lost: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_MODELS, 0))
    _seq: dict[str, int] = field(default_factory=dict)

    async def read(self, key: str, mailbox: EventSubscriber) -> None:
        async for sample in mailbox:
            try:
                message = decode(sample.payload, _MODELS[key])
            except WireError:
                self.lost[key] += 1
                continue
            self.lost[key] += max(0, message.seq - self._seq.get(key, message.seq - 1) - 1)
            self._seq[key] = message.seq
            if isinstance(message, HandPose):
                waited_ns = time.monotonic_ns() - sample.arrived_ns
                self.ages_ms.append((time.time_ns() - waited_ns - message.t_ns) / 1e6)

    def take_ages(self) -> list[float]:
        taken, self.ages_ms = self.ages_ms, []
        return taken


def soak_section(hours: float, json_path: Path | None, say: Callable[[str], None]) -> Section:
    """Run a rig for hours, or until Ctrl-C, and return its figures.

    Args:
        hours: how long.
        json_path: all samples so far are written beside this file each minute, as `NAME.samples.json`; None = nowhere.
        say: told of each sample, one line.

    Raises:
        RhotError: a process did not come up, or ended by itself.
    """
    with tempfile.TemporaryDirectory(prefix="rhot-soak-") as folder:
        samples = asyncio.run(_soak(Path(folder), hours * 3600.0, json_path, say))
    return Section(f"Soak: two played cameras at {_RATE_HZ:g} Hz, {_length(samples)}", soak_rows(samples))


async def _soak(folder: Path, seconds: float, json_path: Path | None, say: Callable[[str], None]) -> list[SoakSample]:
    endpoint = free_endpoint(_ENDPOINT)
    write_played_rig(folder / "rig", endpoint, _RATE_HZ)
    rig = ["--rig", str(folder / "rig")]
    supervisor = Supervisor(folder)
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    samples: list[SoakSample] = []
    try:
        await supervisor.start("router", ["router", *rig])
        for name in ("fusion", "ik"):
            await supervisor.start(name, [name, *rig])
        for camera in ("left", "right"):
            await supervisor.start(f"capture {camera}", ["--camera", camera, *rig], module=PLAYER)
        failed = asyncio.create_task(supervisor.wait_for_failure())
        async with await Bus.open(BusConfig(connect=(endpoint,)), timeout_s=_UP_LIMIT_S) as bus:
            reader = _Reader()
            reading = [asyncio.create_task(reader.read(key, bus.events(key))) for key in _MODELS]
            await _started(bus)
            begun, load = time.monotonic(), ForeignLoad()
            while not stopped.is_set() and time.monotonic() - begun < seconds:
                due_s = min(begun + SAMPLE_S * (len(samples) + 1), begun + seconds) - time.monotonic()
                asked = asyncio.create_task(stopped.wait())
                await asyncio.wait((asked, failed), timeout=max(due_s, 0.0), return_when=asyncio.FIRST_COMPLETED)
                asked.cancel()
                if failed.done():
                    raise supervisor.failure(failed.result())
                samples.append(await _sample(time.monotonic() - begun, supervisor, reader, bus, load))
                say(_line(samples[-1]))
                if json_path is not None:
                    _write(json_path.with_suffix(".samples.json"), samples)
            for task in (*reading, failed):
                task.cancel()
            await asyncio.gather(*reading, failed, return_exceptions=True)
    finally:
        await supervisor.stop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.remove_signal_handler(number)
    return samples


async def _started(bus: Bus) -> None:
    deadline = time.monotonic() + _UP_LIMIT_S
    while not set(SERVICES) <= (await fetch_status(bus, timeout_s=0.5))[0]:
        if time.monotonic() > deadline:
            raise RhotError(f"the rig did not come up within {_UP_LIMIT_S:.0f} s; is this machine busy?")
        await asyncio.sleep(0.2)
    await broadcast(bus, "start", "soak", 0.5, wait_s=10.0)


async def _sample(at_s: float, supervisor: Supervisor, reader: _Reader, bus: Bus, load: ForeignLoad) -> SoakSample:
    ages = np.array(reader.take_ages())
    _, statuses = await fetch_status(bus)
    pids = {child.name: child.process.pid for child in supervisor.children} | {"reader": os.getpid()}
    costs = {name: cost for name, pid in pids.items() if (cost := process_cost(pid)) is not None}
    p50, p99, most = np.percentile(ages, (50, 99, 100)).tolist() if len(ages) else [float("nan")] * 3
    counts = {f"{name}: {what}": number for name, status in statuses.items() for what, number in status.counts.items()}
    others = load.since_last(sum(cost.cpu_s for cost in costs.values()))
    return SoakSample(at_s, costs, len(ages), p50, p99, most, dict(reader.lost), counts, others)


def _line(sample: SoakSample) -> str:
    memory_mb = sum(cost.pss_mb for cost in sample.processes.values())
    lost = sum(sample.lost.values())
    return (
        f"{sample.at_s / 60.0:.0f} min: {sample.hands} hands, p50 {sample.p50_ms:.2f} ms, p99 {sample.p99_ms:.2f} ms, "
        f"{memory_mb:.1f} MB in all, {lost} lost so far, others kept {sample.others:.1f} processors busy"
    )


def _write(file: Path, samples: list[SoakSample]) -> None:
    document = {"version": 1, "samples": [_finite(asdict(sample)) for sample in samples]}
    write_text_atomic(file, json.dumps(document, allow_nan=False) + "\n")


def _finite(values: dict[str, object]) -> dict[str, object]:
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}


def _length(samples: list[SoakSample]) -> str:
    minutes = samples[-1].at_s / 60.0 if samples else 0.0
    return f"{minutes / 60.0:.2f} h" if minutes >= 60.0 else f"{minutes:.1f} min"


def _median(samples: list[SoakSample], figure: str) -> float:
    return float(median(getattr(sample, figure) for sample in samples)) if samples else float("nan")


def soak_rows(samples: list[SoakSample]) -> tuple[Row, ...]:
    """Return what became of memory, descriptors, threads and latency from the first stretch to the last."""
    warm = [sample for sample in samples if sample.at_s > WARM_UP_S] or samples
    if not warm:
        return (Row("samples", 0.0, least=1.0, note="ended before the first"),)
    window_s = min(WINDOW_S, 0.25 * (warm[-1].at_s - warm[0].at_s))
    first = [sample for sample in warm if sample.at_s <= warm[0].at_s + window_s]
    last = [sample for sample in warm if sample.at_s >= warm[-1].at_s - window_s and sample not in first]
    note = f"medians of {len(first)} and {len(last)} samples at the two ends, after a warm-up of {WARM_UP_S:.0f} s"
    rows: list[Row] = []
    for name in warm[-1].processes:

        def of(part: list[SoakSample], figure: str, name: str = name) -> float:
            found = [getattr(sample.processes[name], figure) for sample in part if name in sample.processes]
            return float(median(found)) if found else float("nan")

        growth = of(last, "rss_mb") / of(first, "rss_mb") - 1.0
        rows += [
            Row(f"{name}, memory (RSS) at the end", of(last, "rss_mb"), "MB"),
            Row(f"{name}, memory (PSS) at the end", of(last, "pss_mb"), "MB"),
            Row(f"{name}, growth of memory (RSS)", 100.0 * growth, "%", most=100.0 * MEMORY_GROWTH, note=note),
            Row(f"{name}, descriptors more", of(last, "descriptors") - of(first, "descriptors"), most=0.0, note=note),
            Row(f"{name}, threads more", of(last, "threads") - of(first, "threads"), most=0.0, note=note),
        ]
    before, after = _median(first, "p99_ms"), _median(last, "p99_ms")
    rows += [
        Row("age of the hand, p50, first", _median(first, "p50_ms"), "ms", note=note),
        Row("age of the hand, p50, last", _median(last, "p50_ms"), "ms", note=note),
        Row("age of the hand, p99, first", before, "ms", note=note),
        Row("age of the hand, p99, last", after, "ms", most=before * (1.0 + P99_GROWTH), note=note),
        Row("processors that others kept busy, first", _median(first, "others"), note=_BUSY),
        Row("processors that others kept busy, last", _median(last, "others"), note=_BUSY),
        Row("hands a second", sum(sample.hands for sample in samples) / samples[-1].at_s, "Hz"),
    ]
    rows += [Row(f"{key}, lost on the way", float(number), most=0.0) for key, number in samples[-1].lost.items()]
    return tuple(rows)
