"""Bounds of a marker's colour in hue, saturation and value, for the sliders of the page.

A learned colour is a distribution, not a box. Its bounds are percentiles of the colours that it labels. Once a user has
moved them, the bounds replace the learned colour as an `hsv_range`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final

import numpy as np
from pydantic import Field, model_validator

from rhot.arrays import FloatArray
from rhot.messages import Name
from rhot.rig.colors import ColorsFile, HsvRangeColor, Share
from rhot.rig.file_model import FileModel
from rhot_capture.detection.color_table import ColorTable, hsv_of, table_colors

_TYPICAL: Final = 255.0 * np.exp(-0.5 * 2.0**2)
"""Likelihood two standard deviations from the mean of a class."""
_ENDS: Final = (1.0, 99.0)
"""Percentiles used as bounds of a learned colour, so that single cells of the table do not matter."""

Degrees = Annotated[float, Field(ge=0.0, le=360.0)]


class ColorBounds(FileModel):
    """Bounds of one marker's colour.

    Attributes:
        hue_deg: from, to, degrees on the colour circle; 340 to 20 passes through red.
        saturation: lowest and highest, 0 to 1.
        value: lowest and highest, 0 to 1.
        in_force: whether these bounds replace the colour in colors.json; otherwise they only describe it.
    """

    hue_deg: tuple[Degrees, Degrees]
    saturation: tuple[Share, Share]
    value: tuple[Share, Share]
    in_force: bool = False

    @model_validator(mode="after")
    def _ordered(self) -> ColorBounds:
        self.color(1.0)
        return self

    def color(self, tolerance: float) -> HsvRangeColor:
        """Return these bounds as a colour range."""
        return HsvRangeColor(hue_deg=self.hue_deg, saturation=self.saturation, value=self.value, tolerance=tolerance)


def bounds_of(colors: ColorsFile, table: ColorTable) -> dict[Name, ColorBounds]:
    """Return the bounds of all colours that label at least one cell of the table.

    Args:
        colors: the colours from which the table was built.
        table: the table of their markers.
    """
    hsv = hsv_of(table_colors())
    found = {}
    for label, name in enumerate(table.names, start=1):
        color = colors.markers.get(name)
        if isinstance(color, HsvRangeColor):
            found[name] = ColorBounds(hue_deg=color.hue_deg, saturation=color.saturation, value=color.value)
            continue
        claimed = hsv[(table.labels == label) & (table.likelihoods >= _TYPICAL)]
        if len(claimed):
            found[name] = _around(claimed)
    return found


def with_bounds(colors: ColorsFile, bounds: Mapping[str, ColorBounds]) -> ColorsFile:
    """Return colours in which the bounds in force replace the learned colours."""
    ranges = {
        name: each.color(colors.markers[name].tolerance)
        for name, each in bounds.items()
        if each.in_force and name in colors.markers
    }
    return colors.model_copy(update={"markers": {**colors.markers, **ranges}})


def _around(hsv: FloatArray) -> ColorBounds:
    angle = np.radians(hsv[:, 0])
    middle = np.degrees(np.arctan2(np.sin(angle).mean(), np.cos(angle).mean()))
    offset = (hsv[:, 0] - middle + 180.0) % 360.0 - 180.0
    start, end = (float(np.round(middle + at) % 360.0) for at in np.percentile(offset, _ENDS))
    (low_s, low_v), (high_s, high_v) = np.round(np.percentile(hsv[:, 1:], _ENDS, axis=0), 2).tolist()
    return ColorBounds(hue_deg=(start, end), saturation=(low_s, high_s), value=(low_v, high_v))
