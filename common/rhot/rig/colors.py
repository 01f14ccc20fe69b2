"""`colors.json`: what each marker's paint looks like to the cameras.

A colour is described in one of three ways, told apart by `kind`:

- `gaussian`, fitted to samples by `rhot calibrate colors`: normal distributions in log-ratio space
  (`log_ratio`), where shading moves a paint along one axis only;
- `rgb_box`, lower and upper limit per channel;
- `hsv_range`, a range of hue, saturation and value.

All three are plain numbers that may be edited by hand. `tolerance` widens (above 1) or narrows (below 1) a colour
without touching its numbers, and is what a slider moves while the service runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.messages import Name, first_problem
from rhot.rig.calibration import CalibrationFile
from rhot.rig.file_model import FileModel, Positive
from rhot.rig.folder import read_json_model

Channel = Annotated[float, Field(ge=0.0, le=255.0)]
RgbColor = tuple[Channel, Channel, Channel]
Correlation = Annotated[float, Field(gt=-1.0, lt=1.0)]
Tolerance = Annotated[float, Field(ge=0.1, le=10.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Gain = Annotated[float, Field(ge=0.1, le=10.0)]
Gains = tuple[Gain, Gain, Gain]
"""Factors on red, green and blue."""

DARK_OFFSET: Final = 20.0
"""Grey levels added before logarithms: ratios of dark pixels are noise and must count for little."""


def log_ratio(rgb: FloatArray) -> FloatArray:
    """Return colours in log-ratio space: ln(R/G), ln(B/G) and ln of the brightness.

    With X' = X + `DARK_OFFSET`, the result is (ln R'/G', ln B'/G', ln (R + 2G + B)/4 + offset). Light that falls
    on a paint multiplies R, G and B alike, before and after a camera's gamma curve, so shading moves a colour along
    the third axis and leaves the first two.

    Args:
        rgb: (..., 3) red, green, blue, 0 to 255.

    Returns:
        (..., 3) float64, no unit.
    """
    shifted = rgb + DARK_OFFSET
    red, green, blue = shifted[..., 0], shifted[..., 1], shifted[..., 2]
    brightness = 0.25 * (red + 2.0 * green + blue)
    return np.stack([np.log(red / green), np.log(blue / green), np.log(brightness)], axis=-1)


class ColorComponent(FileModel):
    """One normal distribution in log-ratio space.

    Attributes:
        rgb: its centre as a colour, 0 to 255.
        sigma: standard deviations of ln(R/G), ln(B/G) and ln(brightness).
        correlation: between the first and second, first and third, second and third of these.
        weight: share of the class's samples.
    """

    rgb: RgbColor
    sigma: tuple[Positive, Positive, Positive]
    correlation: tuple[Correlation, Correlation, Correlation] = (0.0, 0.0, 0.0)
    weight: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0

    @model_validator(mode="after")
    def _positive_definite(self) -> ColorComponent:
        if np.linalg.eigvalsh(self.covariance())[0] <= 0.0:
            raise ValueError(f"correlation {self.correlation} contradicts itself; nearer to 0 is always valid")
        return self

    def mean(self) -> FloatArray:
        """Return the centre in log-ratio space, (3,)."""
        return log_ratio(np.array(self.rgb))

    def covariance(self) -> FloatArray:
        """Return the (3, 3) covariance in log-ratio space."""
        first_second, first_third, second_third = self.correlation
        correlation = np.array(
            [[1.0, first_second, first_third], [first_second, 1.0, second_third], [first_third, second_third, 1.0]]
        )
        sigma = np.array(self.sigma)
        return correlation * np.outer(sigma, sigma)


class GaussianColor(FileModel):
    """A colour as a mixture of normal distributions fitted to samples.

    Attributes:
        components: the mixture.
        limit: a pixel further than this many standard deviations from every component is not of this colour.
        tolerance: factor on `limit`.
    """

    kind: Literal["gaussian"] = "gaussian"
    components: Annotated[tuple[ColorComponent, ...], Field(min_length=1, max_length=128)]
    limit: Positive = 3.5
    tolerance: Tolerance = 1.0


class RgbBoxColor(FileModel):
    """A colour as a box in RGB.

    Attributes:
        low, high: inclusive limits of red, green and blue, 0 to 255.
        tolerance: factor on the box's size about its middle.
    """

    kind: Literal["rgb_box"] = "rgb_box"
    low: RgbColor
    high: RgbColor
    tolerance: Tolerance = 1.0

    @model_validator(mode="after")
    def _ordered(self) -> RgbBoxColor:
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low {self.low} must not be above high {self.high} in any channel")
        return self


class HsvRangeColor(FileModel):
    """A colour as ranges of hue, saturation and value.

    Attributes:
        hue_deg: from, to, degrees on the colour circle; 340 to 20 passes through red.
        saturation: lowest and highest, 0 to 1.
        value: lowest and highest, 0 to 1.
        tolerance: factor on the ranges' sizes about their middles.
    """

    kind: Literal["hsv_range"] = "hsv_range"
    hue_deg: tuple[Annotated[float, Field(ge=0.0, le=360.0)], Annotated[float, Field(ge=0.0, le=360.0)]]
    saturation: tuple[Share, Share] = (0.3, 1.0)
    value: tuple[Share, Share] = (0.2, 1.0)
    tolerance: Tolerance = 1.0

    @model_validator(mode="after")
    def _ordered(self) -> HsvRangeColor:
        for name, (low, high) in (("saturation", self.saturation), ("value", self.value)):
            if low > high:
                raise ValueError(f"{name}: the lower limit {low} must not be above the upper limit {high}")
        return self


MarkerColor = Annotated[GaussianColor | RgbBoxColor | HsvRangeColor, Field(discriminator="kind")]


class ColorsFile(CalibrationFile):
    """`colors.json`.

    A pixel that a box or a range claims is given to it. Otherwise the most likely statistical class wins, provided
    that it is a marker and within its limit; skin and background exist to win against the markers.

    Attributes:
        markers: marker name to its colour; a marker without one is never reported.
        skin, background: classes that are not markers; optional.
        gains: camera name to the factors by which its red, green and blue are multiplied before they are compared with
            the statistical classes: cameras of one rig may differ in white balance and exposure. None = all 1. Boxes
            and ranges are about a picture as it is.
    """

    markers: Annotated[dict[Name, MarkerColor], Field(max_length=64)]
    skin: GaussianColor | None = None
    background: GaussianColor | None = None
    gains: Annotated[dict[Name, Gains], Field(max_length=64)] = {}

    def with_tolerances(self, tolerances: Mapping[str, float]) -> ColorsFile:
        """Return the colours with other tolerances per marker.

        Raises:
            ConfigError: a marker has no colour here, or a tolerance is out of bounds.
        """
        unknown = [name for name in tolerances if name not in self.markers]
        if unknown:
            raise ConfigError(
                f"tolerance of {', '.join(unknown)}: no such marker in colors.json, which has {', '.join(self.markers)}"
            )
        data = self.model_dump()
        for name, tolerance in tolerances.items():
            data["markers"][name]["tolerance"] = tolerance
        try:
            return ColorsFile.model_validate(data)
        except ValidationError as error:
            raise ConfigError(f"tolerance: {first_problem(error)}") from error


def load_colors(path: Path) -> ColorsFile:
    """Read `colors.json`.

    Raises:
        CalibrationError: missing, not JSON, or a wrong value; names the field.
    """
    return read_json_model(path, ColorsFile)


def nominal_colors(paints: Mapping[str, RgbColor]) -> ColorsFile:
    """Return colours for paints of known RGB, where nothing has been calibrated: simulation and first trials.

    Args:
        paints: marker name to red, green, blue, 0 to 255.
    """
    return ColorsFile(
        markers={
            name: GaussianColor(components=(ColorComponent(rgb=rgb, sigma=(0.09, 0.09, 0.35)),), limit=3.0)
            for name, rgb in paints.items()
        }
    )
