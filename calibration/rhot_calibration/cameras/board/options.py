"""How a command line states which board was printed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from rhot.cli.options import Finite
from rhot.errors import ConfigError
from rhot_calibration.cameras.board.grid import DEFAULT_DICTIONARY, parse_board
from rhot_calibration.cameras.solve.views import Board

F = TypeVar("F", bound=Callable[..., Any])


def board_options(command: F) -> F:
    """Add `--board` (as `counts`), `--square-mm`, `--marker-mm` and `--dictionary`; see `stated_board`."""
    for option in (
        click.option("--dictionary", default=DEFAULT_DICTIONARY, show_default=True, help="Markers of a ChArUco board."),
        click.option("--marker-mm", type=Finite(), help="Side of the markers of a ChArUco board."),
        click.option("--square-mm", type=Finite(), help="Side of a square, measured on the print."),
        click.option("--board", "counts", metavar="CxR", help="Inner corners along and across, such as 9x6."),
    ):
        command = option(command)
    return command


def stated_board(counts: str | None, square_mm: float | None, marker_mm: float | None, dictionary: str) -> Board:
    """Return the board that the command line states.

    Raises:
        ConfigError: its corners or the size of its squares are not stated.
        CalibrationError: there is no such board.
    """
    if counts is None or square_mm is None:
        raise ConfigError(
            "which board? Give --board (inner corners, such as 9x6) and --square-mm (measured, such as 25)"
        )
    return parse_board(counts, 1e-3 * square_mm, None if marker_mm is None else 1e-3 * marker_mm, dictionary)
