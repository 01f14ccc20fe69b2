"""A report as one HTML file: tables and plots, nothing to load from elsewhere."""

from __future__ import annotations

from html import escape

from rich import box
from rich.table import Table

# Tables of figures on the terminal.


def figures_table(*columns: str, title: str | None = None, names: int = 1) -> Table:
    """Return an empty table: so many columns of `names` on the left, then figures, aligned to the right.

    In a narrow terminal a figure goes on in the next line: one that is cut off reads as another figure.
    """
    table = Table(
        title=title,
        title_justify="left",
        header_style="bold",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 1, 0, 0),
    )
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index < names else "right", overflow="fold")
    return table


_STYLE = """
body { font-family: sans-serif; max-width: 800px; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 0.5em 0 1.5em; font-size: 14px; }
th, td { text-align: left; padding: 3px 10px; border-bottom: 1px solid #e4e4e4; }
td.number { text-align: right; white-space: nowrap; }
.met { color: #2d6a4f; } .missed { color: #b00020; font-weight: bold; } .not-measured { color: #8a6d00; }
small { color: #666; } svg { margin: 0.5em 0; max-width: 100%; height: auto; }
"""


def html_page(title: str, about: str, body: str, style: str = "") -> str:
    """Return a document whose body, HTML already, follows a heading and a paragraph.

    Args:
        title: heading.
        about: paragraph.
        body: HTML.
        style: CSS after the usual one.
    """
    return (
        f"<!DOCTYPE html>\n<html lang='en'><head><meta charset='utf-8'>"
        f"<meta name='viewport' content='width=device-width'><title>{escape(title)}</title>"
        f"<style>{_STYLE}{style}</style></head><body><h1>{escape(title)}</h1><p>{escape(about)}</p>"
        f"{body}</body></html>\n"
    )
