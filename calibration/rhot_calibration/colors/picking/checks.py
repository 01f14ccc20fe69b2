"""Refusing what no colours can be learnt from, with the place and the remedy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, ImageArray
from rhot.errors import CalibrationError
from rhot.rig.config import MarkerConfig
from rhot_calibration.colors.model.quality import MarkerQuality
from rhot_calibration.colors.picking.picks import Box, Place, Places, place_text

_LEAST_BOX_PX: Final = 4
_LEAST_MARKED: Final = 0.4
"""Share of a marker's own pixels that must be told from the surroundings, whichever marker they are given to."""


def check_places(images: Sequence[ImageArray], places: Sequence[Places], markers: Mapping[str, MarkerConfig]) -> None:
    """Check what was pointed out against pictures and markers.

    Raises:
        CalibrationError: nothing at all, an unknown marker, a place outside its picture or a rectangle without area.
    """
    if len(images) != len(places) or not any(places):
        raise CalibrationError(
            "no picks: name each marker with a place on it, for example --pick thumb=281,215, or with a rectangle "
            "around it, for example --box thumb=269,202,25,26"
        )
    for number, (image, shown) in enumerate(zip(images, places, strict=True), start=1):
        height, width = image.shape[:2]
        for name, place in shown.items():
            said = f"{_kind(place)} {name} = {place_text(place)}"
            if name not in markers:
                raise CalibrationError(
                    f"{_kind(place)} {name}: no such marker in rig.toml, which has {', '.join(markers)}"
                )
            if isinstance(place, Box) and min(place.width, place.height) < _LEAST_BOX_PX:
                raise CalibrationError(
                    f"{said} in picture {number}: width and height must be at least {_LEAST_BOX_PX} px; "
                    "the numbers are left, top, width, height"
                )
            inside = [place] if isinstance(place, tuple) else [(place.u, place.v), _far_corner(place)]
            if any(not (0 <= u <= width - 1 and 0 <= v <= height - 1) for u, v in inside):
                raise CalibrationError(f"{said} lies outside picture {number}, which is {width}x{height}")


def _kind(place: Place) -> str:
    return "box" if isinstance(place, Box) else "pick"


def _far_corner(box: Box) -> tuple[float, float]:
    return box.u + box.width - 1.0, box.v + box.height - 1.0


def check_regions(
    found: Sequence[Mapping[str, BoolArray]], places: Sequence[Places], markers: Mapping[str, MarkerConfig]
) -> None:
    """Check what was found at the places.

    Raises:
        CalibrationError: too little of one colour, or two markers at one patch of colour.
    """
    for number, (regions, shown) in enumerate(zip(found, places, strict=True), start=1):
        for name, region in regions.items():
            area = int(np.count_nonzero(region))
            least = markers[name].min_area_px
            if area < least:
                place = shown[name]
                remedy = (
                    "draw the box around the whole marker with some of its surroundings"
                    if isinstance(place, Box)
                    else "pick the middle of the painted area"
                )
                raise CalibrationError(
                    f"{_kind(place)} {name} = {place_text(place)} in picture {number}: only {area} px of one colour "
                    f"stand out there, a marker has at least {least:g}; {remedy}, or lower min_area_px"
                )
        for name, region in regions.items():
            for other, other_region in regions.items():
                if name < other and np.count_nonzero(region & other_region) > 0.5 * np.count_nonzero(region):
                    raise CalibrationError(
                        f"picks {name} and {other} in picture {number} found the same patch of colour; pick each on "
                        "its own marker"
                    )


def check_quality(quality: Mapping[str, MarkerQuality]) -> None:
    """Check that every marker stands out from what surrounds it.

    Raises:
        CalibrationError: a marker's colour is that of its surroundings.
    """
    for name, each in quality.items():
        if each.marked < _LEAST_MARKED:
            raise CalibrationError(
                f"pick {name}: the colour found near {each.u:.0f},{each.v:.0f} is that of its surroundings "
                f"({100 * each.marked:.0f} % of it can be told apart, {100 * _LEAST_MARKED:.0f} % is the least); "
                "pick the painted area itself, or use a paint that stands out"
            )
