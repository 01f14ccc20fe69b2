"""The 2021 thesis's 4 tests in each of its 3 stages, as a table and as plots like its figures 5.6 to 5.17.

In the marker stage nothing is hidden; in the depth stage the markers are covered after a while; in the inertial stage
no picture comes for a second, again and again. Every pose that is published counts, predicted ones too, and the
thesis's tracker is judged at the same moments. Where a foot is moved about, only moments at which it moves count.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final, Literal

import numpy as np
from rich.table import Table

from rhot.arrays import BoolArray, FloatArray
from rhot.report.html import figures_table
from rhot.report.svg import line_plot
from rhot.rig.feet_config import WalkProgram
from rhot_bench.feet.runs import LEARN_S, SIDES, FootTrajectory, Played, Run
from rhot_tools.measures.rows import Row

# Table 5.1 of the 2021 thesis: its six walking tasks, foot with and without inertial sensor, average, median, worst.
#
# Every pose that is published counts, from the first moment on and predicted ones too; the thesis's tracker is judged
# at the same moments.

Three = tuple[float, float, float]

TASKS: Final = ("step", "side_steps", "line", "circle", "bend_knees", "turn_body")
_TITLES: Final = {
    "step": "one step forward and back",
    "side_steps": "sideways steps",
    "line": "straight line of 2 m",
    "circle": "circle of 2 m",
    "bend_knees": "bending the knees",
    "turn_body": "turning the upper body",
}
PRINTED_M: Final[dict[str, dict[bool, Three]]] = {
    "step": {False: (0.192, 0.034, 1.83), True: (0.051, 0.026, 0.28)},
    "side_steps": {False: (0.135, 0.044, 0.54), True: (0.065, 0.032, 0.33)},
    "line": {False: (0.085, 0.025, 0.63), True: (0.062, 0.025, 0.39)},
    "circle": {False: (0.210, 0.088, 1.96), True: (0.223, 0.080, 0.98)},
    "bend_knees": {False: (0.046, 0.032, 0.17), True: (0.043, 0.024, 0.16)},
    "turn_body": {False: (0.141, 0.049, 1.15), True: (0.114, 0.024, 1.17)},
}
"""Average, median and worst as printed, metres; False = the foot without a sensor (left), True = the one with it."""
_FIGURES: Final = ("average", "median", "worst")
_HEAD: Final = ("task", "foot", "ours", "its tracker here", "printed", "published")
_TABLE_5_1_MM: Final = 1e3


@dataclass(frozen=True, slots=True)
class Layout:
    """The table in the thesis's layout; each cell of three holds average / median / worst, millimetres.

    Attributes:
        rows: task, foot, ours, the thesis's tracker on the same data, as printed, share published.
    """

    rows: tuple[tuple[str, ...], ...]

    def table(self) -> Table:
        """Return it for the terminal."""
        table = figures_table(title="The thesis's Table 5.1: average / median / worst, mm")
        for column in _HEAD:
            table.add_column(column, justify="left" if column in _HEAD[:2] else "right")
        for row in self.rows:
            table.add_row(*row)
        return table

    def html(self) -> str:
        """Return it for a page; empty when none of the tasks was played."""
        if not self.rows:
            return ""
        head = "".join(f"<th>{name}</th>" for name in _HEAD)
        body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in self.rows)
        return f"<h2>The thesis's Table 5.1: average / median / worst, mm</h2><table><tr>{head}</tr>{body}</table>"


def table_5_1(done: Mapping[str, Sequence[Played]]) -> Layout:
    """Return the table of the tasks that were played."""
    rows = []
    for task, foot, has_imu, ours, theirs, share in _each(done):
        printed = tuple(_TABLE_5_1_MM * value for value in PRINTED_M[task][has_imu])
        rows.append((_TITLES[task], foot, _three(ours), _three(theirs), _three(printed), f"{share:.0f} %"))
    return Layout(tuple(rows))


def table_5_1_rows(done: Mapping[str, Sequence[Played]]) -> list[Row]:
    """Return the same as single figures, and in how many columns all three of ours are less than the thesis's."""
    rows = []
    better = []
    for task, foot, has_imu, ours, theirs, share in _each(done):
        note = f"{_TITLES[task]}, {foot}: {share:.0f} % of the moments published"
        for k, name in enumerate(_FIGURES):
            peer = f"{_TABLE_5_1_MM * PRINTED_M[task][has_imu][k]:.0f} mm; its tracker here {theirs[k]:.0f} mm"
            rows.append(Row(f"{_TITLES[task]}, {foot}, {name}", ours[k], "mm", peer=peer, note=note))
        better.append(all(mine < their for mine, their in zip(ours, theirs, strict=True)))
    if rows:
        text = f"columns of {len(better)} in which ours errs less than the thesis's tracker: average, median and worst"
        rows.append(Row(text, float(sum(better)), "", least=float(len(better))))
    return rows


