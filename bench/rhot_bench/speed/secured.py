"""What a secured bus costs: the same messages over plain TCP and over TLS with access control, in turns."""

from __future__ import annotations

import asyncio
import tempfile
import time
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Final

import numpy as np

from rhot.bus import Bus, EventSubscriber, Publisher
from rhot.messages import Marker, MarkerFrame
from rhot.operation.supervisor import Supervisor
from rhot.rig import BusConfig
from rhot.rig.folder import RIG_FILE, load_config
from rhot.rig.template import rig_template
from rhot.rig.toml_edit import change_rig_file
from rhot_sim.running.run import free_endpoint
from rhot_tools.keys.making import make_keys
from rhot_tools.measures.rows import Row, Section

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
