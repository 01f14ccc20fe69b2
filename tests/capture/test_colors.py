from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from rhot.errors import CalibrationError, ConfigError
from rhot.rig import write_json_model
from rhot.rig.colors import (
    DARK_OFFSET,
    ColorComponent,
    ColorsFile,
    GaussianColor,
    HsvRangeColor,
    RgbBoxColor,
    load_colors,
    log_ratio,
    nominal_colors,
)

channels = st.floats(min_value=20.0, max_value=250.0)


@given(st.tuples(channels, channels, channels), st.floats(min_value=0.3, max_value=1.0))
@settings(deadline=None, max_examples=60)
def test_light_moves_a_paint_along_the_third_axis_only(rgb: tuple[float, float, float], light: float) -> None:
    offset = np.full(3, DARK_OFFSET)
    full = log_ratio(np.array(rgb))
    dimmed = log_ratio((np.array(rgb) + offset) * light - offset)
    assert np.allclose(full[:2], dimmed[:2], atol=1e-12)
    assert dimmed[2] - full[2] == pytest.approx(np.log(light), abs=1e-12)


def test_correlation_that_contradicts_itself_is_refused() -> None:
    with pytest.raises(ValidationError, match="contradicts itself"):
        ColorComponent(rgb=(10, 20, 30), sigma=(0.1, 0.1, 0.1), correlation=(0.9, 0.9, -0.9))


def test_covariance_holds_sigma_and_correlation() -> None:
    covariance = ColorComponent(rgb=(10, 20, 30), sigma=(0.1, 0.2, 0.3), correlation=(0.5, 0.0, -0.5)).covariance()
    assert np.allclose(np.sqrt(np.diag(covariance)), (0.1, 0.2, 0.3))
    assert covariance[0, 1] == pytest.approx(0.5 * 0.1 * 0.2)
    assert covariance[1, 2] == pytest.approx(-0.5 * 0.2 * 0.3)


@pytest.mark.parametrize(
    "build",
    [
        lambda: RgbBoxColor(low=(50, 0, 0), high=(40, 255, 255)),
        lambda: RgbBoxColor(low=(0, 0, 0), high=(256, 255, 255)),
        lambda: HsvRangeColor(hue_deg=(0, 20), saturation=(0.8, 0.2)),
        lambda: GaussianColor(components=()),
        lambda: GaussianColor(components=(ColorComponent(rgb=(1, 2, 3), sigma=(1, 1, 1)),), tolerance=0.0),
    ],
)
def test_impossible_colours_are_refused(build: object) -> None:
    assert callable(build)
    with pytest.raises(ValidationError):
        build()


def test_file_round_trip_keeps_every_kind(tmp_path: Path) -> None:
    colors = ColorsFile(
        date="2026-01-01",
        quality={"thumb": {"recovered": 0.98}},
        markers={
            "thumb": GaussianColor(components=(ColorComponent(rgb=(10, 20, 30), sigma=(0.1, 0.1, 0.3)),)),
            "index": RgbBoxColor(low=(0, 0, 0), high=(40, 255, 255)),
            "ring": HsvRangeColor(hue_deg=(340, 20)),
        },
        background=GaussianColor(components=(ColorComponent(rgb=(1, 2, 3), sigma=(1, 1, 1)),)),
    )
    write_json_model(tmp_path / "colors.json", colors)
    assert load_colors(tmp_path / "colors.json") == colors


def test_wrong_file_names_the_field(tmp_path: Path) -> None:
    (tmp_path / "colors.json").write_text('{"markers": {"thumb": {"kind": "rgb_box", "low": [0, 0, 0]}}}')
    with pytest.raises(CalibrationError, match=r"markers\.thumb.*high"):
        load_colors(tmp_path / "colors.json")


def test_tolerances_change_one_marker_and_refuse_nonsense() -> None:
    colors = nominal_colors({"thumb": (10, 200, 30), "index": (200, 10, 30)})
    wider = colors.with_tolerances({"thumb": 1.5})
    assert wider.markers["thumb"].tolerance == 1.5
    assert wider.markers["index"] == colors.markers["index"]
    with pytest.raises(ConfigError, match=r"nose.*thumb, index"):
        colors.with_tolerances({"nose": 1.0})
    with pytest.raises(ConfigError, match="tolerance"):
        colors.with_tolerances({"thumb": -1.0})
