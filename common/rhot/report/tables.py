"""Tables of figures on the terminal."""

from __future__ import annotations

from rich import box
from rich.table import Table


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
