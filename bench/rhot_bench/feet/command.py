"""`rhot evaluate feet`: feet of a simulated person, beside the 2021 thesis's tracker."""

from __future__ import annotations

import io
import json
import os
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import click
import numpy as np
from rich.console import Console

from rhot.arrays import BoolArray, FloatArray
from rhot.atomic_file import write_atomic
from rhot.cli.options import jobs_option, rig_folder_option
from rhot.errors import ConfigError
from rhot.messages import Side
from rhot.report.svg import line_plot
from rhot.rig import Rig, load_rig
from rhot.rig.folder import write_text_atomic
from rhot_bench import processes
from rhot_bench.feet.runs import COMPUTE_S, LEARN_S, SIDES, STAGES, FootTrajectory, Played, Run, play
from rhot_bench.feet.stages import CELLS, TASKS, cell_plots, cell_rows, printed_m, table_5_1, table_5_1_rows
from rhot_sim.walker.folder import write_walker_rig
from rhot_tools.measures.output import (
    counted,
    duration_option,
    html_report,
    json_option,
    page_option,
    show,
)
from rhot_tools.measures.provenance import provenance
from rhot_tools.measures.rows import Row, Section, check_output

# What the simulated runs of the foot tracker come to, as tables.

SETTLE_S: Final = 2.0
"""Averages are taken from here on; what is worst counts from the start."""
MM: Final = 1e3
MOVING: Final = 0.05
"""m/s; a foot that is slower stands."""
_BACK_S: Final = 0.1
_BACK_WITHIN_M: Final = 0.02
_SQUAT: Final = "task_squat"
_NONE: Final = STAGES.index("none")
_DEPTH: Final = STAGES.index("depth")
_MARKER: Final = STAGES.index("marker")
_AVERAGED: Final = f"measured feet from {SETTLE_S:g} s on, at the pose's own time; worst from the start"
EXTRA_TASKS: Final = ("on_spot", "walk", "curve", "step_over", "squat")
"""Ours, beside those of the thesis."""

Chosen = Callable[[Played, FootTrajectory], BoolArray]
Done = Mapping[str, Sequence[Played]]


def feet_sections(done: Done) -> list[Section]:
    """Return the tables of what was played, run name to its seeds."""
    sections = [
        Section("The 2021 thesis's tests", tuple(_stationary_rows(done))),
        Section("The thesis's 4 tests in its 3 stages", tuple(cell_rows(done))),
        Section("Walking, with false markers thrown into the picture", tuple(_task_rows(done))),
        Section("The thesis's Table 5.1", tuple(table_5_1_rows(done))),
        Section("Knees", tuple(_knee_rows(done))),
        Section("Time", tuple(_time_rows(done))),
        Section("How much is tracked", tuple(_coverage_rows(done))),
    ]
    return [section for section in sections if section.rows]


def _stationary_rows(done: Done) -> list[Row]:
    rows: list[Row] = []
    if "still" in done:
        rows += _pair("standing still, average", done["still"], np.mean, 1.0, "3.0 mm", _always)
    if "marker_moving" in done:
        rows += _pair("marker moving, average", done["marker_moving"], np.mean, 8.0, "33.6 mm", _moving)
        rows += _pair("marker moving, worst", done["marker_moving"], np.max, 35.0, "124 mm", _moving)
    if "head_moving" in done:
        rows += _pair("head moving, average", done["head_moving"], np.mean, 8.0, "35.4 mm", _always)
    if "sudden" in done:
        rows += _pair("sudden move, average", done["sudden"], np.mean, None, "", _moving)
        rows += _pair("sudden move, worst", done["sudden"], np.max, None, "", _moving)
    if "marker_moving_depth" in done:
        rows += _pair("by depth, moving, average", done["marker_moving_depth"], np.mean, 15.0, "41.0 mm", _by_depth)
    if "inertial" in done:
        ends, backs = _hidden(done["inertial"])
        note = "no picture for 1 s from the moment at which the foot lifts off; predicted poses count, too"
        rows += [
            Row("by inertial, 1 s after it was hidden in a step, average", _of(np.mean, ends), "mm", most=60.0,
                peer="169 mm", note=note),
            Row("the same, worst", _of(np.max, ends), "mm", peer="481 mm", note=note),
            Row("within 20 mm, 0.1 s after its marker is believed again",
                float(100.0 * np.mean(backs)) if len(backs) else np.nan, "%", least=100.0),
        ]  # fmt: skip
    return rows


