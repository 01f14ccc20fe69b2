"""A registration in a table and lines for people."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.table import Table

from rhot.report.tables import figures_table
from rhot_calibration.objects.fit import Estimate, Places, RegistrationFit
from rhot_calibration.objects.record import change


def places_table(places: Places, fit: RegistrationFit) -> Table:
    """Return each place with what it is off."""
    table = figures_table("place", "x mm", "y mm", "z mm", "off mm")
    table.add_column("")
    for name, x, off, kept in zip(places.names, places.x_rig, fit.residual_m, fit.kept, strict=True):
        cells = [f"{1e3 * value:.1f}" for value in (*x, off)]
        table.add_row(name, *cells, "" if kept else "left out: contradicts the others")
    return table


def report(console: Console, fit: RegistrationFit, prior: Estimate | None) -> None:
    """Print how good a registration is, and what a correction of `prior` changed."""
    estimate = fit.estimate
    if prior is not None:
        moved_m, turned_rad = change(prior, estimate)
        console.print(f"changed by {1e3 * moved_m:.2f} mm amid the places and by {np.degrees(turned_rad):.3f}°")
    sd = 1e3 * float(np.linalg.norm(estimate.position_sd_m))
    x, y, z = 1e3 * estimate.lever_m
    sd_x, sd_y, sd_z = 1e3 * estimate.lever_sd_m
    console.print(f"residual       {1e3 * fit.rms_m:.2f} mm RMS over {np.count_nonzero(fit.kept)} places")
    console.print(f"position       ± {sd:.2f} mm amid the places (one standard deviation)")
    console.print(f"rotation       ± {np.degrees(estimate.rotation_sd_rad):.3f}° about its least certain axis")
    console.print(
        f"marker on the device at {x:.1f} ± {sd_x:.1f}, {y:.1f} ± {sd_y:.1f}, {z:.1f} ± {sd_z:.1f} mm, device axes"
    )
