"""What `rhot calibrate cameras` prints."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from rhot.report.tables import figures_table
from rhot_calibration.cameras.calibration import Calibrated, bow_mm
from rhot_calibration.cameras.figures import MARKER_SIGMA_PX


def print_report(console: Console, calibrated: Calibrated) -> None:
    """Print what was found, what was left out, and what to expect."""
    console.print(_cameras(calibrated))
    console.print(_pairs(calibrated))
    console.print(_errors(calibrated))
    adjusted = calibrated.solution.adjusted
    if adjusted.released:
        console.print(
            f"the board is not flat: its corners lie within {bow_mm(adjusted):.1f} mm of depth. Its shape was "
            f"estimated together with the cameras: {adjusted.total_rms_px():.2f} px RMS instead of "
            f"{calibrated.solution.flat_rms_px:.2f} px"
        )
    if calibrated.left_out:
        console.print("left out:")
        for label, reason in calibrated.left_out.items():
            console.print(f"  {label}: {reason}")
    for warning in calibrated.warnings:
        console.print(f"warning: {warning}", style="yellow")


def print_problems(console: Console, problems: Mapping[str, str]) -> None:
    """Print which pictures could not be used, by reason."""
    by_reason: dict[str, list[str]] = {}
    for label, reason in problems.items():
        by_reason.setdefault(reason, []).append(label)
    for reason, labels in by_reason.items():
        console.print(f"{reason}, {len(labels)} picture(s): {', '.join(labels)}")


def _cameras(calibrated: Calibrated) -> Table:
    table = figures_table(
        "camera",
        "pictures",
        "RMS px",
        "p95 px",
        "fx px",
        "fy px",
        "cx px",
        "cy px",
        "position mm",
        "± mm",
        "± deg",
        title="Cameras",
    )
    for name, figures in calibrated.cameras.items():
        model = calibrated.models[name]
        lens = zip((model.K[0, 0], model.K[1, 1], model.K[0, 2], model.K[1, 2]), figures.lens_sd[:4], strict=True)
        place = ", ".join(f"{1e3 * value:.1f}" for value in model.center)
        table.add_row(
            name,
            str(figures.pictures),
            f"{figures.rms_px:.3f}",
            f"{figures.p95_px:.3f}",
            *(f"{value:.1f} ±{sd:.1f}" for value, sd in lens),
            place,
            f"{figures.position_sd_mm:.2f}" if figures.position_sd_mm else "-",
            f"{figures.rotation_sd_deg:.3f}" if figures.rotation_sd_deg else "-",
        )
    return table


def _pairs(calibrated: Calibrated) -> Table:
    table = figures_table(
        "cameras",
        "pictures",
        "baseline mm",
        "angle deg",
        "epipolar RMS px",
        "p95 px",
        "p95 px held out",
        title="Pairs",
    )
    for (first, second), figures in calibrated.pairs.items():
        held_out = calibrated.held_out_px.get((first, second))
        table.add_row(
            f"{first}, {second}",
            str(figures.pictures),
            f"{figures.baseline_mm:.2f} ±{figures.baseline_sd_mm:.2f}",
            f"{figures.angle_deg:.2f}",
            f"{figures.epipolar_rms_px:.3f}",
            f"{figures.epipolar_p95_px:.3f}",
            "-" if held_out is None else f"{held_out:.3f}",
        )
    return table


def _errors(calibrated: Calibrated) -> Table:
    table = figures_table(
        "distance",
        "from the calibration mm",
        f"with {MARKER_SIGMA_PX:g} px of marker noise mm",
        "near the rim mm",
        title="Error to expect in space",
    )
    for error in calibrated.errors:
        table.add_row(
            f"{100 * error.distance_m:.0f} cm",
            f"{error.calibration_mm:.2f}",
            f"{error.total_mm:.2f}",
            f"{error.rim_mm:.2f}",
        )
    return table
