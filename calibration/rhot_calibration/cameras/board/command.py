"""`rhot calibrate board`."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from rhot.cli.options import Finite
from rhot.errors import ConfigError
from rhot_calibration.cameras.board.boards import DEFAULT_DICTIONARY, half_turn_ambiguous, parse_board
from rhot_calibration.cameras.board.printing import PAPERS, board_sheet, write_sheet


@click.command()
@click.argument("file", metavar="FILE.pdf|FILE.svg", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--board", "counts", default="9x6", show_default=True, help="Inner corners along and across.")
@click.option("--square-mm", type=Finite(), default=25.0, show_default=True, help="Side of a square.")
@click.option("--paper", type=click.Choice(list(PAPERS), case_sensitive=False), default="a4", show_default=True)
@click.option("--charuco", is_flag=True, help="With ArUco markers: found even when partly hidden.")
@click.option("--marker-mm", type=Finite(), help="Side of the markers of a ChArUco board; default 0.7 of a square.")
@click.option("--dictionary", help=f"Markers of a ChArUco board; default {DEFAULT_DICTIONARY}.")
def board(
    file: Path,
    counts: str,
    square_mm: float,
    paper: str,
    charuco: bool,
    marker_mm: float | None,
    dictionary: str | None,
) -> None:
    """Draw a calibration board, to print, as PDF or SVG by the suffix of the file.

    Inner corners are the points where four squares meet: 9x6 of them make a board of 10 by 7 squares. Print at 100 %
    (no "fit to page"), check the printed ruler with a real one, and glue the sheet to something flat and stiff: a
    board that is bowed by a few millimetres makes every later measure worse.

    Then show it to all cameras and run: rhot calibrate cameras RECORDING --board 9x6 --square-mm 25
    """
    if not charuco and (marker_mm is not None or dictionary is not None):
        raise ConfigError("--marker-mm and --dictionary are for boards with markers; add --charuco")
    marker_m = 1e-3 * (marker_mm if marker_mm is not None else 0.7 * square_mm) if charuco else None
    chosen = parse_board(counts, 1e-3 * square_mm, marker_m, dictionary or DEFAULT_DICTIONARY)
    sheet = board_sheet(chosen, paper)
    write_sheet(sheet, file)
    console = Console(soft_wrap=True, markup=False, highlight=False)
    console.print(f"{file}: {chosen}, on {paper} ({sheet.width_mm:g} x {sheet.height_mm:g} mm)")
    if half_turn_ambiguous(chosen):
        console.print(
            "note: this board looks the same after half a turn; cameras that see it from opposite sides confuse its "
            f"ends. {chosen.columns}x{chosen.rows - 1 if chosen.rows > 3 else chosen.rows + 1} corners do not"
        )
    console.print("print at 100 %, measure the ruler, glue it to something flat; then calibrate with:")
    extra = f" --marker-mm {1e3 * chosen.marker_m:g} --dictionary {chosen.dictionary}" if chosen.marker_m else ""
    console.print(
        f"  rhot calibrate cameras RECORDING --board {chosen.columns}x{chosen.rows} --square-mm {square_mm:g}{extra}"
    )