def printed_m(task: str) -> list[tuple[float, float]]:
    """Return the printed median and worst of both feet, lower one first, metres; empty for other tasks."""
    feet = PRINTED_M.get(task, {}).values()
    return [(min(values), max(values)) for values in list(zip(*feet, strict=True))[1:]]


def _each(done: Mapping[str, Sequence[Played]]) -> Iterator[tuple[str, str, bool, Three, Three, float]]:
    """Yield task, foot, whether it wears a sensor, ours and the thesis's tracker in mm, and the share published, %."""
    for task in TASKS:
        played = done.get(f"task_{task}")
        if not played:
            continue
        for side in SIDES:
            has_imu = side not in played[0].run.without_imu
            foot = f"{side}, {'with' if has_imu else 'without'} sensor"
            ours = np.concatenate([each.ours[side].error_m for each in played])
            theirs = np.concatenate([each.thesis[side].error_m for each in played])
            shown = np.isfinite(ours)
            yield task, foot, has_imu, _summary(ours[shown]), _summary(theirs[shown]), 100.0 * float(shown.mean())


def _summary(error_m: FloatArray) -> Three:
    finite = _TABLE_5_1_MM * error_m[np.isfinite(error_m)]
    if not len(finite):
        return (np.nan, np.nan, np.nan)
    return float(finite.mean()), float(np.median(finite)), float(finite.max())


def _three(values: Sequence[float]) -> str:
    return " / ".join("–" if np.isnan(value) else f"{value:.0f}" for value in values)


CellStage = Literal["marker", "depth", "inertial"]

SETTLED_S: Final = 2.0
"""What comes before counts in no cell."""
MOVING_M_S: Final = 0.05
_MM: Final = 1e3
_TESTS: Final[dict[WalkProgram, str]] = {
    "still": "standing still",
    "marker_moving": "marker moving",
    "head_moving": "head moving",
    "sudden": "sudden move",
}
_PRINTED_MM: Final[dict[tuple[WalkProgram, CellStage], tuple[float, float | None]]] = {
    ("still", "marker"): (3.0, None),
    ("marker_moving", "marker"): (33.6, 124.0),
    ("head_moving", "marker"): (35.4, None),
    ("marker_moving", "depth"): (41.0, None),
    ("marker_moving", "inertial"): (169.0, 481.0),
}
"""Average and worst in the thesis's room, millimetres; None = not known to us."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One test in one stage.

    Attributes:
        test: name of the test.
        stage: what the tracker is left with.
        run: that is played.
    """

    test: WalkProgram
    stage: CellStage
    run: Run

    @property
    def title(self) -> str:
        """For people."""
        return f"{_TESTS[self.test]}, by {self.stage}"

    def counts(self, played: Played, track: FootTrajectory) -> BoolArray:
        """Return (N,) the moments of a run that count for a foot."""
        t_s = played.t_s
        if self.stage == "marker":
            chosen = t_s >= SETTLED_S
        elif self.stage == "depth":
            chosen = t_s > LEARN_S
        else:
            dark = [(start <= t_s) & (t_s < end) for start, end in played.blackouts]
            chosen = np.any(dark, axis=0) if dark else np.zeros(len(t_s), np.bool_)
        if self.test in ("marker_moving", "sudden"):
            chosen = chosen & (track.speed > MOVING_M_S)
        return chosen


