"""`rhot sim`: the whole system on this machine, with simulated cameras, hand and object."""

from __future__ import annotations

import asyncio
import json
import signal
import tempfile
import time
from collections.abc import Coroutine, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Literal, get_args

import click
from rich.console import Console, RenderableType

from rhot.bus import Bus
from rhot.cli.options import DEFAULT_RIG, FiniteRange, endpoints, rig_folder_option
from rhot.cli.page import Pages, free_pages, page_options
from rhot.errors import ConfigError
from rhot.messages import Side
from rhot.rig import Rig, load_rig
from rhot.rig.feet_config import WalkProgram
from rhot.rig.folder import RIG_FILE, write_text_atomic
from rhot.service.stop import install_stop
from rhot.text import as_argument
from rhot_sim.comparison.feet import (
    CollectedFeet,
    collect_feet,
    feet_figures,
    feet_summary,
    live_feet_table,
    stages_text,
)
from rhot_sim.comparison.figures import machine_verdict, service_figures, summary
from rhot_sim.rig.folder import DEFAULT_ENDPOINT, with_motion, write_simulated_rig
from rhot_sim.running.calibration_run import missing_calibration, run_for_calibration
from rhot_sim.running.processes import SimRun, WatchedRun, free_endpoint
from rhot_sim.walker.folder import write_walker_rig
from rhot_sim.walker.world import WalkerWorld

# One run of the simulated walker: what is collected, shown and reported of it.

_SERVICES: Final = ("feet", "ik", "objects", "truth")
_FEET: Final = "feet/main"


class WalkerRun(WatchedRun):
    """A simulated walker, run once."""

    def __init__(
        self, rig: Rig, endpoint: str, duration_s: float, work: Path, pages: Mapping[str, Sequence[str]] | None = None
    ) -> None:
        """Prepare a run; arguments as of `WatchedRun`, the rig with `[feet]` and a simulated head.

        Raises:
            ConfigError: the rig has no feet.
        """
        if rig.config.feet is None:
            raise ConfigError(f"{rig.path / 'rig.toml'} names no feet; add [feet.left] or [feet.right] with marker_id")
        super().__init__(rig, endpoint, duration_s, work, _SERVICES, pages)
        self._feet = rig.config.feet
        self._collected = CollectedFeet()
        self._begin(rig)

    def _begin(self, rig: Rig) -> None:
        self._world = WalkerWorld.from_rig(rig)
        self._collected.clear()

    def _collect(self, bus: Bus) -> Coroutine[Any, Any, None]:
        return collect_feet(bus, self._collected, time.time_ns)

    def _figures(self, from_s: float, to_s: float) -> dict[str, Any]:
        return feet_figures(self._world, self._start_t_ns, self._collected, from_s, to_s)

    def _table(self, elapsed_s: float, figures: dict[str, Any], services: RenderableType) -> RenderableType:
        return live_feet_table(elapsed_s, self._duration_s, figures, services)

    def _line(self, figures: dict[str, Any]) -> str:
        error, latency = figures["foot_error_mm"], figures.get("latency_ms", {})
        if "median" not in error or not latency:
            return "no foot"
        return (
            f"{figures['rate_hz']:.0f} poses/s   feet {error['median']:.1f} mm (p95 {error['p95']:.1f})   "
            f"latency {latency['p50']:.1f} ms   {stages_text(figures)}"
        )

    def report(self) -> dict[str, Any]:
        """Return every figure of the run, JSON-ready."""
        config = self._rig.config
        return {
            "version": 1,
            "duration_s": self._duration_s,
            "steady_from_s": self._steady_from_s,
            "seed": config.sim.seed,
            "walk": config.sim.walk,
            "height_m": config.body.height_m,
            "camera_rate_hz": self._feet.camera.rate_hz,
            "method": self._feet.method,
            **self._figures(self._steady_from_s, self._duration_s),
            **self._load(),
            **service_figures(self._before, self._after),
        }

    def _load(self) -> dict[str, float]:
        """Return the pictures per second that were tracked, and the cores taken beside drawing them."""
        before, after = self._before.get(_FEET), self._after.get(_FEET)
        if before is None or after is None:
            return {}
        seconds = max(after.uptime_s - before.uptime_s, 1e-3)
        taken = {name: after.figures.get(name, 0.0) - before.figures.get(name, 0.0) for name in after.figures}
        cores = (taken.get("processor_s", 0.0) - taken.get("camera_processor_s", 0.0)) / seconds
        pictures = after.counts.get("frames", 0) - before.counts.get("frames", 0)
        return {"pictures_hz": pictures / seconds, "feet_cores": cores}


