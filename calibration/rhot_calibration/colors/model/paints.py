"""Paints that one can buy, how they would look to the cameras, and which one stands out best from all others."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.rig.colors import ColorComponent, ColorsFile, GaussianColor, RgbColor, log_ratio
from rhot_calibration.colors.model.fit import ClassPixels, bhattacharyya, rgb_of

PAINTS: Final[Mapping[str, RgbColor]] = {
    "titanium white": (243, 244, 240),
    "lemon yellow": (250, 226, 32),
    "cadmium yellow": (254, 194, 12),
    "cadmium orange": (240, 116, 24),
    "cadmium red": (214, 40, 34),
    "crimson": (164, 26, 48),
    "magenta": (196, 24, 116),
    "fluorescent pink": (255, 72, 140),
    "light pink": (246, 170, 190),
    "violet": (92, 44, 128),
    "lavender": (170, 140, 212),
    "ultramarine": (32, 44, 150),
    "cobalt blue": (20, 78, 172),
    "cerulean blue": (20, 130, 196),
    "sky blue": (120, 196, 236),
    "turquoise": (0, 160, 166),
    "phthalo green": (0, 92, 72),
    "emerald green": (0, 152, 92),
    "permanent green light": (70, 172, 62),
    "fluorescent green": (96, 240, 60),
    "yellow green": (168, 208, 48),
    "burnt sienna": (134, 62, 36),
    "mars black": (34, 32, 34),
}
"""Common acrylic colours as sRGB, dry and in white light. Brands differ: they serve to choose a direction, no more."""

TYPICAL_SKIN: Final[RgbColor] = (205, 168, 132)
_GREY: Final = 0.35
"""A pixel is grey when ln(R/G) and ln(B/G) are smaller than this: cloth, desk or paper in light of any usual tint."""
_GREY_LEVELS: Final = (30.0, 235.0)
_LEAST_SKIN: Final = 50
_EXPOSURE: Final = (0.4, 2.0)
_SATURATION: Final = (0.3, 1.0)


@dataclass(frozen=True, slots=True)
class Illumination:
    """What light and camera make of a colour: one factor for each channel, and a loss of saturation.

    Attributes:
        gains: of red, green and blue.
        saturation: factor on how far a colour's ratios lie from those of grey; gloss and glare take some away.
        source: what they were estimated from, for people.
    """

    gains: tuple[float, float, float]
    saturation: float
    source: str

    def seen(self, rgb: RgbColor) -> RgbColor:
        """Return what a colour under white light would look like in the pictures, 0 to 255."""
        lit = log_ratio(np.clip(np.array(rgb) * self.gains, 0.0, 255.0))
        grey = log_ratio(rgb_of(lit * (0.0, 0.0, 1.0)) * self.gains)
        lit[:2] = grey[:2] + self.saturation * (lit[:2] - grey[:2])
        red, green, blue = (float(channel) for channel in rgb_of(lit))
        return red, green, blue


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A paint that would stand out better.

    Attributes:
        marker: whose paint to replace.
        paint: name of the better paint.
        rgb: how it would look in the pictures, an estimate.
        distance: its least Bhattacharyya distance from everything else.
        present: that of the paint worn now.
    """

    marker: str
    paint: str
    rgb: RgbColor
    distance: float
    present: float


def estimate_illumination(pixels: ClassPixels) -> Illumination:
    """Estimate how the pictures were lit: tint from grey surroundings, exposure from skin, saturation from the paints.

    Where nothing is grey, the tint is that which makes skin a typical one; without skin either, light counts as white.
    """
    worn = np.array([_saturation(own) for own in pixels.markers.values()])
    usual = float(np.median([_saturation(np.array([rgb])) for rgb in PAINTS.values()]))
    saturation = float(np.clip(np.median(worn) / usual, *_SATURATION))
    rgb = pixels.others[(pixels.others >= _GREY_LEVELS[0]).all(axis=1) & (pixels.others <= _GREY_LEVELS[1]).all(axis=1)]
    grey = rgb[np.all(np.abs(log_ratio(rgb)[:, :2]) < _GREY, axis=1)]
    has_skin = len(pixels.skin) >= _LEAST_SKIN
    skin = np.median(pixels.skin, axis=0) / np.array(TYPICAL_SKIN) if has_skin else np.ones(3)
    least_grey = 300
    if len(grey) >= least_grey:
        tint = np.median(grey / grey[:, 1:2], axis=0)
        source = "grey surroundings"
    elif has_skin:
        tint = skin / skin[1]
        source = "skin"
    else:
        return Illumination((1.0, 1.0, 1.0), saturation, "nothing: neither grey nor skin is in the pictures")
    exposure = float(np.clip(skin.mean() / tint.mean(), *_EXPOSURE)) if has_skin else 1.0
    red, green, blue = (float(gain) for gain in exposure * tint)
    return Illumination((red, green, blue), saturation, source + (" and skin" if has_skin and source != "skin" else ""))


def _saturation(rgb: FloatArray) -> float:
    """Return how far colours (N, 3) lie from grey in the plane of colour ratios, median."""
    return float(np.median(np.hypot(*log_ratio(rgb)[:, :2].T)))


def suggest(
    colors: ColorsFile, first: str, second: str, illumination: Illumination, without: Collection[str] = ()
) -> Suggestion | None:
    """Return the paint that stands out best in place of one of two that are too near, None when none is better.

    Args:
        colors: the present colours.
        first: marker whose paint is too near to `second`.
        second: another marker, or skin or background; of two markers the one is replaced where that helps more.
        illumination: of the pictures.
        without: paints that have another use already.
    """
    # A new paint is expected to spread in shade and highlight as the present ones do.
    spread = np.median([part.sigma for name in colors.markers for part in _parts(colors, name)], axis=0)
    sigma = (float(spread[0]), float(spread[1]), float(spread[2]))
    found = []
    for marker in (first, second):
        own = _parts(colors, marker)
        if not own:
            continue
        others = _others(colors, marker)
        present = _least_distance(own, others)
        for paint, rgb in PAINTS.items():
            seen = illumination.seen(rgb)
            distance = _least_distance([ColorComponent(rgb=seen, sigma=sigma)], others)
            if distance > present and paint not in without:
                found.append(Suggestion(marker, paint, seen, distance, present))
    return max(found, key=lambda each: each.distance, default=None)


def _parts(colors: ColorsFile, marker: str) -> Sequence[ColorComponent]:
    color = colors.markers.get(marker)
    return color.components if isinstance(color, GaussianColor) else ()


def _others(colors: ColorsFile, marker: str) -> list[ColorComponent]:
    others = [part for name in colors.markers if name != marker for part in _parts(colors, name)]
    for counter in (colors.skin, colors.background):
        if counter is not None:
            least_weight = 0.005
            others += [part for part in counter.components if part.weight >= least_weight]
    return others


def _least_distance(own: Sequence[ColorComponent], others: Sequence[ColorComponent]) -> float:
    return min((bhattacharyya(a, b) for a in own for b in others), default=float("inf"))