def _cells() -> tuple[Cell, ...]:
    cells = []
    for test in _TESTS:
        cells += [
            Cell(test, "marker", Run(test, test, hems=False)),
            Cell(test, "depth", Run(f"{test}_depth", test, hems=False, covered=True)),
            Cell(test, "inertial", Run(f"{test}_inertial", test, hems=False, blackouts=True)),
        ]
    return tuple(cells)


CELLS: Final = _cells()


def cell_rows(done: Mapping[str, Sequence[Played]]) -> list[Row]:
    """Return the table of the cells that were played: ours, and beside it the thesis's tracker on the same data."""
    rows: list[Row] = []
    better = []
    for cell in CELLS:
        if cell.run.name not in done:
            continue
        ours, theirs, share = _errors_mm(cell, done[cell.run.name])
        note = f"{cell.title}: {share:.0f} % of the moments published"
        mine, thesis = (_average_and_worst(errors) for errors in (ours, theirs))
        for k, word in enumerate(("average", "worst")):
            printed = _PRINTED_MM.get((cell.test, cell.stage), (None, None))[k]
            peer = f"its tracker here {thesis[k]:.0f} mm" if np.isfinite(thesis[k]) else ""
            peer += f"; in its room {printed:g} mm" if printed is not None else ""
            rows.append(Row(f"{cell.title}, {word}", mine[k], "mm", peer=peer, note=note))
        better.append(mine[0] < thesis[0])
    if rows:
        text = f"cells of {len(better)} in which ours errs less than the thesis's tracker, average"
        rows.append(Row(text, float(sum(better)), "", least=float(len(better))))
    return rows


def cell_plots(done: Mapping[str, Sequence[Played]]) -> list[str]:
    """Return, for each cell, where the foot that moves most is along its longest way: truth, ours and the thesis's."""
    plots = []
    for cell in CELLS:
        if cell.run.name not in done:
            continue
        played = done[cell.run.name][0]
        side = max(SIDES, key=lambda side: float(np.ptp(played.ours[side].truth, axis=0).max()))
        ours, theirs = played.ours[side], played.thesis[side]
        axis = int(np.argmax(np.ptp(ours.truth, axis=0)))
        lines = {"truth": ours.truth[:, axis], "ours": ours.position[:, axis], "thesis": theirs.position[:, axis]}
        lowest = min(float(np.nanmin(line)) for line in lines.values() if np.isfinite(line).any())
        shown = {name: (played.t_s, _MM * (line - lowest)) for name, line in lines.items()}
        title = f"{cell.title}: {side} foot along {'xyz'[axis]}, seed {played.seed}"
        plots.append(line_plot(title, "time [s]", "position [mm]", shown))
    return plots


def _errors_mm(cell: Cell, played: Sequence[Played]) -> tuple[FloatArray, FloatArray, float]:
    """Return the errors of ours and of the thesis's tracker at the same moments, and the share published, %."""
    ours, theirs, wanted = [], [], 0
    for each in played:
        for side in SIDES:
            track = each.ours[side]
            counts = cell.counts(each, track)
            wanted += int(counts.sum())
            shown = counts & np.isfinite(track.error_m)
            ours.append(track.error_m[shown])
            theirs.append(each.thesis[side].error_m[shown])
    count = sum(map(len, ours))
    return _MM * np.concatenate(ours), _MM * np.concatenate(theirs), 100.0 * count / max(wanted, 1)


def _average_and_worst(values: FloatArray) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    return (float(finite.mean()), float(finite.max())) if len(finite) else (float("nan"), float("nan"))
