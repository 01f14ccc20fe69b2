"""The colours of the simulated world, blue, green, red, as a camera with locked white balance sees them in even light.

The fingertips wear the acrylic paints of the original rig: dark green, light blue, light green, dark blue, violet. The
patch on the back is magenta: the original blue-violet one lies too near to its neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

Bgr = tuple[float, float, float]

SKIN: Final[Bgr] = (132.0, 168.0, 205.0)
OBJECT: Final[Bgr] = (96.0, 112.0, 124.0)
DESK: Final[Bgr] = (25.0, 23.0, 23.0)

PAINTS: Final[dict[str, Bgr]] = {
    "thumb": (58.0, 112.0, 34.0),
    "index": (222.0, 176.0, 62.0),
    "middle": (96.0, 232.0, 186.0),
    "ring": (178.0, 64.0, 24.0),
    "little": (196.0, 82.0, 166.0),
    "base": (142.0, 40.0, 222.0),
}
"""Paint by marker name."""
FURTHER_PAINTS: Final[tuple[Bgr, ...]] = (
    (36.0, 34.0, 196.0),
    (32.0, 206.0, 232.0),
    (20.0, 108.0, 238.0),
    (168.0, 164.0, 22.0),
    (236.0, 236.0, 236.0),
    (60.0, 24.0, 96.0),
)
"""For markers of other names, such as those of a second hand: red, yellow, orange, turquoise, white, maroon."""

SKIN_SHADES: Final[tuple[tuple[float, float], ...]] = ((1.0, 0.80), (0.66, 1.0))
PAINT_SHADES: Final[tuple[tuple[float, float], ...]] = ((1.0, 0.74), (0.74, 1.0), (0.36, 1.16))
"""Width and brightness of a round part's rim, body and ridge."""
FLAT_SHADES: Final[tuple[tuple[float, float], ...]] = ((1.0, 1.0),)


def paints_of(markers: Iterable[str]) -> dict[str, Bgr]:
    """Return the paint of each marker by name; distinct as long as there are paints left."""
    names = list(markers)
    spare = iter((*FURTHER_PAINTS, *(paint for name, paint in PAINTS.items() if name not in names)))
    return {name: PAINTS[name] if name in PAINTS else next(spare, FURTHER_PAINTS[0]) for name in names}


def shaded(color: Bgr, brightness: float) -> Bgr:
    """Return a colour in more or less light, within 0 to 255."""
    blue, green, red = (min(255.0, max(0.0, channel * brightness)) for channel in color)
    return blue, green, red
