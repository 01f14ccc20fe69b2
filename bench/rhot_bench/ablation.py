"""`rhot evaluate ablation`: what each term and each number of fusion and ik earns.

Every constant of the modules of both estimators is halved and doubled, and every term of `TERMS` is switched off, one
at a time. Each variant tracks the same detected markers, of sets of rendered pictures and of rigs
of the motion family. A figure is the mean over these worlds; its change is told against the tracker as it is.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import click
import numpy as np
from rich.console import Console

from rhot.cli.options import FiniteRange
from rhot.messages import MarkerFrame
from rhot.offline import track, track_smoothly
from rhot.recording import load_recording
from rhot.rig import Rig
from rhot_bench.motion.errors import coverage, hand_errors, point_errors
from rhot_bench.motion.run import tracked
from rhot_bench.motion.tracks import Tracks, make_tracks
from rhot_bench.pictures.rendered import SEQUENCES, Measures, at_rate_of, found_markers, prepare_rig, require_pictures
from rhot_bench.pictures.scoring import score_messages
from rhot_bench.processes import each
from rhot_tools.measures.output import counted, json_option, show
from rhot_tools.measures.rows import Row, Section, check_output

EARNS: Final = 3.0
"""Change of a figure, percent (of coverage and honesty: points), from which on a term or a number earns its place."""

Change = tuple[tuple[str, str, Any], ...]
"""Module, name and value of everything that a variant changes; a dot in the name: an attribute of it."""

_MODULES: Final = (
    "rhot_fusion.filter.acquisition",
    "rhot_fusion.filter.joint",
    "rhot_fusion.filter.motion",
    "rhot_fusion.filter.paint",
    "rhot_fusion.filter.smoothing.smoother",
    "rhot_fusion.filter.systematic",
    "rhot_fusion.filter.tracker",
    "rhot_fusion.filter.tracks",
    "rhot_fusion.filter.visible_side",
    "rhot_ik.hand.blending",
    "rhot_ik.hand.solver",
    "rhot_ik.hand.filter.evidence",
    "rhot_ik.hand.filter.filter",
    "rhot_ik.hand.filter.process",
)
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
    "paint hidden from all cameras": ((_PAINT, "_HIDDEN", 0.0),),
    "error of the calibration": (("rhot_fusion.filter.systematic", "CALIBRATION_DOUBT", 0.0),),
    "error of the paint model": (("rhot_fusion.filter.systematic", "_SHAPE", 0.0),),
    "bridge to a re-appearance (smoothing)": (("rhot_fusion.filter.smoothing.smoother", "_BRIDGE_S", 0.0),),
    "palm shares the patch's offset": ((_SOLVER, "_PALM_SHARE", 0.0),),
    "fast fingers diffuse faster": ((_HAND, "_MOST_ACTIVITY", 1.0),),
    "outliers of tips lose weight": ((_HAND, "_OUTLIER", 1e6),),
    "outliers of the patch lose weight": ((_HAND, "_TURN_OUTLIER", 1e6),),
    "a lost hand is looked for again": ((_SOLVER, "_LOST_S", 1e9),),
    "a quarter turn is corrected": ((_SOLVER, "_QUARTER_TURN", 1e9),),
    "fingers blend in": (("rhot_ik.hand.blending", "_STEP_M", 1e3), ("rhot_ik.hand.blending", "_FIRST_M", 1e3)),
}


@dataclass(frozen=True, slots=True)
class Sources:
    """Worlds to track.

    Attributes:
        pictures: folders of rendered pictures, each with the folder that keeps its rig and its markers.
        data: folder with the recorded hands; None = no rigs of the family.
        seeds: of these rigs.
        seconds: of each clip.
        smooth: use later data, too.
    """

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
        for other in [sys.modules[one] for one in _MODULES if one in sys.modules]:
            if other.__dict__.get(name) is constant:
                undo.append((other, name, constant))
                setattr(other, name, value)
    try:
        yield
    finally:
        for part, name, value in reversed(undo):
            object.__setattr__(part, name, value)


def variants() -> dict[str, Change]:
    """Return every term switched off and every constant halved and doubled, by name."""
    found = {f"without: {name}": change for name, change in TERMS.items()}
    for module in _MODULES:
        for name, value in vars(import_module(module)).items():
            # An imported constant is varied where it is defined; whole numbers count rows and cameras.
            if name.isupper() and _is_measure(value) and f"\n{name}: Final" in _source(module):
                for factor in (0.5, 2.0):
                    key = f"{module.removeprefix('rhot_')}.{name.lower().lstrip('_')} × {factor:g}"
                    found[key] = ((module, name, _scaled(value, factor)),)
    return found


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
    """Return a variant's name and its figures, each the mean over the worlds."""
    sources = task.sources
    run = track_smoothly if sources.smooth else track
    worlds = []
    with changed(task.change):
        for data, keep in sources.pictures:
            for name, rig, frames in _pictures(data, keep):
                score = score_messages(data, name, run(rig, iter(frames)))
                worlds.append(
                    {
                        "median, mm": score.median_mm,
                        "p95, mm": score.p95_mm,
                        "joints, mm": score.joints_mm,
                        "coverage, %": score.coverage,
                    }
                )
        if sources.data is not None:
            rigs = [_tracks(seed, sources.data, sources.seconds) for seed in sources.seeds]
            worlds += [_motion_figures(tracks, smooth=sources.smooth) for tracks in rigs]
    names = dict.fromkeys(name for world in worlds for name in world)
    return task.name, {name: float(np.nanmean([w[name] for w in worlds if name in w])) for name in names}


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


def worst(figures: Mapping[str, float], base: Mapping[str, float]) -> tuple[float, str]:
    """Return by how much the worst figure is worse, percent or points (at least 0), and its name."""
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
@click.option("--rigs", type=click.IntRange(min=0), default=6, show_default=True, help="Develop rigs of the family.")
@click.option("--first", type=click.IntRange(min=0), default=0, show_default=True, help="Number of the first rig.")
@click.option("--seconds", type=FiniteRange(min=1.0), default=2.5, show_default=True, help="Of each clip.")
@click.option("--terms", is_flag=True, help="Only whole terms.")
@click.option("--smooth", is_flag=True, help="With smoothing.")
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Variants at the same time.")
@json_option
def ablation(
    data_path: Path | None,
    picture_sets: tuple[tuple[Path, Path], ...],
    rigs: int,
    first: int,
    seconds: float,
    terms: bool,
    smooth: bool,
    jobs: int,
    json_path: Path | None,
) -> None:
    """Switch off each term, and halve and double each number, of fusion and ik.

    DATA is the folder of recorded hands, as for `rhot evaluate motion`. The table holds what any figure loses: percent
    of errors, points of shares. What loses less than 3 either way has to justify itself otherwise.
    """
    check_output("--json", json_path)
    sets = tuple((require_pictures(data), keep) for data, keep in picture_sets)
    seeds = tuple(2 * number for number in range(first, first + rigs)) if data_path else ()
    sources = Sources(sets, data_path, seeds, seconds, smooth)
    chosen = {name: change for name, change in variants().items() if not terms or name.startswith("without")}
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