def _task_rows(done: Done) -> list[Row]:
    rows: list[Row] = []
    for task in (*TASKS, *EXTRA_TASKS):
        if f"task_{task}" in done:
            played = done[f"task_{task}"]
            printed = [f"{MM * low:.0f}-{MM * high:.0f} mm" for low, high in printed_m(task)] or ["", ""]
            rows += _pair(f"{task}, median", played, np.median, 10.0, printed[0], _always)
            rows += _pair(f"{task}, worst", played, np.max, 150.0, printed[1], _tracked)
            guessed = [each.ours[side].error_m[~each.ours[side].measured] for each in played for side in SIDES]
            worst_mm = _of(np.max, np.concatenate(guessed))
            if np.isfinite(worst_mm):
                rows.append(Row("    worst while only predicted", worst_mm, "mm", most=150.0))
    return rows


def _knee_rows(done: Done) -> list[Row]:
    rows = []
    backwards = sum(each.knees_backwards for played in done.values() for each in played)
    for name, played in done.items():
        if name.startswith("height_"):
            errors = np.concatenate([each.knee_error_m for each in played])
            rows.append(Row(f"{name.removeprefix('height_')} m, mean error", _of(np.mean, errors), "mm", most=40.0))
    if _SQUAT in done:
        errors = np.concatenate([each.knee_error_m for each in done[_SQUAT]])
        rows.append(Row("squats and kneels, mean error", _of(np.mean, errors), "mm", most=40.0))
    return [*rows, Row("frames with a knee bent backwards, all runs", float(backwards), "", most=0.0)]


def _time_rows(done: Done) -> list[Row]:
    played = [each for several in done.values() for each in several]
    pictures = np.concatenate([each.picture_s for each in played])
    poses = np.concatenate([each.pose_s for each in played])
    late = np.concatenate([each.late_s[each.t_s > SETTLE_S] for each in played])
    cores = 60.0 * float(pictures.mean()) + 100.0 * float(poses.mean())
    latency = late + float(poses.mean())
    note = (
        "from the time for which a pose is true until it is there: wire of the newest sample, waiting for the next of "
        "100 polls a second, computing; a picture, 25 ms and more on its way, corrects poses but does not delay them, "
        f"and is used {MM * COMPUTE_S:.0f} ms after it arrives"
    )
    return [
        Row("latency, average", MM * float(latency.mean()), "ms", most=20.0, peer="314-369 ms", note=note),
        Row("latency, p99", MM * float(np.percentile(latency, 99)), "ms"),
        Row("processor time per picture", MM * float(pictures.mean()), "ms"),
        Row("processor time per publication of both feet, samples included", MM * float(poses.mean()), "ms"),
        Row("one core at 60 pictures and 2x100 samples a second", 100.0 * cores, "%", most=60.0,
            note="processor time, without drivers and bus"),
    ]  # fmt: skip


def _coverage_rows(done: Done) -> list[Row]:
    rows = []
    for name, played in done.items():
        tracks = [each.ours[side] for each in played for side in SIDES]
        stages = np.concatenate([track.stage for track in tracks])
        shares = [f"{stage} {100.0 * np.mean(stages == k):.0f} %" for k, stage in enumerate(STAGES)]
        if name == _SQUAT:
            hidden = 100.0 * float(np.mean(stages == _NONE))
            rows.append(Row("squats and kneels: not published", hidden, "%", most=10.0))
        measured = np.concatenate([track.measured for track in tracks])
        rows.append(Row(f"{name}: measured", 100.0 * float(measured.mean()), "%", note=f"{name}: {', '.join(shares)}"))
    return rows


def _pair(
    name: str,
    played: Sequence[Played],
    figure: Callable[[FloatArray], np.floating],
    most: float | None,
    published: str,
    chosen: Chosen,
) -> list[Row]:
    """Return rows of ours, of the thesis's tracker on the same data at the same times, and of how seeds differ."""
    ours = [[each.ours[side].error_m[chosen(each, each.ours[side])] for side in SIDES] for each in played]
    theirs = [each.thesis[side].error_m[chosen(each, each.ours[side])] for each in played for side in SIDES]
    rows = [
        Row(name, _of(figure, np.concatenate([error for feet in ours for error in feet])), "mm", most=most,
            peer=published, note=_AVERAGED),
        Row("    the thesis's tracker on the same data", _of(figure, np.concatenate(theirs)), "mm"),
    ]  # fmt: skip
    if len(played) > 1:
        by_seed = np.array([_of(figure, np.concatenate(feet)) for feet in ours])
        by_seed = by_seed[np.isfinite(by_seed)]
        for word, of_seeds in (("median", np.median), ("worst", np.max)):
            value = float(of_seeds(by_seed)) if len(by_seed) else float("nan")
            rows.append(Row(f"    {word} of the seeds", value, "mm"))
    return rows


