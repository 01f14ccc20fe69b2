"""What a picture of the world is drawn from: rings in space, convex parts between them, and groups of parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray

BALL: Final = 0
DISC: Final = 1
PATCH: Final = 2


@dataclass(frozen=True, slots=True)
class Part:
    """A convex part of one colour.

    Attributes:
        rings: numbers of the rings whose hull it is.
        paint: `skin`, `object` or a marker's name.
        shades: width (share of the full one) and brightness, from the rim inwards.
    """

    rings: tuple[int, ...]
    paint: str
    shades: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Stroke:
    """One convex outline filled with one colour.

    Attributes:
        rings: (r,) numbers of the rings whose hull it is.
        width: share of the rings' full width.
        color: paint and brightness.
    """

    rings: NDArray[np.intp]
    width: float
    color: tuple[str, float]


@dataclass(frozen=True, slots=True)
class Group:
    """Parts that are drawn together, in their order.

    Attributes:
        parts: of one body, that touch.
        strokes: how they are drawn: all rims first, then their lit middles, so that joints leave no dark lines.
        anchors: numbers of the rings whose mean distance decides when the group is drawn.
        owner: the hand's side or the object's id.
    """

    parts: tuple[Part, ...]
    strokes: tuple[Stroke, ...]
    anchors: tuple[int, ...]
    owner: str

    @classmethod
    def of(cls, parts: Sequence[Part], anchors: tuple[int, ...], owner: str) -> Group:
        """Return the group of parts."""
        strokes = tuple(
            Stroke(np.array(part.rings, dtype=np.intp), part.shades[layer][0], (part.paint, part.shades[layer][1]))
            for layer in range(max((len(part.shades) for part in parts), default=0))
            for part in parts
            if layer < len(part.shades)
        )
        return cls(tuple(parts), strokes, anchors, owner)


@dataclass(frozen=True, slots=True)
class Rings:
    """All rings at K moments, rig frame.

    Attributes:
        centers: (K, R, 3) metres.
        axes: (K, R, 2, 3) two unit vectors in the plane of a disc or patch; ignored for balls.
        extents: (R, 2) half extents along these axes, metres; radii of balls and discs.
        kinds: (R,) one of BALL, DISC, PATCH.
        shift_axes: (K, R, 3) along this axis a disc moves when its outline is to shrink; zero otherwise.
    """

    centers: FloatArray
    axes: FloatArray
    extents: FloatArray
    kinds: NDArray[np.int8]
    shift_axes: FloatArray
