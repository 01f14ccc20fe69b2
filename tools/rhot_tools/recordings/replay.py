"""`rhot replay`: a recording back on the bus, as it was or with today's times."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import click
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.text import Text

from rhot.bus import CONNECT_S
from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import BusError, ConfigError
from rhot.recording.mcap.reader import McapRecording, RecordedSample, open_mcap
from rhot.recording.mcap.session import EVERYTHING
from rhot.recording.player import LATE_NS, REPLAY_SERVICE, PlayFigures, conflicts, moments, play
from rhot.rig import BusConfig
from rhot.service.stop import Stop, install_stop
from rhot_tools.operate.live_rig import rig_clock, started
from rhot_tools.recordings.restamp import ReplayBus, Restamp, chosen_keys, clock_skew_ns

_PAUSE_S = 5.0
"""From where a pause in a recording is worth a word."""
_SWITCH_S = 0.0005


def _samples(
    recordings: Sequence[McapRecording], keys: frozenset[str], from_s: float, to_s: float | None
) -> Iterator[RecordedSample]:
    start_ns = recordings[0].start_ns
    from_ns = start_ns + round(from_s * 1e9)
    to_ns = None if to_s is None else start_ns + round(to_s * 1e9)
    for recording in recordings:
        for sample in recording.samples(from_ns, to_ns):
            if sample.key in keys:
                yield sample


def _refuse_conflicts(keys: frozenset[str], alive: Sequence[str]) -> None:
    found = conflicts(sorted(keys), alive)
    if found:
        key, service = found[0]
        more = f" (and {len(found) - 1} more keys belong to living services)" if len(found) > 1 else ""
        raise BusError(
            f"{service} is alive and {key} is its own{more}: a replay would mix with it; stop the rig, leave such keys "
            "out with --keys, connect to another router, or insist with --force"
        )


async def _play(
    put: Callable[[RecordedSample], None],
    samples: Callable[[], Iterator[RecordedSample]],
    rate: float,
    loop: bool,
    start_ns: int,
    stop: Stop,
) -> PlayFigures:
    """Play on a thread of its own, once or until stopped, and show how it goes."""
    stopping = threading.Event()
    figures = PlayFigures()

    def run() -> None:
        while True:
            before = figures.sent
            play(samples(), put, rate=rate, stopping=stopping, figures=figures)
            if stopping.is_set() or not loop or figures.sent == before:
                return

    # The playing thread wakes on time and must not wait 5 ms for this one to give way.
    sys.setswitchinterval(_SWITCH_S)
    console = Console(stderr=True, soft_wrap=True)
    told_s = 0.0
    playing = asyncio.create_task(asyncio.to_thread(run))
    asked = asyncio.create_task(stop.requested.wait())
    with Live(console=Console(stderr=True), auto_refresh=False, transient=True) as live:
        try:
            while not playing.done() and not asked.done():
                show_s = 0.5
                await asyncio.wait((playing, asked), timeout=show_s, return_when=asyncio.FIRST_COMPLETED)
                waits_s = figures.waits_s
                if waits_s < _PAUSE_S:
                    told_s = 0.0
                elif not told_s:
                    told_s = waits_s
                    console.print(f"[yellow]the next message is {_duration(waits_s)} away; --from leaves pauses out[/]")
                if live.console.is_terminal:
                    at_s = (figures.log_ns - start_ns) / 1e9 if figures.sent else 0.0
                    live.update(Text(f"{at_s:.1f} s, {figures.sent} messages; Ctrl-C ends"), refresh=True)
        finally:
            stopping.set()
            asked.cancel()
            await playing
    return figures


def _duration(seconds: float) -> str:
    """Return a duration for people, in the unit that fits."""
    units = (("years", 365.25 * 86400), ("days", 86400), ("hours", 3600), ("minutes", 60), ("seconds", 1))
    name, size = next((name, size) for name, size in units if seconds >= 2 * size or size == 1)
    return f"{seconds / size:.0f} {name}"


async def _step(bus: ReplayBus, samples: Iterator[RecordedSample], start_ns: int, stop: Stop) -> PlayFigures:
    """Put out one moment for each line on standard input."""
    lines: asyncio.Queue[bool] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    def wait_for_lines() -> None:
        for line in sys.stdin:
            with contextlib.suppress(RuntimeError):  # the loop is closed: the program is ending
                loop.call_soon_threadsafe(lines.put_nowait, line.strip().lower() != "q")
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(lines.put_nowait, False)

    # A daemon: nothing ends a read of standard input, and Ctrl-C must end the program all the same.
    threading.Thread(target=wait_for_lines, name="rhot-lines", daemon=True).start()
    figures = PlayFigures()
    console = Console(stderr=True, soft_wrap=True)
    console.print("Enter puts out the next moment, q and Enter ends")
    asked = asyncio.create_task(stop.requested.wait())
    try:
        for moment in moments(samples):
            line = asyncio.create_task(lines.get())
            await asyncio.wait((line, asked), return_when=asyncio.FIRST_COMPLETED)
            if not line.done() or not line.result():
                line.cancel()
                break
            for sample in moment:
                await asyncio.to_thread(bus.put_sample, sample)
            figures.sent += len(moment)
            keys = escape(", ".join(dict.fromkeys(sample.key for sample in moment)))
            console.print(f"{(moment[0].log_ns - start_ns) / 1e9:10.3f} s  {keys}")
    finally:
        asked.cancel()
    return figures


async def _replay(
    config: BusConfig,
    recordings: Sequence[McapRecording],
    *,
    key_expr: str,
    only: Sequence[str],
    rate: float,
    step: bool,
    loop: bool,
    now: bool,
    span_s: tuple[float, float | None],
    force: bool,
) -> int:
    stop = install_stop()
    keys = _chosen(recordings, key_expr, only)
    start_ns = recordings[0].start_ns

    def samples() -> Iterator[RecordedSample]:
        return _samples(recordings, keys, *span_s)

    console = Console(stderr=True, soft_wrap=True)
    bus = await ReplayBus.open(config, timeout_s=CONNECT_S)
    async with bus, contextlib.AsyncExitStack() as stack:
        alive = [reply.key.removeprefix("rhot/alive/") for reply in await bus.who_is_alive() if reply.key]
        if not force:
            _refuse_conflicts(keys, alive)
        for key in sorted(keys):
            bus.answer_with_last(key)
        put = bus.put_sample
        if now:
            restamp = Restamp(rate, clock_skew_ns(samples()), await rig_clock(bus))
            if alive:
                await stack.enter_async_context(started(bus, time.strftime("replay-%Y%m%d-%H%M%S")))

            def put(sample: RecordedSample) -> None:
                bus.put_sample(restamp(sample))

        elif alive:
            names = escape(", ".join(alive))
            console.print(f"[yellow]{names}: services refuse times over 2 s old; --now gives today's[/]")
        bus.alive(f"rhot/alive/{REPLAY_SERVICE}/main")
        if step:
            figures = await _step(bus, samples(), start_ns, stop)
        else:
            figures = await _play(put, samples, rate, loop, start_ns, stop)
    if not figures.sent and not stop.requested.is_set():
        console.print("[yellow]no message lies in this part of the recording[/]")
    elif step:
        console.print(f"{figures.sent} messages")
    else:
        console.print(
            f"{figures.sent} messages; {100 * figures.late / max(figures.sent, 1):.2f} % left more than "
            f"{LATE_NS / 1e6:.0f} ms after their time, the latest {figures.worst_late_ns / 1e6:.1f} ms"
        )
    if figures.fell_behind:
        console.print(f"[yellow]this machine was too busy: the replay fell behind {figures.fell_behind} times[/]")
    return stop.exit_code


def _chosen(recordings: Sequence[McapRecording], key_expr: str, only: Sequence[str]) -> frozenset[str]:
    keys = chosen_keys(tuple(dict.fromkeys(key for recording in recordings for key in recording.keys)), key_expr)
    for topic in only:
        if not any(_topic(key) == topic for key in keys):
            raise ConfigError(f"{recordings[0].path}: --only {topic}: nothing of that; it holds {_held(recordings)}")
    if only:
        keys = frozenset(key for key in keys if _topic(key) in only)
    if not keys:
        raise ConfigError(f"{recordings[0].path}: no key matches {key_expr}; it holds {_held(recordings)}")
    return keys


def _topic(key: str) -> str:
    """Return the second chunk of a key, such as `markers`."""
    return "".join(key.split("/")[1:2])


def _held(recordings: Sequence[McapRecording]) -> str:
    keys = sorted({key for recording in recordings for key in recording.keys})
    return ", ".join(keys[:8]) + (f" and {len(keys) - 8} more" if len(keys) > 8 else "") or "nothing"


@click.command()
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--rate",
    type=FiniteRange(0.001, 1000.0),
    default=1.0,
    show_default=True,
    help="Speed: 2 is twice as fast as recorded, 0.5 half as fast.",
)
@click.option(
    "--keys",
    "key_expr",
    metavar="KEYEXPR",
    default=EVERYTHING,
    show_default=True,
    help="Only keys that match, such as 'rhot/hand/*'.",
)
@click.option(
    "--only",
    multiple=True,
    metavar="KIND",
    help="Only keys of this kind, such as markers or hand. May be repeated.",
)
@click.option(
    "--now",
    is_flag=True,
    help="Give messages the present time, so that running services work on them, and start services that wait. The "
    "payloads then differ from the recorded bytes.",
)
@click.option("--step", is_flag=True, help="Publish one moment each time you press Enter.")
@click.option("--loop", is_flag=True, help="Start again at the end, until Ctrl-C.")
@click.option(
    "--from", "from_s", type=FiniteRange(min=0), default=0.0, help="Start this many seconds into the recording."
)
@click.option("--to", "to_s", type=FiniteRange(min=0), help="Stop this many seconds into the recording.")
@click.option("--force", is_flag=True, help="Replay even where a running service publishes the same keys.")
@rig_option
@bus_options
def replay(
    files: tuple[Path, ...],
    rate: float,
    key_expr: str,
    only: tuple[str, ...],
    now: bool,
    step: bool,
    loop: bool,
    from_s: float,
    to_s: float | None,
    force: bool,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> int:
    """Put a recording of `rhot record` back on the bus, message by message as it was sent.

    FILE is an MCAP file; several parts of one recording are played one after the other. Whatever listens to a live rig
    sees the recorded one, with its recorded times; a router must run (`rhot router`). Keys that a running service
    publishes are refused.

    Services reject messages from the past. With --now the times are shifted to the present, and with --only markers a
    running fusion and ik (`rhot up`) track the recorded markers again. At a rate other than 1 the hand then also moves
    at a different speed.

    \b
    rhot replay grasp.mcap
    rhot replay grasp.mcap --only markers --now
    rhot replay grasp.mcap --only hand --rate 0.25 --loop
    """
    if step and (loop or now):
        raise click.UsageError(f"--step and {'--loop' if loop else '--now'} exclude each other")
    if to_s is not None and to_s <= from_s:
        raise click.UsageError(f"--to {to_s:g} must be greater than --from {from_s:g}")
    recordings = [open_mcap(file) for file in files]
    for recording in recordings:
        if recording.note:
            click.echo(f"rhot: {recording.note}", err=True)
    config = tool_bus(rig_path, connect, namespace)
    return asyncio.run(
        _replay(
            config,
            recordings,
            key_expr=key_expr,
            only=only,
            rate=rate,
            step=step,
            loop=loop,
            now=now,
            span_s=(from_s, to_s),
            force=force,
        )
    )
