"""Steps of the calibration as text for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Final

from rhot.calibration_step import Figures, Remark, StepView
from rhot_viewer.browser.sentence import sentence_html

_COLORS: Final = {"plain": "inherit", "good": "#69db7c", "warning": "#ffa94d", "wrong": "#ff6b6b"}
_BLOCK: Final = "<div style='padding:0.15em 0.8em;font-size:0.9em;overflow-wrap:anywhere'>{}</div>"


def path_html(views: Mapping[str, StepView], current: str) -> str:
    """Return the whole path, a line a step: its number, whether it is done, and where it stands."""
    rows = []
    for number, (title, view) in enumerate(views.items(), start=1):
        mark = "<span style='color:#69db7c'>✓</span>" if view.done else str(number)
        name = escape(title)
        name = f"<b>{name}</b>" if title == current else name
        rows.append(
            f"<tr><td style='padding-right:0.6em'>{mark}</td><td style='padding-right:0.6em;white-space:nowrap'>{name}"
            f"</td><td style='opacity:0.75'>{sentence_html(view.state)}</td></tr>"
        )
    return _BLOCK.format(f"<table>{''.join(rows)}</table>")


def about_html(about: str) -> str:
    """Return what a step asks for."""
    return _BLOCK.format(f"<span style='opacity:0.75'>{sentence_html(about)}</span>")


def bar_html(share: float) -> str:
    """Return how much of the work under way is done, as a bar."""
    percent = 100.0 * min(max(share, 0.0), 1.0)
    return _BLOCK.format(
        "<div style='background:#343a40;border-radius:3px;height:6px'>"
        f"<div style='background:#4dabf7;border-radius:3px;height:6px;width:{percent:.0f}%'></div></div>"
    )


def remarks_html(problem: str, remarks: Sequence[Remark]) -> str:
    """Return what is missing or wrong, a paragraph each; a problem of the last press first."""
    said = [Remark(problem, "wrong"), *remarks] if problem else remarks
    return "".join(
        _BLOCK.format(f"<span style='color:{_COLORS[remark.tone]}'>{sentence_html(remark.text)}</span>")
        for remark in said
    )


def tables_html(tables: Sequence[Figures]) -> str:
    """Return figures as tables."""
    return "".join(_BLOCK.format(_table(table)) for table in tables)


def _table(table: Figures) -> str:
    cell = "<{0} style='text-align:left;overflow-wrap:normal;padding-right:0.7em;font-weight:{1}'>{2}</{0}>"
    head = "".join(cell.format("th", "normal;opacity:0.6", escape(text)) for text in table.headings)
    rows = ["".join(cell.format("td", "normal", escape(text)) for text in row) for row in table.rows]
    body = "".join(f"<tr>{row}</tr>" for row in (head, *rows))
    return f"<div style='font-weight:bold'>{escape(table.title)}</div><table>{body}</table>"
