"""What the simulated runs of the foot tracker come to, as tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot_bench.feet.runs import COMPUTE_S, LEARN_S, SIDES, STAGES, Played, Track
from rhot_bench.feet.stages import cell_rows
from rhot_bench.feet.table_5_1 import TASKS, printed_m, table_5_1_rows
from rhot_tools.measures.rows import Row, Section

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

Chosen = Callable[[Played, Track], BoolArray]
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


def _always(played: Played, track: Track) -> BoolArray:
    chosen: BoolArray = (played.t_s >= SETTLE_S) & track.measured
    return chosen


def _moving(played: Played, track: Track) -> BoolArray:
    return _always(played, track) & (track.speed > MOVING)


def _by_depth(played: Played, track: Track) -> BoolArray:
    chosen: BoolArray = _moving(played, track) & (track.stage == _DEPTH) & (played.t_s > LEARN_S)
    return chosen


def _tracked(played: Played, track: Track) -> BoolArray:
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
