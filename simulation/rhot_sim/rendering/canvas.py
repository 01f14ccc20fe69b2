"""Drawing convex hulls of rings on a canvas finer than the picture, without a bias of position or size."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot_sim.world.parts import Group

Image = NDArray[np.uint8]
Int32Array = NDArray[np.int32]

FIXED_BITS: Final = 6
"""Binary places of polygon corners on the canvas."""
AA_GROWTH: Final = 0.668
"""Canvas pixels by which an anti-aliased `cv2.fillConvexPoly` draws a polygon too large on every side (measured)."""
AA_SEAM: Final = 0.7
"""Share of that by which the seam between paint and skin is moved: where two blended edges lie over each other, a
little of the covered colour shows through, and the covering half has to be this much larger to make up (measured)."""
PLAIN_GROWTH: Final = 0.485
"""The same without anti-aliasing: it fills every pixel that the outline touches."""
_MARGIN_PX: Final = 3
_LIGHT: Final = (-0.10, -0.14)
"""Where a round part's ridge lies, in radii from its middle: the lamp stands up and to the left."""


@dataclass(frozen=True, slots=True)
class CanvasWindow:
    """A rectangle of the picture, pixels; right and bottom are not part of it."""

    left: int
    top: int
    right: int
    bottom: int

    def overlaps(self, other: CanvasWindow) -> bool:
        """Tell whether two rectangles share pixels."""
        return (
            self.left < other.right and other.left < self.right and self.top < other.bottom and other.top < self.bottom
        )

    def union(self, other: CanvasWindow) -> CanvasWindow:
        """Return the smallest rectangle around both."""
        return CanvasWindow(
            min(self.left, other.left),
            min(self.top, other.top),
            max(self.right, other.right),
            max(self.bottom, other.bottom),
        )

    @classmethod
    def around(cls, points: FloatArray, width: int, height: int) -> CanvasWindow | None:
        """Return the part of a picture that holds points (..., 2), pixels, with a margin; None when it holds none."""
        flat = points.reshape(-1, 2)
        low = np.floor(np.clip(flat.min(axis=0) - _MARGIN_PX, 0.0, 1e6)).astype(int)
        high = np.ceil(np.clip(flat.max(axis=0), -1e6, 1e6)).astype(int) + _MARGIN_PX + 1
        window = cls(int(low[0]), int(low[1]), min(int(high[0]), width), min(int(high[1]), height))
        return window if window.left < window.right and window.top < window.bottom else None


def disjoint(windows: Iterable[CanvasWindow]) -> list[CanvasWindow]:
    """Return windows that cover the given ones and do not overlap each other."""
    apart: list[CanvasWindow] = []
    for window in windows:
        merged = window
        while touching := [other for other in apart if other.overlaps(merged)]:
            for other in touching:
                apart.remove(other)
                merged = merged.union(other)
        apart.append(merged)
    return apart


def far_to_near(groups: Sequence[Group], distances: FloatArray) -> list[Group]:
    """Return groups in drawing order by the mean distance of their anchors; `distances` (R,) metres."""
    metres = distances.tolist()
    return sorted(groups, key=lambda group: -sum(metres[ring] for ring in group.anchors) / len(group.anchors))


def paint_groups(
    canvas: Image,
    points: FloatArray,
    groups: Sequence[Group],
    colors: Mapping[tuple[str, float], tuple[float, float, float]],
    *,
    window: CanvasWindow,
    scale: int,
) -> None:
    """Draw groups, far to near, anti-aliased, on a canvas that shows `window` enlarged by `scale`.

    Args:
        canvas: (height · scale, width · scale, 3) of the window.
        points: (R, V, 2) pixels of the picture, made smaller by `AA_GROWTH` / scale.
        groups: in drawing order.
        colors: by paint and brightness of a shade.
        window: what the canvas shows.
        scale: canvas pixels to a picture's pixel.
    """
    middle = points.mean(axis=1, keepdims=True)
    spread = points - middle
    radius = np.abs(spread).mean(axis=(1, 2))[:, None, None] * (np.pi / 2.0)
    widths = {stroke.width for group in groups for stroke in group.strokes}
    shares = np.array(list(widths))[:, None, None, None]
    lit = middle + shares * spread + (1.0 - shares) * radius * np.array(_LIGHT)
    fixed = dict(zip(widths, on_canvas(lit, window, scale), strict=True))
    for group in groups:
        for stroke in group.strokes:
            outline = fixed[stroke.width].take(stroke.rings, axis=0).reshape(-1, 1, 2)
            # A single ring is convex as it is.
            hull = outline if len(stroke.rings) == 1 else cv2.convexHull(outline)
            cv2.fillConvexPoly(canvas, hull, colors[stroke.color], cv2.LINE_AA, FIXED_BITS)


def on_canvas(points: FloatArray, window: CanvasWindow, scale: int) -> Int32Array:
    """Return picture pixels as fixed-point pixels of a canvas that is `scale` times as fine.

    Pixel centres lie on integers in both, so a picture's pixel u covers the canvas from (u − ½ + ½)·s − ½ on:
    U = (u + ½)·s − ½.
    """
    offset = np.array([window.left, window.top]) - 0.5
    placed = ((points - offset) * scale - 0.5) * (1 << FIXED_BITS)
    # Beyond this cv2 overflows, and nothing of it is in the picture anyway.
    return np.rint(np.clip(placed, -(1 << 24), 1 << 24)).astype(np.int32)
