"""`rhot evaluate paints`: how many paints a camera tells apart, and which."""

from __future__ import annotations

from typing import Final

import click
from rich.console import Console
from rich.table import Table

from rhot.cli.options import FiniteRange
from rhot_calibration.colors.model.paint_sets import SATURATION, as_seen, best_set
from rhot_calibration.colors.model.paints import PAINTS

_FEWEST: Final = 5
_MOST: Final = 12
"""The fingertips of one hand; tips and patches of both, each with a paint of its own."""


@click.command()
@click.option(
    "--saturation",
    type=FiniteRange(0.05, 1.0),
    default=SATURATION,
    show_default=True,
    help="How colourful pictures are beside the paint from the tube. The 2018 rig's: 0.29, a telephone's: 0.44.",
)
@click.option(
    "--have",
    "worn",
    multiple=True,
    metavar="PAINT",
    type=click.Choice(list(PAINTS)),
    help="A paint that you have and want to use. May be repeated.",
)
def paints(saturation: float, worn: tuple[str, ...]) -> None:
    """Choose paints: the sets of five to twelve whose two most similar ones differ most.

    Skin and grey surroundings count as members. The largest confusion is the share of pixels of these two that may be
    misclassified as the other; up to about a tenth is fine, because blobs are far more reliable than single pixels.
    Brands differ: when you have painted, `rhot calibrate colors` measures what your own cameras see.
    """
    table = Table(title=f"Paints that differ most, as seen with a saturation of {saturation:g}")
    for title in ("paints", "distance", "confusion", "most alike", "the set"):
        table.add_column(title, justify="right" if title in ("paints", "distance", "confusion") else "left")
    seen = as_seen(saturation)
    for count in range(max(_FEWEST, len(set(worn))), _MOST + 1):
        chosen = best_set(count, seen, tuple(dict.fromkeys(worn)))
        share = f"{100.0 * chosen.confusion:.1f} %"
        table.add_row(str(count), f"{chosen.distance:.2f}", share, ", ".join(chosen.nearest), ", ".join(chosen.paints))
    Console().print(table)
