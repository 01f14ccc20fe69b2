"""What open pages cost the tracker, and how long a pose takes from the bus to the picture that shows it.

Cameras play drawn pictures, all services run, and two windows of a browser open the page *Grasp* and close it again, in
turns with as long a time without them. The page itself measures how old a pose is when it is drawn; the viewer's status
passes that on.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import sys
import tempfile
import urllib.request
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rhot.bus import Bus
from rhot.errors import DeviceError
from rhot.messages import ServiceStatus, decode
from rhot.operation.control import broadcast
from rhot.rig import Rig
from rhot_bench.speed.live import Arrivals, latencies_s, played_rig, reading
from rhot_sim.running.processes import bus_of, free_endpoint, with_processes
from rhot_tools.measures.rows import Row, Section

BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome")
_PAGES: Final = 2
_ROUNDS: Final = 3
_SETTLING_S: Final = 4.0
"""Left out after a change: browsers compile what they draw with, processes and clocks warm up."""
_PATIENCE_S: Final = 60.0
_FLAGS: Final = (
    "--headless=new",
    "--enable-unsafe-swiftshader",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--mute-audio",
    "--window-size=1280,800",
)
_MOST_MS: Final = 4.0
"""Beside one picture's time."""


@dataclass(frozen=True, slots=True)
class Turn:
    """What the tracker did for a while.

    Attributes:
        pages: how many were open.
        seconds: how long.
        waits_ms: from a picture in memory to its hand at a reader.
        shown: status of the page's viewer at the end; None without pages.
    """

    pages: int
    seconds: float
    waits_ms: tuple[float, ...]
    shown: ServiceStatus | None


