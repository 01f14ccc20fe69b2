"""`rhot evaluate ablation`: what each term and each number of the estimators earns.

Every constant of the modules of fusion and ik, of detection, or of feet is halved and doubled, and every term of
`TERMS` is switched off, one at a time. Each variant tracks the same detected markers, of sets of rendered pictures
and of rigs of the motion family; detection finds them anew, and feet are those of simulated walks. A figure is the
mean over these worlds; its change is told against the tracker as it is.
"""

from __future__ import annotations

import inspect
import pkgutil
import sys
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from itertools import count, takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import click
import cv2
import numpy as np
from rich.console import Console

from rhot.anatomy.body_proportions import BodyModel
from rhot.cli.options import FiniteRange, jobs_option
from rhot.messages import FootPose, MarkerFrame
from rhot.offline import track, track_smoothly
from rhot.recording import load_recording
from rhot.rig import Rig
from rhot.rig.feet_config import FeetConfig
from rhot_bench.feet.heads import START_NS, Heads
from rhot_bench.feet.runs import COMPUTE_S, STEP_S
from rhot_bench.motion.errors import coverage, hand_errors, point_errors
from rhot_bench.motion.run import tracked
from rhot_bench.motion.tracks import Tracks, make_tracks
from rhot_bench.pictures.rendered import SEQUENCES, Measures, at_rate_of, found_markers, prepare_rig, require_pictures
from rhot_bench.pictures.scoring import score_messages
from rhot_bench.processes import each
from rhot_feet.foot_core import FootCore
from rhot_feet.frames import DepthFrame, pinhole
from rhot_sim.sources.imu import SimulatedSource
from rhot_sim.walker.folder import write_walker_rig
from rhot_sim.walker.person import person_of
from rhot_sim.walker.world import WalkerWorld
from rhot_tools.measures.output import counted, json_option, show
from rhot_tools.measures.rows import Row, Section, check_output

EARNS: Final = 3.0
"""Change of a figure, percent (of coverage and honesty: points), from which on a term or a number earns its place."""

Change = tuple[tuple[str, str, Any], ...]
"""Module, name and value of everything that a variant changes; a dot in the name: an attribute of it."""

_PACKAGES: Final = {
    "hand": ("rhot_fusion.filter", "rhot_ik.hand"),
    "detection": ("rhot_capture.detection",),
    "feet": ("rhot_feet.depth", "rhot_feet.filter", "rhot_feet.imu", "rhot_feet.marker", "rhot_feet.foot_core"),
}
"""Whose constants are varied."""
_MOTION, _PAINT, _HAND = "rhot_fusion.filter.motion", "rhot_fusion.filter.paint", "rhot_ik.hand.filter.filter"
_TRACKS, _SOLVER = "rhot_fusion.filter.tracks", "rhot_ik.hand.solver"

TERMS: Final[Mapping[str, Change]] = {
    "correlated acceleration": ((_MOTION, "_PERSISTS_S", 1e-3),),
    "rotation of the hand in the motion model": ((_MOTION, "_TURNING", 1e-6),),
    "fingers come to rest": ((_MOTION, "_JOINING_S", 1e6),),
    "abrupt stops": ((_MOTION, "_ABRUPT", 0.0),),
    "several noise intensities": (
        ("rhot_fusion.filter.joint", "SCALES", (1.6,)),
        ("rhot_fusion.filter.joint", "SHARES", (1.0,)),
    ),
    "pixel noise is learnt": (("rhot_fusion.filter.systematic", "_FIRST_WEIGHT", 1e12),),
    "inflation gate": ((_TRACKS, "CALIBRATED.inflation_gate", 1e12),),
    "reacquisition gate": ((_TRACKS, "CALIBRATED.reacquisition_gate", 25.0),),
    "relocation": ((_TRACKS, "_RELOCATIONS", 10**9),),
    "one camera initialises a marker": ((_TRACKS, "_RAY_VIEWS", 10**9),),
    "depth from the hand's other markers": (("rhot_fusion.filter.acquisition", "_DEPTH_MARKERS", 10**9),),
    "hidden strip shifts the centroid": ((_PAINT, "_SHIFT", 0.0), (_PAINT, "_DOUBT", 0.0)),
    "side of the paint that is seen": ((_PAINT, "_SIDE", 0.0),),
    "direction of the adjoining skin": (("rhot_fusion.filter.visible_side", "_LEAST_SKIN", 10.0),),
    "paint cut off by the border": ((_PAINT, "_CUT", 0.0),),
    "reappearing paint": ((_PAINT, "_APPEARING", 0.0),),
    "slivers of paint": ((_PAINT, "_SLIVER_DOUBT", 0.0),),
    "skin on opposite sides of the paint": ((_PAINT, "_OPPOSITE", 0.0),),
    "paint hidden from all cameras": ((_PAINT, "_HIDDEN", 0.0),),
    "error of the calibration": (("rhot_fusion.filter.systematic", "CALIBRATION_DOUBT", 0.0),),
    "error of the paint model": (("rhot_fusion.filter.systematic", "_SHAPE", 0.0),),
    "bridge to a re-appearance (smoothing)": (("rhot_fusion.filter.smoothing.smoother", "_BRIDGE_S", 0.0),),
    "fast fingers diffuse faster": ((_HAND, "_MOST_ACTIVITY", 1.0),),
    "outliers of the patch lose weight": ((_HAND, "_TURN_OUTLIER", 1e6),),
    "a lost hand is looked for again": ((_SOLVER, "_LOST_S", 1e9),),
    "a quarter turn is corrected": ((_SOLVER, "_QUARTER_TURN", 1e9),),
}