_SIDES: Final[Mapping[str, tuple[Side, ...]]] = {"right": ("right",), "left": ("left",), "both": ("right", "left")}
"""Hands by the choices of --hands; the first one's paints are the rig's own."""
_NEXT: Final = (
    ("rhot status", "every service, its rates, losses and latency"),
    ("rhot record --out take.mcap --duration 10", "a recording; then  rhot explain take.mcap --at 2"),
    ("rhot init myrig", "a rig of your own; docs/use.md leads on from there"),
)
_TO_CALIBRATE: Final = ("board", "desk_board", "touch", "headset")
"""Motions that are there to calibrate with: nothing is compared with the truth."""


@click.command()
@click.option(
    "--duration",
    "duration_s",
    type=FiniteRange(1, 86400),
    default=30.0,
    show_default=True,
    help="Seconds until the summary. In a terminal, rig and pages then stay until Ctrl-C, unless --headless or "
    "--no-viewer is given. With a board or an uncalibrated rig, until Ctrl-C unless you give it.",
)
@click.option(
    "--seed",
    type=click.IntRange(0, 2**63 - 1),
    default=1,
    show_default=True,
    help="Seed of the simulated world; the same seed gives the same motion.",
)
@click.option(
    "--rate",
    "rate_hz",
    type=FiniteRange(5, 200),
    default=60.0,
    show_default=True,
    help="Frames per second of each camera.",
)
@click.option("--cameras", type=click.IntRange(2, 8), default=2, show_default=True, help="Number of cameras.")
@click.option(
    "--hands",
    type=click.Choice(["right", "left", "both"]),
    default="right",
    show_default=True,
    help="Hands in the simulated world. Both hands have the same paints on their fingertips.",
)
@click.option(
    "--motion",
    type=click.Choice(["script", "still", "crossing", "board", "desk_board", "touch", "headset"]),
    default="script",
    show_default=True,
    help="What the cameras see: gestures and grasps, open hands that never move, two hands that touch and cross, a "
    "chessboard to calibrate the cameras with, one that lies on the desk, or a finger that touches the faces of a box; "
    "or, with feet, a marker on the floor and a person who looks at it from all sides.",
)
@click.option(
    "--feet",
    is_flag=True,
    help="Simulate a walking person, with a depth camera on the head and sensors on the ankles, instead of a hand.",
)
@click.option(
    "--walk",
    type=click.Choice(get_args(WalkProgram)),
    default="walk",
    show_default=True,
    help="With --feet: what the person does.",
)
@click.option(
    "--height",
    "height_m",
    type=FiniteRange(1.2, 2.2),
    default=1.75,
    show_default=True,
    help="With --feet: height of the person, metres.",
)
@click.option(
    "--headless",
    is_flag=True,
    help="Show no web page and no live table, only occasional progress lines and the summary.",
)
@page_options
@click.option(
    "--report",
    "report_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Also write every figure to this file, as JSON.",
)
@click.option(
    "--listen",
    "endpoint",
    metavar="ENDPOINT",
    help=f"Where the router listens.  [default: {DEFAULT_ENDPOINT}, or a free port]",
)
@rig_folder_option(
    "Rig folder, simulated.",
    envvar="RHOT_RIG",
    default=DEFAULT_RIG,
    show_default="a temporary one",
    show_envvar=True,
)
@click.pass_context
def sim(
    context: click.Context,
    duration_s: float,
    seed: int,
    rate_hz: float,
    cameras: int,
    hands: str,
    motion: Literal["script", "still", "crossing", "board", "desk_board", "touch", "headset"],
    feet: bool,
    walk: WalkProgram,
    height_m: float,
    headless: bool,
    viewer: bool,
    page_port: int,
    report_path: Path | None,
    endpoint: str | None,
    rig_path: Path,
) -> int:
    """Run a whole simulated rig on this machine and show how well it tracks.

    Every part runs as its own process, as on a real rig: one capture service per camera, fusion, ik, objects and the
    web pages. Each capture service draws what its camera would see, with lens, noise, blur, rolling shutter, lost
    frames and its own clock. While it runs, open http://localhost:8081 to see the hand or http://localhost:8080 to work
    on the rig, or inspect any key from another terminal:

    \b
    rhot status
    rhot get 'rhot/**'
    rhot watch rhot/hand/right

    With --rig, it uses a rig folder made by `rhot init RIG --sim` (or `--sim --feet`) instead of a temporary one. Its
    rig.toml says what moves (`motion` and `walk` under [sim]), the cameras' frame rate, and the seed.

    With --motion board, the cameras see a calibration chessboard in one position after the other, and the rig runs
    until Ctrl-C: try `rhot calibrate cameras --live` on it. With --motion desk_board it lies on the desk, for `rhot
    calibrate stage --live`. With --motion touch a finger touches the faces of a box, for `rhot calibrate objects
    --touch cube`. With --motion headset a person looks at a marker on the floor through a camera that is mounted at an
    angle on the headset, for `rhot calibrate headset --live`.

    With --hands both --motion crossing, two hands touch and cross, which is when a tracker is most likely to confuse
    them.

    A rig made by `rhot init RIG --sim --uncalibrated` also runs until Ctrl-C: the page's tab Calibrate leads you
    through the calibration.

    With --feet, a person walks. The feet service reads a simulated depth camera on the head and simulated sensors on
    the ankles, and ik solves the legs. Drawing the pictures takes most of a core. If the summary shows fewer pictures
    per second than you asked for, try --rate 30.
    """
    console = Console()
    if motion == "crossing" and hands != "both" and not _is_given(context, "rig_path"):
        raise ConfigError(f"--motion crossing with --hands {hands}: two hands are needed to cross; give --hands both")
    _check_outside(report_path, endpoint)
    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rhot-sim-")))
        chosen = endpoint or free_endpoint(DEFAULT_ENDPOINT)
        if _is_given(context, "rig_path"):
            rig = _simulated_rig(rig_path)
            feet = rig.config.feet is not None and (feet or not rig.config.cameras)
            _refuse_what_the_rig_says(context, rig)
        elif feet or motion == "headset":
            feet = True
            rig = write_walker_rig(
                work / "rig",
                endpoint=chosen,
                program=walk,
                seed=seed,
                height_m=height_m,
                rate_hz=rate_hz,
                motion="headset" if motion == "headset" else "script",
            )
        else:
            with console.status("preparing the simulated rig: cameras, colours, hand"):
                sides = _SIDES[hands]
                rig = write_simulated_rig(
                    work / "rig", cameras=cameras, rate_hz=rate_hz, seed=seed, sides=sides, endpoint=chosen
                )
            rig = with_motion(rig, motion)
        if chosen != DEFAULT_ENDPOINT:
            console.print(f"The router listens on {chosen}: give the other commands --connect {chosen}", soft_wrap=True)
        calibrating = rig.config.sim.motion in _TO_CALIBRATE or bool(not feet and missing_calibration(rig))
        pages = free_pages(page_port, grasp=not calibrating) if viewer and not headless else Pages()
        if calibrating:
            limit_s = duration_s if _is_given(context, "duration_s") else None
            work_on_it = run_for_calibration(rig, chosen, limit_s, work, console, pages.commands(), pages.lines())
            return 128 + signal.SIGINT if asyncio.run(_unless_interrupted(work_on_it)) else 0
        run = (WalkerRun if feet else SimRun)(rig, chosen, duration_s, work, pages.commands())
        return _run_and_compare(run, console, pages, report_path, headless=headless)


