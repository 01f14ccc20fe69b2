"""Figures as people and programs read them: value, unit, target, and whether the target is met."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from rich.console import Group, RenderableType
from rich.text import Text

from rhot.errors import ConfigError
from rhot.report.html import figures_table

_COLORS: Final = {"met": "green", "missed": "red", "not measured": "yellow", "": "default"}


@dataclass(frozen=True, slots=True)
class Row:
    """One figure.

    Attributes:
        name: what was measured.
        value: NaN = could not be measured.
        unit: of value and limits.
        most, least: target, inclusive; None = none.
        peer: the same of the thesis or of a published tracker, for people; empty = none known.
        note: how it was measured, or a warning.
    """

    name: str
    value: float
    unit: str = ""
    most: float | None = None
    least: float | None = None
    peer: str = ""
    note: str = ""

    @property
    def target(self) -> str:
        """The target as text; empty when there is none."""
        if self.most is not None:
            return f"≤ {self.most:g}"
        return "" if self.least is None else f"≥ {self.least:g}"

    @property
    def verdict(self) -> str:
        """`met`, `missed`, `not measured`, or empty where there is no target."""
        if self.most is None and self.least is None:
            return ""
        if math.isnan(self.value):
            return "not measured"
        above = self.most is not None and self.value > self.most
        below = self.least is not None and self.value < self.least
        return "missed" if above or below else "met"

    @property
    def text(self) -> str:
        """The value with three significant digits and its unit; four where three would read as the missed target."""
        if math.isnan(self.value):
            return "–"
        size = abs(self.value)
        whole = size >= 100 or (self.value == round(self.value) and size >= 10)
        number = f"{self.value:.0f}" if whole or self.value == 0.0 else f"{self.value:.3g}"
        if self.verdict == "missed" and self.target.endswith(f" {number}"):
            number = f"{self.value:.4g}"
        return f"{number} {self.unit}".rstrip()


@dataclass(frozen=True, slots=True)
class Section:
    """Rows that belong together.

    Attributes:
        title: of the table.
        rows: in order.
    """

    title: str
    rows: tuple[Row, ...]


def section_table(section: Section) -> RenderableType:
    """Return a section as a table for the terminal; notes stand below it, by number."""
    table = figures_table(title=section.title)
    columns = ["figure", "value", "target", ""]
    columns += ["beside it"] if any(row.peer for row in section.rows) else []
    for column in columns:
        table.add_column(
            column, justify="right" if column in ("value", "target") else "left", no_wrap=column == "value"
        )
    notes = list(dict.fromkeys(row.note for row in section.rows if row.note))
    for row in section.rows:
        mark = f" [{notes.index(row.note) + 1}]" if row.note else ""
        verdict = Text(row.verdict, _COLORS[row.verdict])
        peer = [row.peer] if "beside it" in columns else []
        table.add_row(Text(row.name + mark), row.text, row.target, verdict, *peer)
    return Group(table, *(Text(f"[{number}] {note}", "dim") for number, note in enumerate(notes, start=1)))


def as_json(command: str, sections: Sequence[Section], **about: Any) -> str:
    """Return sections as a JSON document; a figure that could not be measured is null, and what is empty is left out.

    Args:
        command: that was run.
        sections: its tables.
        about: how it was run.
    """
    document = {
        "version": 1,
        "command": command,
        **about,
        "sections": [
            {"title": section.title, "rows": [_row_object(row) for row in section.rows]} for section in sections
        ],
    }
    return json.dumps(document, indent=0, allow_nan=False) + "\n"


def missed(sections: Iterable[Section]) -> int:
    """Return how many targets are missed."""
    return sum(row.verdict == "missed" for section in sections for row in section.rows)


def check_output(option: str, file: Path | None) -> None:
    """Refuse an output file whose folder is not there, before the long work.

    Raises:
        ConfigError: its folder does not exist.
    """
    if file is not None and not file.resolve().parent.is_dir():
        raise ConfigError(f"{option} {file}: the folder {file.resolve().parent} does not exist; make it first")


def _row_object(row: Row) -> dict[str, Any]:
    value = row.value if math.isfinite(row.value) else None
    told = asdict(row) | {"value": value, "verdict": row.verdict}
    return {name: one for name, one in told.items() if name == "value" or one not in (None, "")}
