"""`rhot calibrate markers`."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from rhot.cli.options import rig_option
from rhot.errors import ConfigError
from rhot.rig import load_rig
from rhot_calibration.feet.sheet import PAPERS_MM, write_marker_sheet


@click.command()
@click.argument("file", metavar="FILE.pdf", type=click.Path(path_type=Path, dir_okay=False))
@rig_option
@click.option(
    "--paper",
    type=click.Choice(list(PAPERS_MM), case_sensitive=False),
    default="a4",
    show_default=True,
    help="Size of the paper.",
)
def markers(file: Path, rig_path: Path, paper: str) -> None:
    """Draw the markers for the feet, to print, in the size and with the numbers of [feet] in rig.toml.

    Print at 100 % (no "fit to page"), check the printed ruler with a real one, glue each marker to stiff card and fix
    it flat on the instep, the marked edge towards the toes.
    """
    feet = load_rig(rig_path).config.feet
    if feet is None:
        raise ConfigError(
            f"{rig_path / 'rig.toml'} names no feet; add [feet.left] with marker_id = 1 and [feet.right] with "
            "marker_id = 2"
        )
    numbers = {side: foot.marker_id for side, foot in feet.feet.items()}
    write_marker_sheet(file, numbers, feet.dictionary, feet.marker_size_m, paper)
    console = Console(soft_wrap=True, markup=False, highlight=False)
    told = " and ".join(f"{side} {number}" for side, number in numbers.items())
    console.print(f"{file}: markers {told} of {feet.dictionary}, {1e3 * feet.marker_size_m:g} mm; print at 100 %")
