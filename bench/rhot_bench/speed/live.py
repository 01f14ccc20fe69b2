"""The whole system live, on recorded pictures: from a picture in memory to the hand at a reader.

The simulated rig's pictures are drawn beforehand and played, so that the latency is the tracker's own and not that of
the simulator, which draws on the same cores.
"""

from __future__ import annotations

import asyncio
import math
import shutil
import tempfile
import time
from bisect import bisect_right
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.bus import Bus
from rhot.messages import HandPose, MarkerFrame, ServiceStatus
from rhot.operation.control import broadcast
from rhot.rig import Rig, load_rig
from rhot.rig.toml_edit import change_rig_file
from rhot_sim.comparison.collect import follow
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.rig.schedule import FrameSchedule
from rhot_sim.running.processes import bus_of, free_endpoint, with_processes
from rhot_sim.world.world import World
from rhot_tools.measures.rows import Row, Section

_ENDPOINT: Final = "tcp/127.0.0.1:7457"
_TAKE_S: Final = 4.0
"""How much is drawn; the cameras play it over and over."""
_SETTLING_S: Final = 2.0
"""Left out at the start: processes warm up, clocks find each other."""
_JPEG_QUALITY: Final = 95
_PATIENCE_S: Final = 10.0
_SAME_MOMENT_NS: Final = 1_000_000
"""A point set's moment and that of its newest frame differ by less: markers have their rows' times, a set has one."""


@dataclass(slots=True)
class Arrivals:
    """What a reader on the bus saw.

    Attributes:
        frames: t_ns of a marker frame and when its picture was in memory, rig time.
        hands: t_ns of a hand and when it arrived, rig time.
        detect_s: time that finding the markers took, a frame.
        compute_s: median time that fusion and ik took for a message, as they stated it last, by service.
        invalid: messages that could not be read.
    """

    frames: list[tuple[int, int]] = field(default_factory=list)
    hands: list[tuple[int, int]] = field(default_factory=list)
    detect_s: list[float] = field(default_factory=list)
    compute_s: dict[str, float] = field(default_factory=dict)
    invalid: int = 0


def live_section(rig: Rig, seconds: float) -> Section:
    """Play a simulated rig's pictures to all services and return their latencies.

    Args:
        rig: simulated.
        seconds: how long to measure.

    Raises:
        RhotError: a service failed.
    """
    with tempfile.TemporaryDirectory(prefix="rhot-bench-") as folder:
        played = played_rig(rig, Path(folder))
        arrivals = asyncio.run(_measured(played, Path(folder), seconds))
    rate_hz = min(camera.rate_hz for camera in rig.config.cameras.values())
    title = f"Live: {len(rig.cameras)} cameras at {rate_hz:.0f} Hz play recorded pictures, {seconds:g} s"
    return Section(title, live_rows(arrivals, seconds, rate_hz))


