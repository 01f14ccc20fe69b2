"""How cost grows with markers, cameras, hands and frame rate."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Final

import numpy as np

from rhot.anatomy.markers import own_paints
from rhot.bus import Bus, EventSubscriber, Publisher
from rhot.messages import Marker, MarkerFrame, Side
from rhot.operation.supervisor import Supervisor
from rhot.rig import BusConfig, Rig, load_rig, write_json_model
from rhot.rig.colors import load_colors
from rhot.rig.folder import CAMERAS_FILE, RIG_FILE, load_config, write_text_atomic
from rhot.rig.template import rig_template
from rhot.rig.toml_edit import change_rig_file
from rhot_bench.speed.cores import MICRO, MILLI, Advance, SpeedScene, points_of
from rhot_bench.speed.interleaved import lockstep
from rhot_bench.speed.simulated import projected_frames, with_cameras, with_rate, world_of
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_fusion.core import FusionCore
from rhot_ik.hand_core import HandCore
from rhot_sim.rig.calibration import simulated_rig_calibration
from rhot_sim.rig.folder import CAMERA_NAMES
from rhot_sim.running.processes import free_endpoint
from rhot_tools.keys.making import make_keys
from rhot_tools.measures.rows import Row, Section

# What a secured bus costs: the same messages over plain TCP and over TLS with access control, in turns.

_RATE_HZ: Final = 180.0
"""Two cameras at 90 Hz."""
_LIMIT_S: Final = 20.0


def secured_section(seconds: float) -> Section:
    """Measure from `put` to the reader's callback: publisher, router and reader on this machine, router on its own."""
    plain_ms, secured_ms = asyncio.run(_measured(seconds))
    added = float(np.median(secured_ms) - np.median(plain_ms))
    rows = [
        Row(f"{name}, {share}", float(np.percentile(times_ms, percent)), "ms")
        for name, times_ms in (("plain TCP", plain_ms), ("TLS, certificates, access control", secured_ms))
        for share, percent in (("p50", 50), ("p99", 99))
    ]
    note = f"{len(plain_ms)} messages each, in turns"
    most_added_ms = 0.5
    rows.append(Row("added to the median", added, "ms", most=most_added_ms, note=note))
    return Section(f"A secured bus: latency of markers at {_RATE_HZ:g} Hz", tuple(rows))


async def _measured(seconds: float) -> tuple[list[float], list[float]]:
    supervisor = Supervisor()
    with tempfile.TemporaryDirectory(prefix="rhot-bench-") as folder:
        links: list[_Link] = []
        try:
            async with AsyncExitStack() as stack:
                for secured in (False, True):
                    rig = _rig(Path(folder) / str(secured), secured)
                    await supervisor.start(f"router {secured}", ["-q", "router", "--rig", str(rig)])
                    links.append(await _Link.open(stack, load_config(rig).bus))
                begun = time.perf_counter()
                for number in range(round(seconds * _RATE_HZ)):
                    for link in links:
                        await link.send(number)
                    await asyncio.sleep(max(0.0, begun + (number + 1) / _RATE_HZ - time.perf_counter()))
        finally:
            await supervisor.stop()
    warm_up = 100
    plain, secured_times = (link.times_ms[warm_up:] for link in links)
    return plain, secured_times


def _rig(folder: Path, secured: bool) -> Path:
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    folder.mkdir()
    (folder / RIG_FILE).write_text(
        rig_template(folder="rig", name="bench", connect=(endpoint,), listen=(endpoint,)), encoding="utf-8"
    )
    if secured:
        make_keys(folder, ["127.0.0.1"], int(endpoint.rpartition(":")[2]))
        change_rig_file(folder, {("bus",): {"listen": [endpoint.replace("tcp/", "tls/")]}})
    return folder


class _Link:
    """A publisher and a reader of one router."""

    def __init__(self, publisher: Publisher[MarkerFrame], mailbox: EventSubscriber) -> None:
        self._publisher = publisher
        self._mailbox = mailbox
        self.times_ms: list[float] = []

    @classmethod
    async def open(cls, stack: AsyncExitStack, bus: BusConfig) -> _Link:
        async def session(identity: str) -> Bus:
            config = bus.model_copy(update={"identity": identity, "listen": ()})
            return await stack.enter_async_context(await Bus.open(config, timeout_s=_LIMIT_S))

        sender, reader = await session("camera-left"), await session("services")
        mailbox = reader.events("rhot/markers/*")
        publisher = sender.publisher("rhot/markers/left", MarkerFrame)
        await publisher.wait_for_reader(_LIMIT_S)
        return cls(publisher, mailbox)

    async def send(self, number: int) -> None:
        markers = {f"marker{each}": Marker(u=100.5, v=200.25, area=150.0, score=0.9) for each in range(6)}
        frame = MarkerFrame(t_ns=time.time_ns(), camera="left", width=640, height=480, markers=markers, frame=number)
        begun_ns = time.monotonic_ns()
        self._publisher.put(frame)
        async with asyncio.timeout(_LIMIT_S):
            sample = await self._mailbox.next()
        self.times_ms.append((sample.arrived_ns - begun_ns) / 1e6)


CAMERA_COUNTS: Final = (2, 4, 8)
_SIDES: Final[tuple[Side, ...]] = ("right", "left")
RATES_HZ: Final = (30.0, 60.0, 90.0, 120.0)
SLACK: Final = 1.1
"""An exponent up to here counts as linear: two runs of the same differ by as much."""