@dataclass(frozen=True, slots=True)
class Sources:
    """Worlds to track.

    Attributes:
        of: whose constants are varied: with `detection` markers are found anew, with `feet` simulated persons walk.
        pictures: folders of rendered pictures, each with the folder that keeps its rig and its markers.
        data: folder with the recorded hands; None = no rigs of the family.
        seeds: of these rigs.
        seconds: of each clip.
        smooth: use later data, too.
    """

    of: str
    pictures: tuple[tuple[Path, Path], ...]
    data: Path | None
    seeds: tuple[int, ...]
    seconds: float
    smooth: bool


@dataclass(frozen=True, slots=True)
class Task:
    """One variant to run: its name, what it changes, and the worlds."""

    name: str
    change: Change
    sources: Sources


@contextmanager
def changed(change: Change) -> Iterator[None]:
    """Run the tracker with other values of its constants, also in modules that import them."""
    undo: list[tuple[Any, str, Any]] = []
    for module, name, value in change:
        whole, _, part = name.partition(".")
        constant = getattr(import_module(module), whole)
        if part:
            undo.append((constant, part, getattr(constant, part)))
            object.__setattr__(constant, part, value)
            continue
        for other in [found for path, found in list(sys.modules.items()) if path.startswith("rhot_")]:
            if other.__dict__.get(name) is constant:
                undo.append((other, name, constant))
                setattr(other, name, value)
    try:
        yield
    finally:
        for part, name, value in reversed(undo):
            object.__setattr__(part, name, value)


def variants(of: str) -> dict[str, Change]:
    """Return every term switched off and every constant halved and doubled, by name; only the hand has terms."""
    found = {f"without: {name}": change for name, change in TERMS.items()} if of == "hand" else {}
    for module in sorted(_modules(of)):
        for name, value in vars(import_module(module)).items():
            # An imported constant is varied where it is defined; whole numbers count rows and cameras.
            if name.isupper() and _is_measure(value) and f"\n{name}: Final" in _source(module):
                for factor in (0.5, 2.0):
                    key = f"{module.removeprefix('rhot_')}.{name.lower().lstrip('_')} × {factor:g}"
                    found[key] = ((module, name, _scaled(value, factor)),)
    return found


def _modules(of: str) -> Iterator[str]:
    for name in _PACKAGES[of]:
        package = import_module(name)
        yield name
        if hasattr(package, "__path__"):
            yield from (found.name for found in pkgutil.walk_packages(package.__path__, f"{name}."))


def _is_measure(value: Any) -> bool:
    return isinstance(value, float) or (isinstance(value, tuple) and all(isinstance(one, float) for one in value))


@cache
def _source(module: str) -> str:
    return inspect.getsource(import_module(module))


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_scaled(one, factor) for one in value)
    return value * factor


def run_variant(task: Task) -> tuple[str, dict[str, float]]:
    """Return a variant's name and its figures, each the mean over the worlds; none where it cannot compute."""
    try:
        with changed(task.change):
            worlds = _worlds(task.sources)
    except (np.linalg.LinAlgError, ArithmeticError, ValueError, IndexError, cv2.error):
        return task.name, {}
    names = dict.fromkeys(name for world in worlds for name in world)
    return task.name, {name: float(np.nanmean([w[name] for w in worlds if name in w])) for name in names}