def pages_section(rig: Rig, seconds: float, rounds: int = _ROUNDS) -> Section:
    """Measure with and without two open pages, in turns.

    Args:
        rig: simulated.
        seconds: of each turn.
        rounds: turns without and with pages, each.

    Raises:
        DeviceError: there is no Chromium, or the page is not built.
        RhotError: a service failed.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise DeviceError(
            "--part page opens two windows of Chromium, and there is none on this machine: apt install chromium; with "
            "any other browser, open http://localhost:8081 and read what `rhot status` says of viewer/grasp"
        )
    with tempfile.TemporaryDirectory(prefix="rhot-bench-", ignore_cleanup_errors=True) as folder:
        played = played_rig(rig, Path(folder))
        turns = asyncio.run(_measured(played, Path(folder), browser, seconds, rounds))
    rate_hz = min(camera.rate_hz for camera in rig.config.cameras.values())
    rows = page_rows(turns, rate_hz)
    return Section(f"Page Grasp: {_PAGES} windows beside the tracker, {rounds} × {seconds:g} s", rows)


def page_rows(turns: Sequence[Turn], rate_hz: float) -> tuple[Row, ...]:
    """Return the rows of a measurement.

    Args:
        turns: without and with pages.
        rate_hz: of the cameras; where the tracker alone gives less than half of that, nothing is judged.
    """
    without, having = (_both([turn for turn in turns if bool(turn.pages) is wanted]) for wanted in (False, True))
    fewer = 100.0 * (1.0 - having[0] / without[0]) if without[0] else float("nan")
    later = 100.0 * (having[1] / without[1] - 1.0)
    shown = [turn.shown for turn in turns if turn.shown is not None]
    pictures_hz = _median([status.figures.get("pictures_hz", 0.0) or float("nan") for status in shown])
    card = all(status.figures.get("without_graphics", 1.0) == 0.0 for status in shown)
    limit_ms = None if np.isnan(pictures_hz) else round(1e3 / pictures_hz + _MOST_MS, 1)
    seen = [status.latency_s.get("to_picture", {}) for status in shown]
    p50, p99 = (1e3 * _median([one.get(share, float("nan")) for one in seen]) for share in ("p50", "p99"))
    clock_ms = _median([status.figures.get("clock_ms", float("nan")) for status in shown])
    drawn = "by a graphics card" if card else "by the processor: there is no graphics card"
    busy = ""
    busy_share = 0.5
    if not without[0] >= busy_share * rate_hz:
        busy = (
            f"not judged: the tracker alone did not keep up with its cameras ({rate_hz:g} Hz), others use this machine"
        )
        fewer = later = p99 = float("nan")
    one = f"one picture is {1e3 / pictures_hz:.1f} ms; the page's clock is known to {clock_ms:.1f} ms"
    most_fewer = 20.0
    most_later = 10.0
    smooth_hz = 24.0
    return (
        Row("poses per second, no page open", without[0], "Hz"),
        Row(f"poses per second, {_PAGES} pages open", having[0], "Hz"),
        Row("fewer poses with pages", fewer, "%", most=most_fewer, note=busy),
        Row("picture to hand at the reader, no page open, p99", without[1], "ms"),
        Row(f"picture to hand at the reader, {_PAGES} pages open, p99", having[1], "ms"),
        Row("later with pages, p99", later, "%", most=most_later if card else None),
        Row("pictures per second, the slower page", pictures_hz, "Hz", least=smooth_hz if card else None, note=drawn),
        Row("pose on the bus to the picture that shows it, p50", p50, "ms"),
        Row("pose on the bus to the picture that shows it, p99", p99, "ms", most=limit_ms, note=busy or one),
    )


def _both(turns: Sequence[Turn]) -> tuple[float, float]:
    """Return poses per second and the p99 of their latency, milliseconds, over some turns."""
    waits_ms = [wait for turn in turns for wait in turn.waits_ms]
    seconds = sum(turn.seconds for turn in turns)
    return (
        len(waits_ms) / seconds if seconds else float("nan"),
        float(np.percentile(waits_ms, 99.0)) if waits_ms else float("nan"),
    )


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")


async def _measured(rig: Rig, folder: Path, browser: str, seconds: float, rounds: int) -> list[Turn]:
    endpoint, page = free_endpoint("tcp/127.0.0.1:0"), free_endpoint("tcp/127.0.0.1:0").rpartition(":")[2]
    options = ["--rig", str(rig.path), "--connect", endpoint]
    services = {f"capture/{name}": ["capture", "--camera", name, *options] for name in rig.config.cameras}
    services |= {f"{name}/main": [name, *options] for name in ("fusion", "ik")}
    services["viewer/grasp"] = ["viewer", "--xr", "--port", page, *options]
    url = f"http://127.0.0.1:{page}/"
    turns: list[Turn] = []

    async def work(bus: Bus) -> None:
        await asyncio.to_thread(_is_built, url)
        await broadcast(bus, "start", "bench", 1.0, wait_s=_PATIENCE_S)
        await asyncio.sleep(1.0 + _SETTLING_S)
        try:
            for number in range(rounds):
                turns.append(await _turn(bus, 0, seconds))
                async with _windows(bus, browser, url, folder / f"browser {number}"):
                    turns.append(await _turn(bus, _PAGES, seconds))
                await _until(bus, lambda figures: figures.get("browsers", 0.0) == 0.0)
        finally:
            await broadcast(bus, "stop", "bench", 0.0, wait_s=_PATIENCE_S)

    await with_processes(bus_of(rig, endpoint), services, folder, work)
    return turns


def _is_built(url: str) -> None:
    with urllib.request.urlopen(url, timeout=_PATIENCE_S) as answer:
        if b"grasp.js" not in answer.read():
            raise DeviceError("the page Grasp is not built: run `make web` (needs node and npm)")


async def _turn(bus: Bus, pages: int, seconds: float) -> Turn:
    await asyncio.sleep(_SETTLING_S)
    arrivals = Arrivals()
    async with reading(bus, arrivals):
        await asyncio.sleep(seconds)
    waits_ms = tuple(1e3 * wait for wait in latencies_s(arrivals.frames, arrivals.hands))
    return Turn(pages, seconds, waits_ms, await _status(bus) if pages else None)


def _is_root() -> bool:
    return sys.platform != "win32" and os.geteuid() == 0


@asynccontextmanager
async def _windows(bus: Bus, browser: str, url: str, profiles: Path) -> AsyncIterator[None]:
    """Open the windows, each in a browser of its own so that none is in the background, and end them afterwards."""
    # Chromium's own sandbox does not work for root; the only page that it opens is ours.
    flags = [*_FLAGS, *(["--no-sandbox"] if _is_root() else [])]
    without_priority = await _without_priority()
    async with AsyncExitStack() as stack:
        for number in range(_PAGES):
            process = await asyncio.create_subprocess_exec(
                *without_priority,
                browser,
                *flags,
                f"--user-data-dir={profiles / str(number)}",
                url,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=asyncio.subprocess.DEVNULL,
            )
            stack.push_async_callback(_ended, process)
        await _until(bus, lambda figures: figures.get("browsers", 0.0) == _PAGES and "pictures_hz" in figures)
        yield


async def _without_priority() -> list[str]:
    """Return what keeps Chromium as root from a niceness of −8, before the tracker: it gets that from nobody else."""
    prefix = ["setpriv", "--bounding-set", "-sys_nice"]
    if not _is_root() or shutil.which(prefix[0]) is None:
        return []
    allowed = await asyncio.create_subprocess_exec(*prefix, "true", stderr=asyncio.subprocess.DEVNULL)
    return prefix if await allowed.wait() == 0 else []


async def _ended(process: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        await asyncio.wait_for(process.wait(), 10.0)
    except TimeoutError:
        process.kill()
        await process.wait()


async def _until(bus: Bus, there: Callable[[Mapping[str, float]], bool]) -> None:
    try:
        async with asyncio.timeout(_PATIENCE_S):
            while (status := await _status(bus)) is None or not there(status.figures):  # noqa: ASYNC110
                await asyncio.sleep(0.25)
    except TimeoutError:
        raise DeviceError(
            f"the windows of the browser did not open and close within {_PATIENCE_S:.0f} s; is this machine overloaded?"
        ) from None


async def _status(bus: Bus) -> ServiceStatus | None:
    for reply in await bus.get("rhot/status/viewer/grasp", timeout_s=_PATIENCE_S):
        if not reply.error:
            return decode(reply.payload, ServiceStatus)
    return None
