"""`rhot calibrate depth`."""

from __future__ import annotations

import csv
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from rhot.arrays import FloatArray
from rhot.atomic_file import why_unread
from rhot.cli.options import FiniteRange
from rhot.errors import CalibrationError
from rhot.report.html import figures_table
from rhot_calibration.depth.fit import PhysicalLaw, PowerLaw, fit_physical_law, fit_power_law, relative_rms

_COLUMNS = "distance_cm and either disparity_px or left_x and right_x"


def read_rows(file: Path) -> tuple[FloatArray, FloatArray]:
    """Return distances (N,), metres, and disparities (N,), pixels, of a CSV file.

    Raises:
        CalibrationError: unreadable, columns missing, or a value that is no number; names the line.
    """
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            header = reader.fieldnames or []
            direct = "disparity_px" in header
            wanted = ("distance_cm", "disparity_px") if direct else ("distance_cm", "left_x", "right_x")
            missing = [name for name in wanted if name not in header]
            if missing:
                raise CalibrationError(f"{file}: no column {missing[0]}; the header needs {_COLUMNS}")
            rows = [[_number(file, reader.line_num, name, row[name]) for name in wanted] for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{file}: cannot be read: {why_unread(error)}") from error
    values = np.array(rows, dtype=np.float64).reshape(-1, len(wanted))
    return values[:, 0] / 100.0, values[:, 1] if direct else values[:, 1] - values[:, 2]


def _number(file: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError as error:
        raise CalibrationError(f"{file}:{line}: {name} is '{text}', not a number") from error
    if not np.isfinite(value):
        raise CalibrationError(f"{file}:{line}: {name} is {value}; it must be finite")
    return value


@click.command()
@click.argument("table", metavar="TABLE.csv", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--focal-px", type=FiniteRange(min=1.0), help="Focal length, to say what the physical law means.")
def depth(table: Path, focal_px: float | None) -> None:
    """Fit the disparity-to-depth law to measured distances.

    TABLE.csv has one row per distance, with a header: distance_cm and either disparity_px or left_x and right_x (where
    the marker is in both pictures). Hold a marker at ten or more measured distances over the range that you use.

    Prints the law D = k · d^z of `[fusion] method = "disparity"`, the physical law D = a / (d − o), and how far each
    row is from both.
    """
    distance_m, disparity_px = read_rows(table)
    power, physical = fit_power_law(distance_m, disparity_px), fit_physical_law(distance_m, disparity_px)
    console = Console(soft_wrap=True, markup=False)
    console.print(_rows_table(distance_m, disparity_px, power, physical))
    errors = [100.0 * relative_rms(law, distance_m, disparity_px) for law in (power, physical)]
    console.print(f"power law     D[cm] = {100 * power.k:.1f} · d^{power.z:.4f}   relative error {errors[0]:.2f} % RMS")
    console.print(
        f"physical law  D[cm] = {100 * physical.a:.1f} / (d − {physical.offset_px:.2f})   relative error "
        f"{errors[1]:.2f} % RMS"
    )
    if focal_px is not None:
        turn_deg = np.degrees(np.arctan(physical.offset_px / focal_px))
        console.print(
            f"with a focal length of {focal_px:g} px: a baseline of {1e3 * physical.a / focal_px:.1f} mm, cameras "
            f"turned against each other by {turn_deg:.2f}°"
        )
    console.print(f"in rig.toml, under [fusion.options]: depth_law = [{100 * power.k:.1f}, {power.z:.4f}]")


def _rows_table(distance_m: FloatArray, disparity_px: FloatArray, power: PowerLaw, physical: PhysicalLaw) -> Table:
    table = figures_table("distance cm", "disparity px", "power law cm", "off %", "physical cm", "off %")
    guesses = power.depth_m(disparity_px), physical.depth_m(disparity_px)
    for row, (distance, disparity) in enumerate(zip(distance_m, disparity_px, strict=True)):
        cells = [f"{100 * distance:.1f}", f"{disparity:.1f}"]
        for guess in guesses:
            cells += [f"{100 * guess[row]:.1f}", f"{100 * (guess[row] / distance - 1):+.1f}"]
        table.add_row(*cells)
    return table
