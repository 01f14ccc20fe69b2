"""The bounds of one marker's colour as three sliders with two ends each, and back."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

Ends = tuple[float, float]

HUE_LOW_DEG: Final = -180.0
"""The slider of hues begins here, so that red, which lies about 0, is one stretch and not two."""
HUE_HIGH_DEG: Final = 360.0
_TURN_DEG: Final = 360.0


@dataclass(frozen=True, slots=True)
class BoundsSliders:
    """Where the sliders stand.

    Attributes:
        hue_deg: from, to; from `HUE_LOW_DEG` to `HUE_HIGH_DEG`, the first not above the second.
        saturation, value: lowest and highest, 0 to 1.
        in_force: they decide in place of the learned colour.
    """

    hue_deg: Ends
    saturation: Ends
    value: Ends
    in_force: bool


def sliders_of(settings: Mapping[str, Any], marker: str) -> BoundsSliders | None:
    """Return where the sliders stand for a camera's settings; None where these hold no bounds of the marker."""
    try:
        bounds = settings["bounds"][marker]
        start, end = (float(each) for each in bounds["hue_deg"])
        saturation, value = (tuple(float(each) for each in bounds[name]) for name in ("saturation", "value"))
        if start > end:
            start -= _TURN_DEG
        if start < HUE_LOW_DEG:
            start, end = start + _TURN_DEG, end + _TURN_DEG
        return BoundsSliders(
            (start, min(end, HUE_HIGH_DEG)),
            (saturation[0], saturation[1]),
            (value[0], value[1]),
            bool(bounds["in_force"]),
        )
    except (KeyError, TypeError, ValueError, IndexError):
        return None


def bounds_html(sliders: BoundsSliders) -> str:
    """Return the bounds as numbers beside the colours that lie between them, HTML: the sliders show neither."""
    (start, end), (dull, pure), (dark, bright) = sliders.hue_deg, sliders.saturation, sliders.value
    stops = ", ".join(
        _css(start + share * (end - start), dull + share * (pure - dull), dark + share * (bright - dark))
        for share in (0.0, 0.25, 0.5, 0.75, 1.0)
    )
    return (
        "<div style='padding:0.2em 0.8em;font-size:0.85em'>"
        f"<div style='height:0.9em;border-radius:0.3em;background:linear-gradient(90deg, {stops})'></div>"
        f"hue {start:.0f} to {end:.0f}°, saturation {dull:.2f} to {pure:.2f}, value {dark:.2f} to {bright:.2f}</div>"
    )


def _css(hue_deg: float, saturation: float, value: float) -> str:
    rgb = colorsys.hsv_to_rgb(hue_deg % _TURN_DEG / _TURN_DEG, saturation, value)
    return f"rgb({', '.join(str(round(255 * part)) for part in rgb)})"


def change_to(marker: str, sliders: BoundsSliders) -> dict[str, Any]:
    """Return the change of a camera's settings that sliders ask for."""
    start, end = sliders.hue_deg
    whole = end - start >= _TURN_DEG
    hue = [0.0, _TURN_DEG] if whole else [start % _TURN_DEG, end % _TURN_DEG if end < 0.0 else min(end, _TURN_DEG)]
    bounds = {
        "hue_deg": hue,
        "saturation": list(sliders.saturation),
        "value": list(sliders.value),
        "in_force": sliders.in_force,
    }
    return {"bounds": {marker: bounds}}