def played_rig(rig: Rig, folder: Path) -> Rig:
    """Draw what each camera sees and return a rig whose cameras play these pictures over and over."""
    take = folder / "take"
    world = World.from_rig(rig)
    for number, (name, camera) in enumerate(rig.config.cameras.items()):
        pictures = take / name
        pictures.mkdir(parents=True)
        renderer = Renderer(true_cameras(rig)[name], world, rig.config.sim, camera, number)
        schedule = FrameSchedule(name, number, camera, rig.config.sim)
        rows = ["frame,t_ns"]
        for index in range(round(_TAKE_S * camera.rate_hz)):
            frame = schedule.frame(index)
            image = renderer.render(frame.t_first_row_s)
            cv2.imwrite(str(pictures / f"{index:06d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            rows.append(f"{index},{round(frame.t_first_row_s * 1e9)}")
        (pictures / "timestamps.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    path = folder / "rig"
    shutil.copytree(rig.path, path)
    change_rig_file(
        path,
        {
            ("cameras", name): {"source": "images", "path": str(take / name), "loop": True}
            for name in rig.config.cameras
        },
    )
    return load_rig(path)


async def _measured(rig: Rig, logs: Path, seconds: float) -> Arrivals:
    endpoint = free_endpoint(_ENDPOINT)
    arrivals = Arrivals()
    options = ["--rig", str(rig.path), "--connect", endpoint]
    services = {f"capture/{name}": ["capture", "--camera", name, *options] for name in rig.config.cameras}
    services |= {f"{name}/main": [name, *options] for name in ("fusion", "ik")}

    async def work(bus: Bus) -> None:
        await broadcast(bus, "start", "bench", 1.0, wait_s=_PATIENCE_S)
        try:
            async with reading(bus, arrivals):
                await asyncio.sleep(1.0 + _SETTLING_S + seconds)
        finally:
            await broadcast(bus, "stop", "bench", 0.0, wait_s=_PATIENCE_S)

    await with_processes(bus_of(rig, endpoint), services, logs, work)
    return arrivals


@asynccontextmanager
async def reading(bus: Bus, into: Arrivals) -> AsyncIterator[None]:
    """Note frames and hands in the meantime."""
    task = asyncio.create_task(_read(bus, into))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def _read(bus: Bus, into: Arrivals) -> None:
    """Note frames and hands until cancelled; the rig clock is this machine's, on which all services run."""

    def keep_frame(_: str, frame: MarkerFrame, __: float) -> None:
        into.frames.append((frame.t_ns, frame.t_ns + round(frame.timing.get("age", 0.0) * 1e9)))
        into.detect_s.append(frame.timing.get("detect", float("nan")))

    def keep_hand(_: str, hand: HandPose, age_s: float) -> None:
        into.hands.append((hand.t_ns, hand.t_ns + round(age_s * 1e9)))

    def keep_status(_: str, status: ServiceStatus, __: float) -> None:
        into.compute_s[status.service] = status.latency_s.get("compute", {}).get("p50", math.nan)

    def refuse() -> None:
        into.invalid += 1

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(follow(bus.events("rhot/markers/*"), MarkerFrame, time.time_ns, keep_frame, refuse))
        tasks.create_task(follow(bus.events("rhot/hand/*"), HandPose, time.time_ns, keep_hand, refuse))
        tasks.create_task(follow(bus.events("rhot/status/*/main"), ServiceStatus, time.time_ns, keep_status, refuse))


def latencies_s(frames: Sequence[tuple[int, int]], hands: Sequence[tuple[int, int]]) -> list[float]:
    """Return how long after its newest picture each hand arrived, seconds.

    A hand is true at a moment; the newest frame that is not later than it is the one that it waited for.

    Args:
        frames: t_ns and when the picture was in memory, ns.
        hands: t_ns and when it arrived, ns.
    """
    ordered = sorted(frames)
    moments = [t_ns for t_ns, _ in ordered]
    found = []
    for t_ns, arrived_ns in hands:
        newest = bisect_right(moments, t_ns + _SAME_MOMENT_NS) - 1
        if newest >= 0 and ordered[newest][1] <= arrived_ns:
            found.append((arrived_ns - ordered[newest][1]) * 1e-9)
    return found


def live_rows(arrivals: Arrivals, seconds: float, rate_hz: float) -> tuple[Row, ...]:
    """Return the rows of a measurement; what arrived while the services settled is left out."""
    begun_ns = min((t_ns for t_ns, _ in arrivals.frames), default=0) + round(_SETTLING_S * 1e9)
    hands = [hand for hand in arrivals.hands if hand[0] >= begun_ns]
    waits_ms = 1e3 * np.array(latencies_s(arrivals.frames, hands))

    def share(values: NDArray[np.float64], percent: float) -> float:
        return float(np.percentile(values, percent)) if values.size else float("nan")

    detect_ms = 1e3 * np.array(arrivals.detect_s)
    return (
        Row("picture in memory to hand at the reader, p50", share(waits_ms, 50.0), "ms", most=4.0),
        Row("picture in memory to hand at the reader, p99", share(waits_ms, 99.0), "ms", most=10.0),
        Row("work: finding the markers, p50", share(detect_ms, 50.0), "ms"),
        Row("work: finding the markers, p99", share(detect_ms, 99.0), "ms"),
        Row(
            "work: fusion, one camera's frame, p50",
            1e3 * arrivals.compute_s.get("fusion", math.nan),
            "ms",
            note="cameras in step: two of these in a row for each hand",
        ),
        Row(
            "work: ik, a hand, p50",
            1e3 * arrivals.compute_s.get("ik", math.nan),
            "ms",
            note="what is left of the latency: three messages over the bus, decoding and encoding",
        ),
        Row(
            "hand poses a second",
            len(hands) / seconds,
            "Hz",
            least=rate_hz,
            note="fewer than a camera's frames: this machine was too busy, and the latencies tell of that",
        ),
        Row("messages that could not be read", float(arrivals.invalid), most=0.0),
    )
