"""One colour per marker for people: that of its paint, bright enough for a screen."""

from __future__ import annotations

import colorsys
import logging

import numpy as np

from rhot.errors import RhotError
from rhot.rig import Rig
from rhot.rig.colors import GaussianColor, HsvRangeColor, MarkerColor, load_colors
from rhot.rig.marker_config import worn_paints
from rhot_viewer.scene.instances import Rgb

logger = logging.getLogger(__name__)


def marker_colors(rig: Rig) -> dict[str, Rgb]:
    """Return a colour for each marker of a rig: from `colors.json`, or spread over the colour circle without it."""
    names = list(rig.config.markers)
    unpainted_lightness = 0.6
    spread = {
        name: _bytes(np.array(colorsys.hls_to_rgb(index / len(names), unpainted_lightness, 0.8)) * 255.0)
        for index, name in enumerate(names)
    }
    if not rig.colors_path.exists():
        return spread
    try:
        painted = load_colors(rig.colors_path).markers
    except RhotError as error:
        logger.warning("markers are shown in made-up colours: %s", error)
        return spread
    worn = worn_paints(rig.config.markers)
    return spread | {name: screen_color(painted[paint]) for name, paint in worn.items() if paint in painted}


def screen_color(color: MarkerColor) -> Rgb:
    """Return a paint's middle, made so bright that its strongest channel stands out on the page."""
    if isinstance(color, GaussianColor):
        rgb = np.array(max(color.components, key=lambda component: component.weight).rgb)
    elif isinstance(color, HsvRangeColor):
        start, end = color.hue_deg
        hue = (start + 0.5 * ((end - start) % 360.0)) % 360.0 / 360.0
        rgb = np.array(colorsys.hsv_to_rgb(hue, sum(color.saturation) / 2.0, sum(color.value) / 2.0)) * 255.0
    else:
        rgb = 0.5 * (np.array(color.low) + np.array(color.high))
    brightest_at_least = 190.0
    return _bytes(rgb * max(1.0, brightest_at_least / max(float(rgb.max()), 1.0)))


def _bytes(rgb: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Rgb:
    red, green, blue = (round(float(np.clip(channel, 0.0, 255.0))) for channel in rgb)
    return red, green, blue
