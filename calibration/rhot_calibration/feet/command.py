"""`rhot calibrate markers`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import click
import numpy as np
from rich.console import Console

from rhot.aruco_dictionary import Bits, marker_cells
from rhot.atomic_file import write_atomic
from rhot.cli.options import rig_option
from rhot.errors import CalibrationError, ConfigError
from rhot.messages import Side
from rhot.rig import load_rig

# The feet's markers as a printable page, true to scale.
#
# Each marker is a black square on white paper with a thin line to cut along; the mark above it points to the toes.

PAPERS_MM: Final = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
_MARGIN_SHARE: Final = 0.25
"""White around the black square, as a share of its side: a little more than one cell, which the detector needs."""
_PAGE_MARGIN_MM: Final = 15.0
_RULER_MM: Final = 100.0
_TEXT_MM: Final = 4.0


def write_marker_sheet(
    file: Path, markers: Mapping[Side, int], dictionary: str, size_m: float, paper: str = "a4"
) -> None:
    """Write a PDF with one marker per foot, to be printed at 100 %.

    Args:
        file: to write, `.pdf`.
        markers: foot to the number of its marker.
        dictionary: of the markers, see `rhot.aruco_dictionary`.
        size_m: side of a marker's black square.
        paper: one of `PAPERS_MM`.

    Raises:
        CalibrationError: an unknown paper, the markers do not fit, or the package that writes PDF is missing.
        ConfigError: no such dictionary or marker, another suffix, or the file cannot be written.
    """
    if file.suffix.lower() != ".pdf":
        raise ConfigError(f"{file}: markers are written as .pdf; give the file that suffix")
    if paper.lower() not in PAPERS_MM:
        raise CalibrationError(f"paper '{paper}' is unknown; one of {', '.join(PAPERS_MM)}")
    page = PAPERS_MM[paper.lower()]
    side_mm = 1e3 * size_m
    card_mm = side_mm * (1.0 + 2.0 * _MARGIN_SHARE)
    height_mm = 3.0 * _PAGE_MARGIN_MM + len(markers) * (card_mm + _PAGE_MARGIN_MM)
    if card_mm > page[0] - 2.0 * _PAGE_MARGIN_MM or height_mm > page[1]:
        raise CalibrationError(
            f"{len(markers)} marker(s) of {side_mm:g} mm do not fit on {paper}; lower marker_size_m in [feet]"
        )
    cells = {side: marker_cells(dictionary, marker_id) for side, marker_id in markers.items()}
    try:
        from fpdf import FPDF  # noqa: PLC0415
        from fpdf.prefs import ViewerPreferences  # noqa: PLC0415
    except ImportError as error:
        raise CalibrationError(
            "printing needs the package fpdf2; install it with: pip install 'rhot[calibrate]'"
        ) from error
    pdf = FPDF(unit="mm", format=page)
    pdf.set_auto_page_break(False)
    pdf.add_page()
    # The print dialogue then starts at 100 %.
    pdf.viewer_preferences = ViewerPreferences(print_scaling="None")
    pdf.set_font("Helvetica", size=_TEXT_MM * 72.0 / 25.4)
    x, y = 0.5 * (page[0] - card_mm), _PAGE_MARGIN_MM
    for side, marker_id in markers.items():
        text = f"{side} foot: marker {marker_id} of {dictionary}, {side_mm:g} mm. This edge towards the toes."
        pdf.text(x, y - 1.5, text)
        pdf.set_draw_color(160)
        pdf.set_line_width(0.1)
        pdf.rect(x, y, card_mm, card_mm)
        _draw_marker(pdf, cells[side], x + _MARGIN_SHARE * side_mm, y + _MARGIN_SHARE * side_mm, side_mm)
        y += card_mm + _PAGE_MARGIN_MM
    pdf.set_fill_color(0)
    pdf.rect(0.5 * (page[0] - _RULER_MM), y, _RULER_MM, 0.3, style="F")
    for tick in range(0, int(_RULER_MM) + 1, 10):
        pdf.rect(0.5 * (page[0] - _RULER_MM) + tick - 0.05, y, 0.1, 3.0, style="F")
    pdf.text(0.5 * (page[0] - _RULER_MM), y + 8.0, "Print at 100 %: this line must measure 100 mm.")
    write_atomic(file, bytes(pdf.output()))


def _draw_marker(pdf: Any, cells: Bits, x: float, y: float, side: float) -> None:
    """Draw a black square and its white cells, runs in one piece: viewers show hairlines between neighbours."""
    pdf.set_fill_color(0)
    pdf.rect(x, y, side, side, style="F")
    pdf.set_fill_color(255)
    cell = side / len(cells)
    for row, line in enumerate(cells):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
        for start, end in edges.reshape(-1, 2).tolist():
            pdf.rect(x + start * cell, y + row * cell, (end - start) * cell, cell, style="F")


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
