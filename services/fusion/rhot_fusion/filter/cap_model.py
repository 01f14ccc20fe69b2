"""What a camera sees of a painted fingertip: which part of the cap, and where its middle is.

The last bone is convex, so a camera sees just the surface that faces it, and the centre of the visible paint is

    ∫ p · max(0, n·u) dA / ∫ max(0, n·u) dA        over the painted surface,

u the direction to the camera, p a surface point and n its outward normal. The cap is a half ball about the tip joint
and behind it a cone up to where the paint ends (`rhot.anatomy.hand`: 15 mm behind the very tip). It is round about the
finger's axis d, so its middle lies in the plane of d and u; along u it makes no difference in the picture. That leaves
one number, a function of d·u: how far along d the visible middle lies from the middle of the painted volume.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import CAP_LENGTH_M, HandModel
from rhot.anatomy.skeleton import CHAINS, JOINTS
from rhot.messages import Side
from rhot.rig import MarkerConfig

FloatArray = NDArray[np.float64]

COSINES: Final = 65
"""Entries of the tables, evenly spaced in d·u from −1 to 1."""
_ALONG: Final = 48
_AROUND: Final = 96


@dataclass(frozen=True, slots=True)
class CapTable:
    """One cap as seen under all angles.

    Attributes:
        shift_m: (65,) how far along d the visible middle lies from the middle of the volume, by d·u from −1 to 1.
        area_m2: (65,) visible painted area, projected.
    """

    shift_m: FloatArray
    area_m2: FloatArray


def cap_table(tip_radius_m: float, rear_radius_m: float, middle_behind_m: float) -> CapTable:
    """Return the table of a cap.

    Args:
        tip_radius_m: of the half ball about the tip joint.
        rear_radius_m: of the cone where the paint ends, `CAP_LENGTH_M` behind the very tip.
        middle_behind_m: how far behind the tip joint the middle of the painted volume lies.
    """
    cosine = np.linspace(-1.0, 1.0, COSINES)
    sine = np.sqrt(1.0 - cosine**2)
    # d is +x, u = (cosine, sine, 0).
    place, normal, weight = _surface(tip_radius_m, rear_radius_m)
    facing = np.maximum(normal[:, 0, None] * cosine + normal[:, 1, None] * sine, 0.0) * weight[:, None]
    area = facing.sum(axis=0)
    # From straight behind nothing is seen; the middle of nothing is never asked for.
    seen = np.maximum(area, 1e-12)
    along, across = (place[:, 0] @ facing) / seen, (place[:, 1] @ facing) / seen
    # Moving (along, across) by a multiple of u changes nothing in the picture: onto the axis.
    steep = np.maximum(sine, 0.05)
    shift = along - across * cosine / steep + middle_behind_m
    return CapTable(shift, area)


def _surface(tip_radius: float, rear_radius: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points (N, 2) along and across the axis, normals (N, 2) and areas (N,) of the painted surface.

    Only the components in the plane of d and u are kept.
    """
    around = (np.arange(_AROUND) + 0.5) * (2.0 * np.pi / _AROUND)
    share = (np.arange(_ALONG) + 0.5) / _ALONG
    length = max(CAP_LENGTH_M - tip_radius, 0.0)
    # Equal steps of height cut a ball into zones of equal area.
    height = share
    ring = np.sqrt(1.0 - height**2)
    ball = np.stack(
        [np.repeat(height, _AROUND), np.outer(ring, np.cos(around)).ravel()],
        axis=1,
    )
    ball_area = np.full(len(ball), 2.0 * np.pi * tip_radius**2 / len(ball))
    radius = tip_radius + share * (rear_radius - tip_radius)
    slope = np.hypot(length, rear_radius - tip_radius)
    forward, outward = ((rear_radius - tip_radius) / slope, length / slope) if slope > 0.0 else (0.0, 1.0)
    cone = np.stack([np.repeat(-share * length, _AROUND), np.outer(radius, np.cos(around)).ravel()], axis=1)
    cone_normal = np.tile(np.stack([np.full(_AROUND, forward), outward * np.cos(around)], axis=1), (_ALONG, 1))
    cone_area = np.repeat(radius * 2.0 * np.pi / _AROUND * slope / _ALONG, _AROUND)
    place = np.concatenate([ball * tip_radius, cone])
    return place, np.concatenate([ball, cone_normal]), np.concatenate([ball_area, cone_area])


class CapModel:
    """The caps among M markers, with tables by marker; a marker that is none has no shift.

    Attributes:
        is_cap: (M,) markers with a table.
    """

    def __init__(self, markers: Mapping[str, MarkerConfig], hands: Mapping[Side, HandModel]) -> None:
        """Build tables from the hands by side."""
        self.is_cap: NDArray[np.bool_] = np.zeros(len(markers), dtype=bool)
        nothing = [0.0] * COSINES
        # By marker and entry; plain numbers, for a few markers at a time are asked for.
        self._shift, self._area, self._cosine = ([nothing] * len(markers) for _ in range(3))
        self._largest = [1.0] * len(markers)
        tips = {chain[-1]: chain[-2] for chain in CHAINS.values()}
        for place, (name, marker) in enumerate(markers.items()):
            if marker.kind != "cap" or marker.joint not in tips:
                continue
            hand = hands[marker.hand]
            tip, hinge = JOINTS.index(marker.joint), JOINTS.index(tips[marker.joint])
            finger = next(row for row, chain in enumerate(CHAINS.values()) if chain[-1] == marker.joint)
            radius = float(hand.radii[tip])
            behind = (CAP_LENGTH_M - radius) / float(hand.bones[finger, 2])
            rear = radius + behind * (float(hand.radii[hinge]) - radius)
            offset = hand.marker_offset(name, marker)
            table = cap_table(radius, rear, float(offset[2]))
            rising = np.arange(COSINES) <= int(np.argmax(table.area_m2))
            largest = float(table.area_m2.max())
            cosine = np.interp(
                np.linspace(0.0, largest, COSINES), table.area_m2[rising], np.linspace(-1.0, 1.0, COSINES)[rising]
            )
            self._shift[place], self._area[place] = table.shift_m.tolist(), table.area_m2.tolist()
            self._cosine[place], self._largest[place] = cosine.tolist(), largest
            self.is_cap[place] = True

    def look_up(self, marker: int, cosine: float) -> tuple[float, float]:
        """Return shift, metres, and visible area, square metres, of a marker at d·u."""
        place = (min(max(cosine, -1.0), 1.0) + 1.0) * (0.5 * (COSINES - 1))
        low = min(int(place), COSINES - 2)
        share, shift, area = place - low, self._shift[marker], self._area[marker]
        return (
            shift[low] + (shift[low + 1] - shift[low]) * share,
            area[low] + (area[low + 1] - area[low]) * share,
        )

    def cosine_of(self, marker: int, area: float) -> float:
        """Return d·u at which a marker shows an area, square metres: the smaller one where there are two."""
        place = min(max(area / self._largest[marker], 0.0), 1.0) * (COSINES - 1)
        low = min(int(place), COSINES - 2)
        cosine = self._cosine[marker]
        return cosine[low] + (cosine[low + 1] - cosine[low]) * (place - low)
