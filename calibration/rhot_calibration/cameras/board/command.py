"""`rhot calibrate board`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape

import click
import numpy as np
from fpdf import FPDF
from fpdf.prefs import ViewerPreferences
from rich.console import Console

from rhot.atomic_file import write_atomic
from rhot.cli.options import Finite
from rhot.errors import CalibrationError, ConfigError
from rhot_calibration.cameras.board.grid import (
    DEFAULT_DICTIONARY,
    aruco_dictionary,
    charuco_board,
    half_turn_ambiguous,
    parse_board,
)
from rhot_calibration.cameras.solve.views import Board

# A calibration board as shapes on paper, and their writers: PDF and SVG, both true to scale.

# Sheets, upright, millimetres (ISO 216; ANSI Y14.1).
PAPERS: Final = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
RULER_MM: Final = 100.0
MIN_MARGIN_MM: Final = 5.0  # what printers cannot reach
_TEXT_WIDTH_MM: Final = 140.0
_TEXT_MM: Final = 3.2


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A filled rectangle: its upper left corner and its size, millimetres, y down."""

    x: float
    y: float
    width: float
    height: float
    black: bool = True


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text: left end of its baseline and height of the letters' body, millimetres."""

    x: float
    y: float
    size: float
    content: str


Shape = Rectangle | Text


@dataclass(frozen=True, slots=True)
class Sheet:
    """A printed page.

    Attributes:
        width_mm, height_mm: of the paper as it is turned.
        shapes: in the order in which they are drawn.
        board_x_mm, board_y_mm: upper left corner of the board's first square.
    """

    width_mm: float
    height_mm: float
    shapes: tuple[Shape, ...]
    board_x_mm: float
    board_y_mm: float


def board_sheet(board: Board, paper: str) -> Sheet:
    """Lay out a board with white around it, a ruler and lines that say what it is.

    Args:
        board: to print.
        paper: one of `PAPERS`; turned whichever way the board fits.

    Raises:
        CalibrationError: an unknown paper, or the board does not fit; says which paper or square would.
    """
    if paper.lower() not in PAPERS:
        raise CalibrationError(f"paper '{paper}' is unknown; one of {', '.join(PAPERS)}")
    square = 1e3 * board.square_m
    width, height = (board.columns + 1) * square, (board.rows + 1) * square
    page = _oriented(PAPERS[paper.lower()], board, square)
    if page is None:
        raise CalibrationError(_misfit(board, paper))
    # Board and foot stand in the middle of the page together.
    x = 0.5 * (page[0] - width)
    rim = (page[1] - height - _foot(page[0])) / 2.0
    shapes = [*_squares(board, x, rim), *_foot_shapes(board, page, rim + height + min(rim, square))]
    return Sheet(page[0], page[1], tuple(shapes), x, rim)


def write_sheet(sheet: Sheet, file: Path) -> None:
    """Write a sheet as the suffix of the file says, `.pdf` or `.svg`.

    Raises:
        ConfigError: another suffix, or the file cannot be written.
    """
    suffix = file.suffix.lower()
    if suffix not in (".pdf", ".svg"):
        raise ConfigError(f"{file}: boards are written as .pdf or .svg; give the file one of these suffixes")
    data = pdf_bytes(sheet) if suffix == ".pdf" else svg_text(sheet).encode()
    write_atomic(file, data)


def svg_text(sheet: Sheet) -> str:
    """Return a sheet as SVG; one user unit is one millimetre."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{sheet.width_mm:g}mm" height="{sheet.height_mm:g}mm" '
        f'viewBox="0 0 {sheet.width_mm:g} {sheet.height_mm:g}">',
        f'<rect width="{sheet.width_mm:g}" height="{sheet.height_mm:g}" fill="white"/>',
    ]
    for shape in sheet.shapes:
        if isinstance(shape, Rectangle):
            lines.append(
                f'<rect x="{shape.x:.4f}" y="{shape.y:.4f}" width="{shape.width:.4f}" height="{shape.height:.4f}" '
                f'fill="{"black" if shape.black else "white"}"/>'
            )
        else:
            lines.append(
                f'<text x="{shape.x:.4f}" y="{shape.y:.4f}" font-family="Helvetica, Arial, sans-serif" '
                f'font-size="{shape.size:g}">{escape(shape.content)}</text>'
            )
    return "\n".join([*lines, "</svg>", ""])


def pdf_bytes(sheet: Sheet) -> bytes:
    """Return a sheet as PDF of one page."""
    pdf = FPDF(unit="mm", format=(sheet.width_mm, sheet.height_mm))
    pdf.set_auto_page_break(False)
    pdf.set_margin(0.0)
    pdf.add_page()
    pdf.viewer_preferences = ViewerPreferences(print_scaling="None")  # the print dialogue then starts at 100 %
    for shape in sheet.shapes:
        if isinstance(shape, Rectangle):
            pdf.set_fill_color(0 if shape.black else 255)
            pdf.rect(shape.x, shape.y, shape.width, shape.height, style="F")
        else:
            pdf.set_font("Helvetica", size=shape.size / 0.3528)
            pdf.text(shape.x, shape.y, shape.content)
    return bytes(pdf.output())


def _margin(square: float) -> float:
    rim_share = 0.3  # least white around the squares, in squares; the finders need some
    return max(rim_share * square, MIN_MARGIN_MM)


def _side_by_side(page_width: float) -> bool:
    """Tell whether the text has room to the right of the ruler."""
    return page_width >= RULER_MM + _TEXT_WIDTH_MM + 3.0 * MIN_MARGIN_MM


def _foot(page_width: float) -> float:
    """Return the height of ruler and text with the printer's margin under them."""
    ruler_foot_mm = 7.0
    stacked_foot_mm = 17.0
    return (ruler_foot_mm if _side_by_side(page_width) else stacked_foot_mm) + MIN_MARGIN_MM


