"""Bounds of a marker's colour in hue, saturation and value, as people see and move them.

A learned colour is a cloud, not a box. Its bounds are where the colours lie that it claims, so that a slider shows
where it stands; once moved and in force, bounds take its place as an `hsv_range`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final

import cv2
import numpy as np
from pydantic import Field, model_validator

from rhot.arrays import FloatArray
from rhot.messages import Name
from rhot.rig.colors import ColorsFile, HsvRangeColor, Share
from rhot.rig.file_model import FileModel
from rhot_capture.detection.color_table import ColorTable, table_colors

_TYPICAL: Final = 255.0 * np.exp(-0.5 * 2.0**2)
"""Likelihood two standard deviations from the middle of a class: 95 of 100 of its pixels lie within."""
_ENDS: Final = (1.0, 99.0)
"""Percentiles that count as the ends of what a learned colour claims: single cells of the table do not."""

Degrees = Annotated[float, Field(ge=0.0, le=360.0)]


class ColorBounds(FileModel):
    """Bounds of one marker's colour.

    Attributes:
        hue_deg: from, to, degrees on the colour circle; 340 to 20 passes through red.
        saturation: lowest and highest, 0 to 1.
        value: lowest and highest, 0 to 1.
        in_force: these bounds decide, in place of what colors.json says; otherwise they only tell where that stands.
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
        """Return the colour that these bounds mean."""
        return HsvRangeColor(hue_deg=self.hue_deg, saturation=self.saturation, value=self.value, tolerance=tolerance)


def bounds_of(colors: ColorsFile, table: ColorTable) -> dict[Name, ColorBounds]:
    """Return the bounds of all colours that claim anything.

    Args:
        colors: what the table was built from.
        table: its markers.
    """
    hsv = _hsv(table_colors())
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
    """Return colours in which bounds that are in force stand in place of what was there."""
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


def _hsv(rgb: FloatArray) -> FloatArray:
    """Return hue in degrees, saturation and value, 0 to 1, of (N, 3) colours."""
    picture = (rgb / 255.0).astype(np.float32).reshape(1, -1, 3)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2HSV)[0], dtype=np.float64)