def _run_and_compare(
    run: SimRun | WalkerRun, console: Console, pages: Pages, report_path: Path | None, *, headless: bool
) -> int:
    """Run to the end, compare with the truth, print the summary and write the report; return the exit code.

    Where a person watches, the rig and its pages stay after the summary until Ctrl-C.
    """
    watched = not headless and console.is_terminal and bool(pages.commands())
    told = False

    def tell() -> None:
        nonlocal told
        _print_summary(run, console, report_path, headless=headless)
        if watched:
            lines = "\n".join(f"  {command:46} {about}" for command, about in _NEXT)
            console.print(
                f"\nThe rig runs on until Ctrl-C. Next, in another terminal:\n{lines}", markup=False, highlight=False
            )
            for line in pages.lines():
                console.print(line, soft_wrap=True)
        told = True

    shown = run.execute(
        console, live=not headless and console.is_terminal, announce=pages.lines(), stay=tell if watched else None
    )
    if asyncio.run(_unless_interrupted(shown)):
        if told:
            return 0
        console.print("interrupted; no summary")
        return 128 + signal.SIGINT
    tell()
    return 0


def _print_summary(run: SimRun | WalkerRun, console: Console, report_path: Path | None, *, headless: bool) -> None:
    if not headless:
        console.print()
    with console.status("comparing with the truth"):
        report = run.report()
    console.print(feet_summary(report) if isinstance(run, WalkerRun) else summary(report))
    kept_up, why = machine_verdict(report)
    console.print(why, style="green" if kept_up else "yellow", markup=False, highlight=False, soft_wrap=True)
    if report_path is not None:
        write_text_atomic(report_path, json.dumps(report, indent=1) + "\n")
        console.print(f"report: {report_path}", markup=False)