def _worlds(sources: Sources) -> list[dict[str, float]]:
    """Return the figures of each world."""
    run = track_smoothly if sources.smooth else track
    worlds: list[dict[str, float]] = []
    for data, keep in sources.pictures:
        for name, rig, kept in _pictures(data, keep):
            frames = found_markers(rig, data, name, None) if sources.of == "detection" else kept
            score = score_messages(data, name, run(rig, iter(frames)))
            worlds.append(
                {
                    "median, mm": score.median_mm,
                    "p95, mm": score.p95_mm,
                    "joints, mm": score.joints_mm,
                    "coverage, %": score.coverage,
                }
            )
    if sources.of == "feet":
        worlds += [_walk_figures(seed, sources.seconds) for seed in sources.seeds]
    elif sources.data is not None:
        rigs = [_tracks(seed, sources.data, sources.seconds) for seed in sources.seeds]
        worlds += [_motion_figures(tracks, smooth=sources.smooth) for tracks in rigs]
    return worlds


@cache
def _pictures(data: Path, keep: Path) -> list[tuple[str, Rig, list[MarkerFrame]]]:
    rig = prepare_rig(data, keep / "rig", Measures.of(data))
    return [
        (name, at_rate_of(rig, load_recording(data / name)), found_markers(rig, data, name, keep, lambda: None))
        for name in SEQUENCES
    ]


@cache
def _tracks(seed: int, data: Path, seconds: float) -> Tracks:
    with TemporaryDirectory(prefix="rhot-ablation-") as folder:
        return make_tracks(seed, data, Path(folder) / "rig", seconds=seconds)


def _motion_figures(tracks: Tracks, *, smooth: bool) -> dict[str, float]:
    run = track_smoothly if smooth else track
    estimates, poses = tracked(run(tracks.rig, iter(tracks.frames)))
    points, hands = point_errors(tracks, estimates), hand_errors(tracks, poses)
    told = points.measured & (points.views >= 2)
    error_mm, ratio = 1e3 * points.error_offset_m[told], points.error_m[told] / points.sigma_m[told]
    return {
        "median, mm": float(np.median(error_mm)),
        "p95, mm": float(np.percentile(error_mm, 95)),
        "joints, mm": 1e3 * float(np.mean(hands.joints_m)),
        "coverage, %": 100.0 * coverage(tracks, estimates),
        "within two sigma, %": 100.0 * float((ratio <= 2.0).mean()),
        "swapped, %": 100.0 * float(points.swapped[points.measured].mean()),
    }


@cache
def _walk(seed: int, seconds: float) -> tuple[WalkerWorld, FeetConfig, list[tuple[float, DepthFrame]]]:
    """Return a simulated person, and each picture with the time at which it has arrived, seconds."""
    with TemporaryDirectory(prefix="rhot-ablation-") as folder:
        rig = write_walker_rig(Path(folder) / "rig", endpoint="tcp/127.0.0.1:7447")
    feet = rig.config.feet or FeetConfig()
    world = WalkerWorld(seed, person_of(BodyModel.from_config(rig.config.body), seed), "walk", feet=feet)
    camera = pinhole(feet.camera.width, feet.camera.height, world.intrinsics, np.empty(0))
    frames: list[tuple[float, DepthFrame]] = []
    timings = takewhile(lambda timing: timing.delivered_s <= seconds, map(world.timing, count()))
    for index, timing in enumerate(timings):
        # For a second in each three nothing is seen: what counts then is the sensor.
        if not timing.dropped and timing.t_s % 3.0 < 2.0:
            color, depth_mm = world.render(timing.t_s)
            t_ns = START_NS + round(1e9 * timing.t_s)
            frames.append((timing.delivered_s + COMPUTE_S, DepthFrame(t_ns, color, depth_mm, camera, index)))
    return world, feet, frames


def _walk_figures(seed: int, seconds: float) -> dict[str, float]:
    """Track a walk as the live service would, and compare the feet with the truth."""
    world, feet, frames = _walk(seed, seconds)
    tracker, heads, coming = FootCore(feet), Heads(world, seed), deque(frames)
    sensors = {side: SimulatedSource(world, side) for side in feet.feet}
    for sensor in sensors.values():
        sensor.open(START_NS)
    off_m, sides = [], 0
    for now_s in np.arange(0.0, seconds, STEP_S):
        now_ns = START_NS + round(1e9 * now_s)
        for pose in heads.until(now_s):
            tracker.add_head_pose(pose)
        for side, sensor in sensors.items():
            tracker.add_imu_samples(side, sensor.read(now_ns))
        while coming and coming[0][0] <= now_s:
            tracker.process(coming.popleft()[1])
        due_ns = tracker.due_ns(now_ns)
        truth = world.feet(np.array([1e-9 * (due_ns - START_NS)]))
        sides += len(sensors)
        off_m += [
            float(np.linalg.norm(np.array(message.position) - truth[message.side][0, :3, 3]))
            for _, message in tracker.poses(due_ns)
            if isinstance(message, FootPose)
        ]
    median, p95 = np.percentile(off_m, (50, 95)) if off_m else (np.nan, np.nan)
    return {"median, mm": 1e3 * median, "p95, mm": 1e3 * p95, "coverage, %": 100.0 * len(off_m) / sides}


