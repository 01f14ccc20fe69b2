"""Which marker somebody means who points at a picture."""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.messages import MarkerFrame

_REACH_PX: Final = 14.0
"""A marker is also meant by a click this far outside it: fingers on a tablet are not sharp."""


def marker_at(frame: MarkerFrame, u: float, v: float) -> str | None:
    """Return the marker at a raw pixel, the nearest of those within reach; None when none is there."""
    within = {
        name: distance
        for name, marker in frame.markers.items()
        if (distance := float(np.hypot(marker.u - u, marker.v - v))) <= np.sqrt(marker.area / np.pi) + _REACH_PX
    }
    return min(within, key=within.__getitem__) if within else None
