"""How the measuring commands end: tables on standard output, JSON or HTML when asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any, TypeVar

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rhot.cli.options import FiniteRange
from rhot.report.html import html_page
from rhot.rig.folder import write_text_atomic
from rhot_tools.measures.provenance import provenance
from rhot_tools.measures.rows import Row, Section, as_json, missed, section_table

# Figures as one HTML file: tables and plots.


def html_report(title: str, about: str, sections: Sequence[Section], plots: Sequence[str]) -> str:
    """Return the document.

    Args:
        title: heading.
        about: how the figures came about, one paragraph.
        sections: tables.
        plots: SVG elements.
    """
    tables = "".join(html_table(section) for section in sections)
    return html_page(title, about, f"{''.join(plots)}{tables}")


def html_table(section: Section) -> str:
    """Return a table of figures as HTML."""
    head = "<tr><th>figure</th><th>value</th><th>target</th><th></th><th>beside it</th></tr>"
    return f"<h2>{escape(section.title)}</h2><table>{head}{''.join(map(_row, section.rows))}</table>"


def _row(row: Row) -> str:
    note = f"<br/><small>{escape(row.note)}</small>" if row.note else ""
    return (
        f"<tr><td>{escape(row.name)}{note}</td><td class='number'>{escape(row.text)}</td>"
        f"<td class='number'>{escape(row.target)}</td><td class='{row.verdict.replace(' ', '-')}'>{row.verdict}</td>"
        f"<td>{escape(row.peer)}</td></tr>"
    )


# How the measuring commands end: tables on standard output, JSON when asked for.

F = TypeVar("F", bound=Callable[..., Any])


def json_option(command: F) -> F:
    """Add `--json`."""
    return click.option(
        "--json",
        "json_path",
        type=click.Path(path_type=Path, dir_okay=False),
        help="Also write every figure to this file, as JSON.",
    )(command)


def quick_option(about: str) -> Callable[[F], F]:
    """Return what adds `--quick`: a rougher run in less time."""
    return click.option("--quick", is_flag=True, help=about)


def duration_option(low: float, high: float, default: float, about: str) -> Callable[[F], F]:
    """Return what adds `--duration`, as `duration_s`."""
    kind = FiniteRange(low, high)
    return click.option("--duration", "duration_s", type=kind, default=default, show_default=True, help=about)


def page_option(flag: str) -> Callable[[F], F]:
    """Return what gives a command the option of this name for a page with its tables and plots, as `page_path`."""

    def add(command: F) -> F:
        return click.option(
            flag,
            "page_path",
            type=click.Path(path_type=Path, dir_okay=False),
            metavar="FILE.html",
            help="Also write tables and plots, as one HTML file.",
        )(command)

    return add


def counted(console: Console) -> Progress:
    """Return a display of work that is counted, with the time it still takes; it goes when the work is done."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, transient=True)


def show(command: str, sections: Sequence[Section], json_path: Path | None, **about: Any) -> None:
    """Print sections, say how many of the targets are missed, and write the JSON file.

    Args:
        command: that was run, for the file.
        sections: its tables.
        json_path: file to write; None = none.
        about: how it was run, for the file, beside its `provenance`.
    """
    out = Console()
    for section in sections:
        out.print(section_table(section))
        out.print()
    targets = sum(bool(row.verdict) for section in sections for row in section.rows)
    if targets:
        out.print(f"{missed(sections)} of {targets} targets missed")
    if json_path is not None:
        write_text_atomic(json_path, as_json(command, sections, run=provenance(), **about))
        Console(stderr=True, soft_wrap=True, markup=False).print(f"figures: {json_path}")