def _oriented(paper: tuple[float, float], board: Board, square: float) -> tuple[float, float] | None:
    """Return (width, height) of the paper in the direction in which the board fits, or None."""
    width = max((board.columns + 1) * square + 2.0 * _margin(square), RULER_MM + 2.0 * MIN_MARGIN_MM)
    height = (board.rows + 1) * square + 2.0 * _margin(square)
    for page in (paper, paper[::-1]):
        if width <= page[0] and height + _foot(page[0]) <= page[1]:
            return page[0], page[1]
    return None


def _misfit(board: Board, paper: str) -> str:
    square = 1e3 * board.square_m
    fitting = [name for name, size in PAPERS.items() if _oriented(size, board, square)]
    smaller = next((s for s in _steps(square) if _oriented(PAPERS[paper.lower()], board, s)), None)
    ways = ([f"print on {fitting[0]}"] if fitting else []) + (
        [f"take squares of {smaller:g} mm"] if smaller is not None else []
    )
    return (
        f"a board of {board.columns + 1}x{board.rows + 1} squares of {square:g} mm, with white margin and ruler, does "
        f"not fit on {paper}; {' or '.join(ways) or 'take fewer corners'}"
    )


def _steps(square: float) -> Sequence[float]:
    """Return handsome sizes of squares below the one asked for, largest first, millimetres."""
    return [0.5 * step for step in range(int(2.0 * square - 1e-9), 3, -1)]


def _squares(board: Board, x: float, y: float) -> list[Shape]:
    square = 1e3 * board.square_m
    shapes: list[Shape] = [
        Rectangle(x + column * square, y + row * square, square, square)
        for row in range(board.rows + 1)
        for column in range(board.columns + 1)
        if (row + column) % 2 == 0
    ]
    return shapes + (_markers(board, x, y) if board.is_charuco else [])


def _markers(board: Board, x: float, y: float) -> list[Shape]:
    """Return the markers of a ChArUco board: a black square each, with its white cells on it."""
    description = charuco_board(board)
    dictionary = aruco_dictionary(board)
    bits = int(dictionary.markerSize)
    numbers = np.asarray(description.getIds()).reshape(-1)
    quads = np.asarray(description.getObjPoints(), dtype=np.float64).reshape(-1, 4, 3)
    shapes: list[Shape] = []
    for number, quad in zip(numbers, quads, strict=True):
        left, top = 1e3 * quad[0, :2] + (x, y)
        side = float(1e3 * (quad[1, 0] - quad[0, 0]))
        shapes.append(Rectangle(float(left), float(top), side, side))
        cells = np.asarray(dictionary.generateImageMarker(int(number), bits + 2, borderBits=1)) > 0
        cell = side / (bits + 2)
        for row in range(bits + 2):
            # Runs of white cells are drawn in one piece: viewers show hairlines between neighbours.
            edges = np.flatnonzero(np.diff(np.concatenate([[0], cells[row].astype(np.int8), [0]])))
            for start, end in edges.reshape(-1, 2).tolist():
                shapes.append(
                    Rectangle(float(left) + start * cell, float(top) + row * cell, (end - start) * cell, cell, False)
                )
    return shapes


def _foot_shapes(board: Board, page: tuple[float, float], y: float) -> list[Shape]:
    """Return a ruler of 100 mm with a tick every 10 mm (each millimetre of the first ten) and what the board is."""
    beside = _side_by_side(page[0])
    x = 0.5 * (page[0] - RULER_MM - (_TEXT_WIDTH_MM + MIN_MARGIN_MM if beside else 0.0))
    line = 0.2
    shapes: list[Shape] = [Rectangle(x - 0.5 * line, y, RULER_MM + line, line)]
    ticks = [*range(10), *range(10, int(RULER_MM) + 1, 10)]
    for tick in ticks:
        long = 4.0 if tick % 50 == 0 else 3.0 if tick % 10 == 0 else 1.5
        shapes.append(Rectangle(x + tick - 0.5 * line, y, line, long))
    shapes += [Text(x + tick - 0.7 * len(str(tick)), y + 6.6, 2.6, str(tick)) for tick in (0, 50, 100)]
    text_x, text_y = (x + RULER_MM + MIN_MARGIN_MM, y + 2.4) if beside else (x, y + 12.0)
    name = f"RHOT {board}"
    if board.marker_m is not None:
        name += f", {1e3 * board.marker_m:g} mm markers, {board.dictionary}"
    shapes += [
        Text(text_x, text_y, _TEXT_MM, name),
        Text(
            text_x,
            text_y + 4.5,
            _TEXT_MM,
            "Print at 100 %: the ruler must measure 100 mm. Glue to something flat.",
        ),
    ]
    return shapes


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