def _of(figure: Callable[[FloatArray], np.floating], values_m: FloatArray) -> float:
    finite = values_m[np.isfinite(values_m)]
    return MM * float(figure(finite)) if len(finite) else float("nan")


def _always(played: Played, track: FootTrajectory) -> BoolArray:
    chosen: BoolArray = (played.t_s >= SETTLE_S) & track.measured
    return chosen


def _moving(played: Played, track: FootTrajectory) -> BoolArray:
    return _always(played, track) & (track.speed > MOVING)


def _by_depth(played: Played, track: FootTrajectory) -> BoolArray:
    chosen: BoolArray = _moving(played, track) & (track.stage == _DEPTH) & (played.t_s > LEARN_S)
    return chosen


def _tracked(played: Played, track: FootTrajectory) -> BoolArray:
    return track.measured


def _hidden(played: Sequence[Played]) -> tuple[FloatArray, BoolArray]:
    """Return the errors when pictures come back, and whether they are small 0.1 s after the marker is believed again.

    A foot whose marker does not come back before the run ends counts in the first alone.
    """
    ends: list[float] = []
    backs: list[bool] = []
    for each in played:
        for (_, end_s), side in zip(each.blackouts, each.blackout_sides, strict=True):
            track = each.ours[side]
            end = int(np.searchsorted(each.t_s, end_s))
            ends.append(float(track.error_m[end - 1]))
            seen = np.flatnonzero(track.stage[end:] == _MARKER)
            if len(seen):
                back = min(int(np.searchsorted(each.t_s, each.t_s[end + seen[0]] + _BACK_S)), len(each.t_s) - 1)
                backs.append(float(track.error_m[back]) <= _BACK_WITHIN_M)
    return np.array(ends), np.array(backs, dtype=np.bool_)


# Finished runs as files, so that an interrupted `rhot evaluate feet` goes on where it was.
#
# One file holds one run of one person. It counts only for the same run, rig, length and version of the code; anything
# else is played again.

_TRACKERS = ("ours", "thesis")
_ARRAYS = ("t_s", "late_s", "blackouts", "picture_s", "pose_s", "knee_error_m")
_VALUES = ("blackout_sides", "knees_backwards", "counts")


def make_folder(folder: Path) -> None:
    """Make a folder for finished runs where there is none.

    Raises:
        ConfigError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot keep finished runs here: {error}; name another folder") from error


def key_of(run: Run, rig: Rig, seed: int, seconds: float, commit: str | None) -> str:
    """Return what a finished run depends on, as text."""
    # The rest of a rig names folders, which differ each time when it is a temporary one.
    used = rig.config.model_dump(mode="json", include={"feet", "body"})
    return json.dumps([asdict(run), used, seed, seconds, commit], sort_keys=True)


def save_played(file: Path, key: str, played: Played) -> None:
    """Write a finished run.

    Raises:
        ConfigError: it cannot be written.
    """
    values = {name: getattr(played, name) for name in _VALUES}
    arrays: dict[str, Any] = {"key": np.array(key), "values": np.array(json.dumps(values))}
    arrays |= {name: getattr(played, name) for name in _ARRAYS}
    for tracker in _TRACKERS:
        for side, track in getattr(played, tracker).items():
            arrays |= {f"{tracker} {side} {part.name}": getattr(track, part.name) for part in fields(FootTrajectory)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomic(file, buffer.getvalue())


def load_played(file: Path, key: str, run: Run, seed: int) -> Played | None:
    """Return a finished run; None when there is none, or one of something else."""
    try:
        with np.load(file, allow_pickle=False) as stored:
            if str(stored["key"]) != key:
                return None
            return _played(dict(stored), run, seed)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _played(stored: dict[str, Any], run: Run, seed: int) -> Played:
    values: dict[str, Any] = {name: stored[name] for name in _ARRAYS} | json.loads(str(stored["values"]))
    for tracker in _TRACKERS:
        values[tracker] = {
            side: FootTrajectory(
                **{part.name: stored[f"{tracker} {side} {part.name}"] for part in fields(FootTrajectory)}
            )
            for side in SIDES
        }
    return Played(run=run, seed=seed, **values)


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
@duration_option(5, 600, 8.0, "Seconds of each run; drawing and tracking take about twice as long.")
@jobs_option(
    "Runs at once. Processor times are most accurate with 1.", os.cpu_count() or 1, show_default="all processors"
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
@rig_folder_option("Rig with [feet], whose camera, markers and settings are used; a temporary one when not given.")
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
        for task, played in zip(tasks, processes.each(_play, tasks, jobs), strict=True):
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
