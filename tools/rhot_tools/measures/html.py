"""Figures as one HTML file: tables and plots."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from rhot.report.html import html_page
from rhot_tools.measures.rows import Row, Section


def html_report(title: str, about: str, sections: Sequence[Section], plots: Sequence[str]) -> str:
    """Return the document.

    Args:
        title: heading.
        about: how the figures came about, one paragraph.
        sections: tables.
        plots: SVG elements.
    """
    tables = "".join(_table(section) for section in sections)
    return html_page(title, about, f"{''.join(plots)}{tables}")


def _table(section: Section) -> str:
    head = "<tr><th>figure</th><th>value</th><th>target</th><th></th><th>beside it</th></tr>"
    return f"<h2>{escape(section.title)}</h2><table>{head}{''.join(map(_row, section.rows))}</table>"


def _row(row: Row) -> str:
    note = f"<br/><small>{escape(row.note)}</small>" if row.note else ""
    return (
        f"<tr><td>{escape(row.name)}{note}</td><td class='number'>{escape(row.text)}</td>"
        f"<td class='number'>{escape(row.target)}</td><td class='{row.verdict.replace(' ', '-')}'>{row.verdict}</td>"
        f"<td>{escape(row.peer)}</td></tr>"
    )
