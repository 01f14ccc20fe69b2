"""Reading the quality figures of a calibration file, which every calibration writes in its own way."""

from __future__ import annotations

import math
from typing import Any, Final

EPIPOLAR_LIMIT_PX: Final = 1.0
"""Where the rows of two views disagree by more, a camera has been bumped; by half of it, it is drifting."""


def pair_epipolar_p95_px(quality: Any, first: str, second: str) -> float | None:
    """Return a pair's epipolar error (95th percentile, pixels) at its calibration; None when it is not recorded.

    Args:
        quality: of `cameras.json`: `{"pairs": {"left-right": {"epipolar_p95_px": 0.3}}}`, among other figures.
        first, second: camera names, in any order.
    """
    for name in (f"{first}-{second}", f"{second}-{first}"):
        value = figure(quality, "pairs", name, "epipolar_p95_px")
        if value is not None and value > 0.0:
            return value
    return None


def figure(quality: Any, *path: str) -> float | None:
    """Return the number at a path of keys of a quality record; None when there is none."""
    value = quality
    for key in path:
        value = value.get(key) if isinstance(value, dict) else None
    if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    return None


def epipolar_limit_px(calibrated_p95_px: float | None) -> float:
    """Return the systematic epipolar error, pixels, above which a pair's calibration no longer holds."""
    times_calibrated = 3.0
    return max(EPIPOLAR_LIMIT_PX, times_calibrated * (calibrated_p95_px or 0.0))


def figures_with_units(quality: Any) -> dict[str, float]:
    """Return the figures at the top of a quality record whose names carry a unit (`residual_rms_mm`), by name."""
    if not isinstance(quality, dict):
        return {}
    return {
        str(name): float(value)
        for name, value in quality.items()
        if isinstance(value, int | float)
        and not isinstance(value, bool)
        and str(name).rsplit("_", 1)[-1] in ("px", "mm", "m", "deg", "rad")
    }
