"""`rhot evaluate recording`: a long session at full rate recorded, replayed and recorded again."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import click
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from rhot.bus import Bus, Publisher
from rhot.cli.options import FiniteRange
from rhot.errors import RhotError
from rhot.messages import Control, Message, ObjectPose, ServiceStatus, Truth, encode
from rhot.offline import track
from rhot.recording.mcap.reader import open_mcap
from rhot.rig import BusConfig, Rig, load_rig, write_json_model
from rhot.rig.template import rig_template
from rhot.service.control import CONTROL_KEY
from rhot_bench.speed.simulated import projected_frames, world_of
from rhot_sim.rig.calibration import simulated_rig_calibration
from rhot_sim.running.processes import free_endpoint
from rhot_tools.measures.output import duration_option, json_option, show
from rhot_tools.measures.rows import Row, Section, check_output

_LOOP_S: Final = 5.0
_SPACING_MS: Final = 2.0
_FAST: Final = 10.0
_SERVICES: Final = ("capture/left", "capture/right", "fusion/main", "ik/main", "objects/main")
_SETTLE_S: Final = 0.5
_STALL_S: Final = 0.02
"""Traffic that is this late, because the machine was busy, goes on from there."""

Digest = tuple[str, bytes]
"""Key and hash of a payload."""


@dataclass(frozen=True, slots=True)
class Take:
    """A recorded file: what it holds, in order.

    Attributes:
        content: keys and payloads.
        log_ns: (N,) arrival times.
        bytes: size of the file.
    """

    content: list[Digest]
    log_ns: NDArray[np.int64]
    bytes: int

    @classmethod
    def of(cls, file: Path) -> Take:
        """Read a file."""
        content, times = [], []
        for sample in open_mcap(file).samples():
            content.append((sample.key, _hash(sample.payload)))
            times.append(sample.log_ns)
        return cls(content, np.array(times, dtype=np.int64), file.stat().st_size)


@dataclass(slots=True)
class Traffic:
    """What was published.

    Attributes:
        sent: by key, in order.
        worst_late_s: how late the latest message left.
        stalls: how often traffic was held up and went on from there.
    """

    sent: dict[str, list[bytes]] = field(default_factory=dict)
    stalls: int = 0
    worst_late_s: float = 0.0

    @property
    def count(self) -> int:
        """Messages on all keys."""
        return sum(map(len, self.sent.values()))

    def note(self, key: str, payload: bytes) -> None:
        """Count one message."""
        self.sent.setdefault(key, []).append(_hash(payload))


@click.command()
@duration_option(2, 36000, 600.0, "Seconds to record.")
@click.option(
    "--rate",
    "rate_hz",
    type=FiniteRange(5, 200),
    default=60.0,
    show_default=True,
    help="Frames per second of each camera.",
)
@json_option
def recording(duration_s: float, rate_hz: float, json_path: Path | None) -> None:
    """Record a session of full traffic, replay it at its own pace and ten times as fast, and compare.

    The messages are those of a simulated rig with two cameras, made beforehand: marker frames, points, a hand, an
    object, the truth, the services' status, a start and a change of settings. `rhot record` and `rhot replay` run as
    processes of their own. This takes a little more than twice the duration.
    """
    check_output("--json", json_path)
    console = Console(stderr=True, soft_wrap=True)
    with tempfile.TemporaryDirectory(prefix="rhot-recording-") as folder:
        rows = asyncio.run(_measure(Path(folder), duration_s, rate_hz, console))
    title = f"Recording and replay, {duration_s:g} s at {rate_hz:g} Hz"
    show("evaluate recording", [Section(title, tuple(rows))], json_path, duration_s=duration_s, rate_hz=rate_hz)


async def _measure(folder: Path, duration_s: float, rate_hz: float, console: Console) -> list[Row]:
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    script = _script(_rig(folder, rate_hz))
    async with await Bus.open(BusConfig(mode="router", connect=(), listen=(endpoint,))):
        console.print(f"recording {duration_s:g} s")
        async with _recorder(folder / "live.mcap", endpoint, console):
            traffic = await _publish(BusConfig(connect=(endpoint,)), script, duration_s)
        console.print("replaying at its own pace")
        async with _recorder(folder / "again.mcap", endpoint, console):
            await _replay(folder / "live.mcap", endpoint)
        console.print(f"replaying {_FAST:g} times as fast")
        async with _recorder(folder / "fast.mcap", endpoint, console):
            begun = time.monotonic()
            await _replay(folder / "live.mcap", endpoint, "--rate", f"{_FAST:g}")
            fast_s = time.monotonic() - begun
    live, again, fast = (Take.of(folder / f"{name}.mcap") for name in ("live", "again", "fast"))
    by_key: dict[str, list[bytes]] = {}
    for key, digest in live.content:
        by_key.setdefault(key, []).append(digest)
    lost = sum(missing_count(sent, by_key.get(key, [])) for key, sent in traffic.sent.items())
    misplaced = sum(misplaced_count(sent, by_key.get(key, [])) for key, sent in traffic.sent.items())
    spacing_ms = np.abs(np.diff(again.log_ns) - np.diff(live.log_ns)) / 1e6 if again.content == live.content else None
    held_up = f"held up {traffic.stalls} times by this machine, at most by {1e3 * traffic.worst_late_s:.0f} ms"
    drift_ms = abs(float(np.ptp(again.log_ns)) - float(np.ptp(live.log_ns))) / 1e6
    return [
        Row("messages published", traffic.count, note=held_up),
        Row("lost or changed in the recording", lost, most=0, note="by payloads"),
        Row("out of order in the recording", misplaced, most=0, note="key by key"),
        Row("size of the file", live.bytes / 1e6 / duration_s * 60.0, "MB a minute"),
        Row("lost or changed in the replay", missing_count(live.content, again.content), most=0, note="by payloads"),
        Row("out of order in the replay", misplaced_count(live.content, again.content), most=0, note="over all keys"),
        Row("spacing kept, median", _percentile(spacing_ms, 50), "ms"),
        Row("spacing kept, p99", _percentile(spacing_ms, 99), "ms", most=_SPACING_MS),
        Row("length of the replay off by", drift_ms, "ms"),
        Row(f"lost or changed at {_FAST:g} times the pace", missing_count(live.content, fast.content), most=0),
        Row(f"out of order at {_FAST:g} times the pace", misplaced_count(live.content, fast.content), most=0),
        Row(f"time that took, of {duration_s / _FAST:g} s", fast_s, "s", note="start of the process included"),
    ]


def _rig(folder: Path, rate_hz: float) -> Rig:
    text = rig_template(
        folder="rig",
        name="simulated",
        source="simulated",
        rate_hz=rate_hz,
        exposure_s=min(0.006, 0.9 / rate_hz),
        readout_s=min(0.012, 0.9 / rate_hz),
        simulated_objects=("cube",),
        seed=1,
    )
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    write_json_model(folder / "cameras.json", simulated_rig_calibration(load_rig(folder).config.cameras, 1).found)
    return load_rig(folder)


def _script(rig: Rig) -> list[tuple[float, str, Message]]:
    """Return some seconds of what a rig publishes: when, on which key, what."""
    world = world_of(rig)
    tracked = list(track(rig, projected_frames(rig, world, 0.0, _LOOP_S)))
    start_ns = tracked[0][1].t_ns
    script = [((message.t_ns - start_ns) / 1e9, key, message) for key, message in tracked]
    rate_hz = next(iter(rig.config.cameras.values())).rate_hz
    for step in range(int(_LOOP_S * rate_hz)):
        t_s = step / rate_hz
        t_ns = start_ns + round(t_s * 1e9)
        truth: Truth = world.truth(t_s, t_ns)
        cube = truth.objects["cube"]
        pose = ObjectPose(
            t_ns=t_ns, frame="rig", position=cube.position, orientation=cube.orientation, state="measured"
        )
        script += [(t_s, "rhot/truth", truth), (t_s, "rhot/object/cube", pose)]
    for second in range(int(_LOOP_S)):
        for name in _SERVICES:
            service, _, instance = name.partition("/")
            status = ServiceStatus(t_ns=start_ns + second * 10**9, service=service, instance=instance, state="running")
            script.append((float(second), f"rhot/status/{name}", status))
    return sorted(script, key=lambda entry: entry[0])


async def _publish(config: BusConfig, script: list[tuple[float, str, Message]], duration_s: float) -> Traffic:
    traffic = Traffic()
    async with await Bus.open(config, timeout_s=5.0) as bus:
        publishers: dict[str, Publisher[Message]] = {}
        for _, key, message in script:
            if key not in publishers:
                publishers[key] = bus.publisher(key, type(message))
        control = bus.publisher(CONTROL_KEY, Control, reliable=True)
        ready = [await control.wait_for_reader(10.0)]
        ready += [await publisher.wait_for_reader(10.0) for publisher in publishers.values()]
        if not all(ready):
            raise RhotError("`rhot record` does not listen after 10 s; is the machine overloaded?")
        start = control.put(Control(t_ns=time.time_ns(), action="start", session="s", start_t_ns=time.time_ns()))
        traffic.note(CONTROL_KEY, encode(start))
        change = b'{"hold_s": 0.5}'
        await bus.put("rhot/config/fusion/main", change, "application/json")
        traffic.note("rhot/config/fusion/main", change)
        begun = time.monotonic()
        begun_ns = time.time_ns()
        for due_s, key, message in endless(script):
            if due_s >= duration_s:
                break
            wait_s = begun + due_s - time.monotonic()
            if wait_s > 0.0:
                await asyncio.sleep(wait_s)
            traffic.worst_late_s = max(traffic.worst_late_s, -wait_s)
            if wait_s < -_STALL_S:
                # No service sends what it missed in a heap, which the network would drop.
                begun -= wait_s
                traffic.stalls += 1
            sent = publishers[key].put(message.model_copy(update={"t_ns": begun_ns + round(due_s * 1e9)}))
            traffic.note(key, encode(sent))
        await asyncio.sleep(_SETTLE_S)
    return traffic


def endless(script: list[tuple[float, str, Message]]) -> Iterator[tuple[float, str, Message]]:
    """Yield the messages of a script with their keys and times, seconds, again and again, one round after the other."""
    passed_s = 0.0
    while True:
        for due_s, key, message in script:
            yield passed_s + due_s, key, message
        passed_s += _LOOP_S


@contextlib.asynccontextmanager
async def _recorder(file: Path, endpoint: str, console: Console) -> AsyncIterator[None]:
    process = await _start("record", "--out", str(file), "--connect", endpoint, "--rig", str(file.parent))
    try:
        if process.stderr is None or b"recording to" not in await process.stderr.readline():
            raise RhotError("`rhot record` did not start")
        yield
        await asyncio.sleep(_SETTLE_S)
        process.send_signal(signal.SIGINT)
        _, errors = await process.communicate()
        if process.returncode:
            raise RhotError(f"`rhot record` failed: {errors.decode().strip()}")
        for line in errors.decode().splitlines():
            if "lost" in line:
                console.print(f"rhot record: {line}")
    finally:
        if process.returncode is None:
            process.kill()


async def _replay(file: Path, endpoint: str, *options: str) -> None:
    process = await _start("replay", str(file), "--connect", endpoint, *options)
    _, errors = await process.communicate()
    if process.returncode:
        raise RhotError(f"`rhot replay` failed: {errors.decode().strip()}")


async def _start(*arguments: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rhot", *arguments), stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE
    )


def missing_count(first: Sequence[Hashable], second: Sequence[Hashable]) -> int:
    """Return how many entries of the first are not in the second."""
    return (Counter(first) - Counter(second)).total()


def misplaced_count(first: Sequence[Hashable], second: Sequence[Hashable]) -> float:
    """Return how many entries stand elsewhere; NaN where some are missing."""
    if Counter(first) != Counter(second):
        return float("nan")
    return sum(one != other for one, other in zip(first, second, strict=True))


def _hash(payload: bytes) -> bytes:
    return hashlib.blake2b(payload, digest_size=12).digest()


def _percentile(values: NDArray[np.float64] | None, share: float) -> float:
    return float("nan") if values is None else float(np.percentile(values, share))
