"""`rhot evaluate feet`: feet of a simulated person, beside the 2021 thesis's tracker."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import click
from rich.console import Console

from rhot.cli.options import FiniteRange
from rhot.errors import ConfigError
from rhot.messages import Side
from rhot.report.svg import line_plot
from rhot.rig import Rig, load_rig
from rhot.rig.folder import write_text_atomic
from rhot_bench.feet.kept import key_of, load_played, make_folder, save_played
from rhot_bench.feet.runs import SIDES, Played, Run, play
from rhot_bench.feet.sections import EXTRA_TASKS, MM, feet_sections
from rhot_bench.feet.stages import CELLS, cell_plots
from rhot_bench.feet.table_5_1 import TASKS, table_5_1
from rhot_bench.processes import each
from rhot_sim.walker.folder import write_walker_rig
from rhot_tools.measures.html import html_report
from rhot_tools.measures.output import counted, json_option, page_option, show
from rhot_tools.measures.provenance import provenance
from rhot_tools.measures.rows import check_output

HEIGHTS_M: Final = (1.50, 1.60, 1.75, 1.90, 2.00)
RUNS: Final = {
    run.name: run
    for run in (
        Run("still", "still", hems=False),
        Run("marker_moving", "marker_moving", hems=False),
        Run("head_moving", "head_moving", hems=False),
        Run("sudden", "sudden", hems=False),
        *(cell.run for cell in CELLS if cell.stage != "marker"),
        Run("inertial", "walk", blackouts=True),
        *(Run(f"task_{task}", task, false_markers=True) for task in (*TASKS, *EXTRA_TASKS)),
        *(Run(f"height_{height_m:.2f}", "walk", height_m=height_m) for height_m in HEIGHTS_M),
    )
}
_LONGER: Final = {"inertial": 2.0, "task_line": 1.5, "task_circle": 1.5} | {
    cell.run.name: 2.0 for cell in CELLS if cell.stage == "inertial"
}
"""A sensor has to be aligned first, and only some steps are hidden; two metres take their time."""
_WITHOUT: Final[dict[str, tuple[Side, ...]]] = {"left": ("left",), "right": ("right",), "both": SIDES, "none": ()}


@click.command()
@click.option(
    "--runs", metavar="NAMES", help=f"Only these runs, separated by commas: {', '.join(RUNS)}. All when not given."
)
@click.option("--seeds", type=click.IntRange(1, 100), default=2, show_default=True, help="Number of persons per run.")
@click.option(
    "--duration",
    "duration_s",
    type=FiniteRange(5, 600),
    default=8.0,
    show_default=True,
    help="Seconds of each run; drawing and tracking take about twice as long.",
)
@click.option(
    "--jobs",
    type=click.IntRange(1, 64),
    default=os.cpu_count() or 1,
    show_default="all processors",
    help="Runs at once. Processor times are most accurate with 1.",
)
@click.option(
    "--without-imu",
    "without_imu",
    type=click.Choice(list(_WITHOUT)),
    default="left",
    show_default=True,
    help="Foot that wears no sensor in the thesis's walking tasks; the thesis had one on the right foot alone.",
)
@click.option(
    "--keep",
    "keep_path",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for finished runs: the same command goes on there after an interruption.",
)
@json_option
@page_option("--html")
@click.option(
    "--rig",
    "rig_path",
    type=click.Path(path_type=Path, file_okay=False),
    help="Rig with [feet], whose camera, markers and settings are used; a temporary one when not given.",
)
def feet(
    runs: str | None,
    seeds: int,
    duration_s: float,
    jobs: int,
    without_imu: str,
    keep_path: Path | None,
    json_path: Path | None,
    page_path: Path | None,
    rig_path: Path | None,
) -> None:
    """Track the feet of a simulated person and compare with the truth.

    Pictures of a head-worn depth camera and samples of ankle sensors, with all their faults and delays, go through the
    core of the feet service that runs live. For comparison, the 2021 thesis's tracker runs on the same data, and the
    thesis's own measurements are listed.

    \b
    still, marker_moving, head_moving, sudden   the thesis's tests
    *_depth    the same with the markers covered after four seconds
    *_inertial the same without pictures for a second, again and again
    inertial   no pictures for a second, again and again, as a walker's foot lifts off
    task_*     its six walking tasks, then five of ours, with false markers
    height_*   knees of persons from 1.50 to 2.00 m
    """
    check_output("--json", json_path)
    check_output("--html", page_path)
    if keep_path is not None:
        make_folder(keep_path)
    chosen = [_bare(run, _WITHOUT[without_imu]) for run in _chosen(runs)]
    console = Console(stderr=True, soft_wrap=True)
    done: dict[str, list[Played]] = {run.name: [] for run in chosen}
    kept = None if keep_path is None else _Kept(keep_path, provenance()["commit"])
    with counted(console) as progress, tempfile.TemporaryDirectory() as folder:
        rig = _rig(rig_path, Path(folder) / "rig")
        tasks = [
            _Task(run, rig, seed, duration_s * _LONGER.get(run.name, 1.0), kept)
            for seed in range(1, seeds + 1)
            for run in chosen
        ]
        bar = progress.add_task(f"{jobs} at once", total=len(tasks))
        for task, played in zip(tasks, each(_play, tasks, jobs), strict=True):
            done[task.run.name].append(played)
            progress.update(bar, advance=1, description=f"{task.run.name}, {task.seed} of {seeds}")
    sections = feet_sections(done)
    layout = table_5_1(done)
    if layout.rows:
        Console().print(layout.table())
    show("evaluate feet", sections, json_path, seeds=seeds, seconds=duration_s, runs=[run.name for run in chosen])
    if page_path is not None:
        text = f"Simulated persons, seeds 1 to {seeds}, {duration_s:g} s each. Truth is the centre of each marker."
        write_text_atomic(
            page_path,
            html_report("Feet against truth", text, sections, [layout.html(), *cell_plots(done), *_plots(done)]),
        )
        console.print(f"report: {page_path}", markup=False)


@dataclass(frozen=True, slots=True)
class _Kept:
    """Where finished runs are kept, and of which version of the code they are."""

    folder: Path
    commit: str | None


@dataclass(frozen=True, slots=True)
class _Task:
    run: Run
    rig: Rig
    seed: int
    seconds: float
    kept: _Kept | None


def _play(task: _Task) -> Played:
    if task.kept is None:
        return play(task.run, task.rig, task.seed, task.seconds)
    file = task.kept.folder / f"{task.run.name}-{task.seed}.npz"
    key = key_of(task.run, task.rig, task.seed, task.seconds, task.kept.commit)
    played = load_played(file, key, task.run, task.seed)
    if played is None:
        played = play(task.run, task.rig, task.seed, task.seconds)
        save_played(file, key, played)
    return played


def _chosen(names: str | None) -> list[Run]:
    wanted = list(RUNS) if names is None else [name.strip() for name in names.split(",") if name.strip()]
    unknown = [name for name in wanted if name not in RUNS]
    if unknown or not wanted:
        raise ConfigError(f"--runs {names}: {', '.join(unknown) or 'nothing'} is no run; there are {', '.join(RUNS)}")
    return [RUNS[name] for name in wanted]


def _bare(run: Run, without_imu: tuple[Side, ...]) -> Run:
    return replace(run, without_imu=without_imu) if run.name.removeprefix("task_") in TASKS else run


def _rig(given: Path | None, temporary: Path) -> Rig:
    if given is None:
        return write_walker_rig(temporary, endpoint="tcp/127.0.0.1:7447")
    rig = load_rig(given)
    if rig.config.feet is None or len(rig.config.feet.feet) < len(SIDES):
        raise ConfigError(f"--rig {given}: both [feet.left] and [feet.right] are needed")
    return rig


def _plots(done: dict[str, list[Played]]) -> list[str]:
    plots = []
    for name, played in done.items():
        first = played[0]
        lines = {f"{side}, ours": (first.t_s, MM * first.ours[side].error_m) for side in SIDES}
        lines |= {f"{side}, thesis": (first.t_s, MM * first.thesis[side].error_m) for side in SIDES}
        plots.append(line_plot(f"Error over time, {name}, seed {first.seed}", "time [s]", "error [mm]", lines))
    return plots
