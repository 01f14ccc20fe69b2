"""Table 5.1 of the 2021 thesis: its six walking tasks, foot with and without inertial sensor, average, median, worst.

Every pose that is published counts, from the first moment on and predicted ones too; the thesis's tracker is judged at
the same moments.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np
from rich.table import Table

from rhot.arrays import FloatArray
from rhot.report.tables import figures_table
from rhot_bench.feet.runs import SIDES, Played
from rhot_tools.measures.rows import Row

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
_MM: Final = 1e3


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
        printed = tuple(_MM * value for value in PRINTED_M[task][has_imu])
        rows.append((_TITLES[task], foot, _three(ours), _three(theirs), _three(printed), f"{share:.0f} %"))
    return Layout(tuple(rows))


def table_5_1_rows(done: Mapping[str, Sequence[Played]]) -> list[Row]:
    """Return the same as single figures, and in how many columns all three of ours are less than the thesis's."""
    rows = []
    better = []
    for task, foot, has_imu, ours, theirs, share in _each(done):
        note = f"{_TITLES[task]}, {foot}: {share:.0f} % of the moments published"
        for k, name in enumerate(_FIGURES):
            peer = f"{_MM * PRINTED_M[task][has_imu][k]:.0f} mm; its tracker here {theirs[k]:.0f} mm"
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
    finite = _MM * error_m[np.isfinite(error_m)]
    if not len(finite):
        return (np.nan, np.nan, np.nan)
    return float(finite.mean()), float(np.median(finite)), float(finite.max())


def _three(values: Sequence[float]) -> str:
    return " / ".join("–" if np.isnan(value) else f"{value:.0f}" for value in values)