def bare_rig(folder: Path, cameras: int, hands: int) -> Rig:
    """Write a simulated rig without colours, for what comes after capture, and return it loaded."""
    names = CAMERA_NAMES[:cameras]
    text = rig_template(
        folder=str(folder),
        name="simulated",
        cameras=names,
        camera_xs_m=[0.075 * index for index in range(cameras)],
        source="simulated",
        rate_hz=60.0,
        exposure_s=0.006,
        readout_s=0.012,
        sides=_SIDES[:hands],
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_text_atomic(folder / RIG_FILE, text)
    configs = load_rig(folder).config.cameras
    write_json_model(folder / CAMERAS_FILE, simulated_rig_calibration(configs, 1).found)
    return load_rig(folder)


def capture_growth(scene: SpeedScene) -> tuple[Row, ...]:
    """Return the cost of a frame for one, three and all markers."""
    names = list(own_paints(scene.rig.config.markers))
    colors = load_colors(scene.rig.colors_path)
    camera = next(iter(scene.rig.config.cameras.values()))
    counts = sorted({1, (len(names) + 1) // 2, len(names)})
    ways = {}
    for count in counts:
        chosen = {name: scene.rig.config.markers[name] for name in names[:count]}
        detector = MarkerDetector(chosen, build_color_table(colors, list(chosen)), camera.width, camera.height)
        ways[f"{count} markers"] = detector.detect
    spreads = lockstep(ways, dict.fromkeys(ways, scene.pictures))
    rows = [Row(f"capture, {name}, a frame", spread.median * MILLI, "ms") for name, spread in spreads.items()]
    medians = [spread.median for spread in spreads.values()]
    rows.append(growth_row("capture, a frame grows as markers to the power", counts, medians))
    return tuple(rows)


def camera_growth(folder: Path, seconds: float, advance: Advance) -> tuple[Row, ...]:
    """Return the cost of fusion and ik of one and of two hands as cameras are added, and as they go faster."""
    rigs: dict[tuple[int, int], Rig] = {}
    for hands in (1, 2):
        whole = bare_rig(folder / f"hands{hands}", max(CAMERA_COUNTS), hands)
        rigs |= {(count, hands): with_cameras(whole, count) for count in CAMERA_COUNTS}
    frames = {
        f"{count} cameras, {6 * hands} markers": _frames(rig, seconds, count) for (count, hands), rig in rigs.items()
    }
    named = dict(zip(frames, rigs.values(), strict=True))
    advance()
    fusion = lockstep({name: FusionCore(rig).feed for name, rig in named.items()}, frames, 4 * max(CAMERA_COUNTS))
    advance()
    sets = {name: points_of(FusionCore(rig), frames[name]) for name, rig in named.items()}
    ik = lockstep({name: HandCore(rig).feed for name, rig in named.items()}, sets)
    advance()
    rows = [Row(f"fusion, {name}, a camera frame", spread.median * MICRO, "µs") for name, spread in fusion.items()]
    rows += [Row(f"ik, {name}, a point set", spread.median * MICRO, "µs") for name, spread in ik.items()]
    medians = dict(zip(rigs, (spread.median for spread in fusion.values()), strict=True))
    for hands in (1, 2):
        a_period = [count * medians[count, hands] for count in CAMERA_COUNTS]
        name = f"fusion, {6 * hands} markers, a second grows as cameras to the power"
        rows.append(growth_row(name, CAMERA_COUNTS, a_period))
    rows.append(
        growth_row("fusion, a camera frame grows as markers to the power", (6, 12), [medians[2, 1], medians[2, 2]])
    )
    ik_medians = [spread.median for spread in ik.values()]
    by_hands = [ik_medians[0], ik_medians[len(CAMERA_COUNTS)]]
    rows.append(growth_row("ik, a point set grows as hands to the power", (1, 2), by_hands))
    return (*rows, *rate_growth(rigs[2, 1], seconds, advance))


def rate_growth(rig: Rig, seconds: float, advance: Advance) -> tuple[Row, ...]:
    """Return the cost of fusion as two cameras go faster."""
    rigs = {f"{rate_hz:g} Hz": with_rate(rig, rate_hz) for rate_hz in RATES_HZ}
    frames = {name: _frames(some, seconds * 60.0 / float(name.split()[0]), 2) for name, some in rigs.items()}
    spreads = lockstep({name: FusionCore(some).feed for name, some in rigs.items()}, frames)
    advance()
    rows = [Row(f"fusion, 2 cameras at {name}, a camera frame", s.median * MICRO, "µs") for name, s in spreads.items()]
    a_second = [spread.median * rate_hz for spread, rate_hz in zip(spreads.values(), RATES_HZ, strict=True)]
    return (*rows, growth_row("fusion, a second grows as frame rate to the power", RATES_HZ, a_second))


def _frames(rig: Rig, seconds: float, cameras: int) -> list[MarkerFrame]:
    """Return about as many frames for any number of cameras."""
    span_s = max(seconds * 2 / cameras, 0.25)
    return list(projected_frames(rig, world_of(rig), 0.5, 0.5 + span_s))


def growth_row(name: str, sizes: Sequence[float], costs: Sequence[float]) -> Row:
    """Return the slope of the logarithm of the cost over that of the size; at most 1 is linear or better."""
    slope = float(np.polyfit(np.log(np.array(sizes, dtype=np.float64)), np.log(np.array(costs)), 1)[0])
    return Row(name, slope, most=SLACK, note=f"1 is linear; up to {SLACK:g} for noise of the measurement")


def scaling_section(scene: SpeedScene, seconds: float, advance: Advance) -> Section:
    """Return the table of growth."""
    with tempfile.TemporaryDirectory(prefix="rhot-bench-") as folder:
        rows = (*capture_growth(scene), *camera_growth(Path(folder), seconds, advance))
    return Section("How cost grows (processor time)", rows)


def scaling_steps() -> int:
    """Return how often `advance` is called by `scaling_section`."""
    return 4