def worst(figures: Mapping[str, float], base: Mapping[str, float]) -> tuple[float, str]:
    """Return by how much the worst figure is worse, percent or points (at least 0), and its name."""
    if not figures:
        return 100.0, "it cannot compute"
    worse = {}
    for name, value in figures.items():
        if name.endswith("mm"):
            worse[name] = 100.0 * (value / base[name] - 1.0)
        elif name.startswith("coverage"):
            worse[name] = base[name] - value
        elif name.startswith("swapped"):
            worse[name] = value - base[name]
        else:
            worse[name] = abs(value - 95.0) - abs(base[name] - 95.0)
    name = max(worse, key=lambda each: worse[each])
    return max(worse[name], 0.0), name


@click.command()
@click.argument("data_path", metavar="[DATA]", type=click.Path(path_type=Path), required=False)
@click.option(
    "--pictures",
    "picture_sets",
    nargs=2,
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="SET KEEP",
    help="A folder of rendered pictures, and the folder that keeps its rig and markers; may be repeated.",
)
@click.option(
    "--of", type=click.Choice(list(_PACKAGES)), default="hand", show_default=True, help="Whose numbers are varied."
)
@click.option(
    "--rigs",
    type=click.IntRange(min=0),
    default=6,
    show_default=True,
    help="Develop rigs of the family; of feet, simulated walks.",
)
@click.option("--first", type=click.IntRange(min=0), default=0, show_default=True, help="Number of the first rig.")
@click.option("--seconds", type=FiniteRange(min=1.0), default=2.5, show_default=True, help="Of each clip.")
@click.option("--terms", is_flag=True, help="Only whole terms.")
@click.option("--smooth", is_flag=True, help="With smoothing.")
@jobs_option("Variants at the same time.")
@json_option
def ablation(
    data_path: Path | None,
    picture_sets: tuple[tuple[Path, Path], ...],
    of: str,
    rigs: int,
    first: int,
    seconds: float,
    terms: bool,
    smooth: bool,
    jobs: int,
    json_path: Path | None,
) -> None:
    """Switch off each term, and halve and double each number, of fusion and ik, of detection, or of feet.

    DATA is the folder of recorded hands, as for `rhot evaluate motion`. The table holds what any figure loses: percent
    of errors, points of shares. What loses less than 3 either way has to justify itself otherwise.
    """
    check_output("--json", json_path)
    sets = tuple((require_pictures(data), keep) for data, keep in picture_sets)
    seeds = tuple(2 * number for number in range(first, first + rigs)) if data_path or of == "feet" else ()
    sources = Sources(of, sets, data_path, seeds, seconds, smooth)
    chosen = {name: change for name, change in variants(of).items() if not terms or name.startswith("without")}
    work = [Task("as it is", (), sources), *(Task(name, change, sources) for name, change in chosen.items())]
    found: dict[str, dict[str, float]] = {}
    with counted(Console(stderr=True, soft_wrap=True)) as progress:
        task = progress.add_task("variants", total=len(work))
        for name, figures in map(run_variant, work) if jobs == 1 else each(run_variant, work, jobs):
            found[name] = figures
            progress.advance(task)
    base = found.pop("as it is")
    rows = []
    for name, figures in sorted(found.items(), key=lambda item: -worst(item[1], base)[0]):
        loss, figure = worst(figures, base)
        rows.append(Row(name, loss, "%", note=f"worst figure: {figure}" if loss >= EARNS else ""))
    numbers = {name.rpartition(" × ")[0] for name in found if " × " in name}
    earning = {name.rpartition(" × ")[0] for name in found if " × " in name and worst(found[name], base)[0] >= EARNS}
    about = tuple(Row(name, value) for name, value in base.items())
    counts = (Row("numbers", len(numbers)), Row("numbers that earn 3 % either way", len(earning)))
    sections = [Section("as it is", about), Section("what is lost, worst first", tuple(rows))]
    show("evaluate ablation", [*sections, Section("sum", counts)] if numbers else sections, json_path)
