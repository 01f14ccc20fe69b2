from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.errors import CalibrationError
from rhot_calibration.depth.command import depth, read_rows
from rhot_calibration.depth.fit import fit_physical_law, fit_power_law, relative_rms

DISTANCES_M = np.linspace(0.2, 1.0, 17)


@settings(deadline=None, max_examples=30)
@given(st.floats(10.0, 80.0), st.floats(-8.0, 8.0))
def test_the_physical_law_is_recovered(a: float, offset_px: float) -> None:
    law = fit_physical_law(DISTANCES_M, a / DISTANCES_M + offset_px)
    assert law.a == pytest.approx(a, rel=1e-6)
    assert law.offset_px == pytest.approx(offset_px, abs=1e-5)


@settings(deadline=None, max_examples=30)
@given(st.floats(10.0, 80.0), st.floats(-1.3, -0.8))
def test_the_power_law_is_recovered(k: float, z: float) -> None:
    law = fit_power_law(DISTANCES_M, (DISTANCES_M / k) ** (1.0 / z))
    assert law.k == pytest.approx(k, rel=1e-9)
    assert law.z == pytest.approx(z, rel=1e-9)


def test_whole_pixels_cost_little_depth() -> None:
    """Disparities rounded to pixels, as the 2018 rig measured them: both laws stay within 3 % of 20 to 100 cm."""
    disparity = np.round(38.4 / DISTANCES_M + 1.5)
    for law in (fit_power_law(DISTANCES_M, disparity), fit_physical_law(DISTANCES_M, disparity)):
        assert np.abs(law.depth_m(disparity) / DISTANCES_M - 1.0).max() < 0.03


def test_the_published_table_gives_the_published_law(shared_data: Path) -> None:
    distance_m, disparity_px = read_rows(shared_data / "thesis_rig" / "depth_table.csv")
    assert len(distance_m) == 17
    power, physical = fit_power_law(distance_m, disparity_px), fit_physical_law(distance_m, disparity_px)
    assert round(100.0 * power.k, 1) == 4543.3
    assert round(power.z, 3) == -1.035
    assert relative_rms(physical, distance_m, disparity_px) <= relative_rms(power, distance_m, disparity_px)


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("", "no column distance_cm"),
        ("distance_cm,left_x\n1,2\n", "no column right_x"),
        ("distance_cm,disparity_px\n20,100\n40,50\n", "too few"),
        ("distance_cm,disparity_px\n20,100\n40,fifty\n", ":3: disparity_px is 'fifty'"),
        ("distance_cm,disparity_px\n20,100\n40,nan\n", ":3: disparity_px"),
        ("distance_cm,left_x,right_x\n20,100,200\n40,100,150\n80,100,125\n", "swapped"),
        ("distance_cm,disparity_px\n20,25\n40,50\n80,100\n", "does not fall"),
        ("distance_cm,disparity_px\n80,25\n81,24\n82,23\n", "wider range"),
        ("distance_cm,disparity_px\n0,25\n81,24\n82,23\n", "must be positive"),
    ],
)
def test_rows_that_cannot_be_are_refused(tmp_path: Path, rows: str, says: str) -> None:
    file = tmp_path / "table.csv"
    file.write_text(rows)
    with pytest.raises(CalibrationError, match=says):
        CliRunner().invoke(depth, [str(file)], catch_exceptions=False)


def test_the_command_says_what_to_write_where(tmp_path: Path) -> None:
    file = tmp_path / "table.csv"
    rows = "\n".join(f"{100 * d:.1f},{300 + 38.4 / d + 2.0:.2f},300" for d in DISTANCES_M)
    file.write_text(f"distance_cm,left_x,right_x\n{rows}\n")
    result = CliRunner().invoke(depth, [str(file), "--focal-px", "512"], catch_exceptions=False)
    assert result.exit_code == 0
    assert "baseline of 75.0 mm" in result.output
    assert "depth_law = [" in result.output
    assert len([line for line in result.output.splitlines() if "." in line]) >= 17