def _check_outside(report_path: Path | None, endpoint: str | None) -> None:
    """Refuse before any work is done what the report or the router could not use."""
    if report_path is not None and not report_path.resolve().parent.is_dir():
        raise ConfigError(f"--report {report_path}: the folder {report_path.resolve().parent} does not exist")
    if endpoint is not None:
        endpoints("--listen", (endpoint,))


def _is_given(context: click.Context, option: str) -> bool:
    return context.get_parameter_source(option) is not click.core.ParameterSource.DEFAULT


def _refuse_what_the_rig_says(context: click.Context, rig: Rig) -> None:
    """Refuse options that would change nothing, for every process reads the rig folder.

    Raises:
        ConfigError: one was given that differs from what stands there, or cannot hold beside it.
    """
    sim, file = rig.config.sim, rig.path / RIG_FILE
    for option, says in (("motion", sim.motion), ("walk", sim.walk), ("seed", sim.seed)):
        given = context.params[option]
        if _is_given(context, option) and given != says:
            wanted = given if option == "seed" else f'"{given}"'
            raise ConfigError(
                f"--{option} {given}: {file} says {option} = {says}; write {option} = {wanted} under [sim] there, or "
                "leave --rig out"
            )
    elsewhere = {"rate_hz": "rate_hz of the cameras", "cameras": "the cameras", "hands": "the markers",
                 "height_m": "height_m of [body]"}  # fmt: skip
    for option, where in elsewhere.items():
        if _is_given(context, option):
            name = option.removesuffix("_hz").removesuffix("_m")
            raise ConfigError(f"--{name}: {file} says that ({where}); change it there, or leave --rig out")


async def _unless_interrupted(run: Coroutine[Any, Any, None]) -> bool:
    """Run to the end (False) or until somebody interrupts (True)."""
    stop = install_stop()
    work = asyncio.create_task(run)
    asked = asyncio.create_task(stop.requested.wait())
    await asyncio.wait((work, asked), return_when=asyncio.FIRST_COMPLETED)
    asked.cancel()
    if work.done():
        work.result()
        return False
    work.cancel()
    await asyncio.gather(work, return_exceptions=True)
    return True


def _simulated_rig(path: Path) -> Rig:
    if not (path / RIG_FILE).exists():
        raise ConfigError(f"{path} holds no {RIG_FILE}; `rhot init {as_argument(path)} --sim` makes a simulated rig")
    rig = load_rig(path)
    sources: dict[str, str] = {name: camera.source for name, camera in rig.config.cameras.items()}
    if rig.config.feet is not None and not sources:
        sources["feet"] = rig.config.feet.camera.source
    real = [name for name, source in sources.items() if source != "simulated"]
    if real:
        raise ConfigError(
            f"{path / RIG_FILE}: {', '.join(real)}: not simulated; leave --rig and RHOT_RIG out for a temporary rig, "
            "make one to keep with `rhot init RIG --sim`, or run this one with `rhot up`"
        )
    return rig
