"""Offset of the centroid of a fingertip's visible side from the middle of its paint.

A fingertip is round, and a camera sees only the paint on the side facing it. For a finger along d and the direction u
to the camera, with c = d·u, the centroid of this side lies off the finger's axis. In the image it is displaced by

    −(π/4) ρ r c        along the finger,

where r is the radius of the finger and ρ ≈ 0.85 the share of the paint on its shaft, as opposed to its round end. c
follows from the visible area, which is

    A(c) / A(0) = (2 λ √(1 − c²) + (π/2) (1 + c)) / (2 λ + π/2)        for c ≤ 0

of that seen from the side, where λ r is the length of the painted shaft.

Two independent observations give the direction of the finger across the view. One is the line from its knuckle, beside
the patch on the back of the hand, to its tip; it says less the more the finger is curled, because the end then points
elsewhere. The other is where skin adjoins the paint in the images: the finger comes from there, and what a hand hides
of a tip lies there, too. Their weighted mean is the direction, and its length, which is 1 where they agree, scales the
offset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.types import Vector3
from rhot_fusion.views.sightings import across, dot, interpolated, unit, vector

FIRST_BEND: Final = -0.45
"""C of a relaxed finger, bent away from the camera by a quarter of a right angle or a little more."""
MOST_BEND: Final = -0.7
"""Below this c (45 degrees) a small area indicates occlusion rather than a bent finger; between −0.7 and −0.8 the same
within 0.1 mm on rendered pictures and two simulated hands.
"""
_SKIN_LASTS_S: Final = 0.1
"""How long a direction to adjoining skin is used, seconds."""
_LEAST_SKIN: Final = 0.1
"""Shortest mean vector to adjoining skin that is used: half of that of a straight finger, whose skin adjoins along 70
to 90 degrees. Between 0.1 and 0.15 the errors are the same.
"""

_STRAIGHT_AWAY = -0.95
"""Below this c, 18 degrees from the line of sight, only a rim of paint is visible, and the ratio is meaningless."""


class VisibleArea:
    """Visible area of a fingertip's paint as a function of its angle to the line of sight.

    Attributes:
        least: relative area at `MOST_BEND`.
        usual: square root of that of a relaxed finger.
    """

    def __init__(self) -> None:
        # λ: tips are painted over 15 to 20 mm and are 6 to 7 mm thick.
        self._shaft = 2.0 * 1.8
        self._cosine: list[float] = np.linspace(_STRAIGHT_AWAY, 0.0, 64).tolist()
        self._share = [self.seen(c) for c in self._cosine]
        self.least = self.seen(MOST_BEND)
        self.usual = math.sqrt(self.seen(FIRST_BEND))

    def seen(self, c: float) -> float:
        """Return A(c) / A(0)."""
        shaft, end, c = self._shaft, 0.5 * math.pi, max(c, _STRAIGHT_AWAY)
        return (shaft * math.sqrt(max(1.0 - c * c, 0.0)) + end * (1.0 + c)) / (shaft + end)

    def bend(self, share: float) -> float:
        """Return c from A(c) / A(0)."""
        return interpolated(share, self._share, self._cosine)


class SkinSides:
    """Where skin adjoins the paint of M markers in C cameras, low-pass filtered.

    Args:
        cameras: of the rig.
        markers: M.
    """

    def __init__(self, cameras: Sequence[CameraModel], markers: int) -> None:
        # Rows of each camera's rotation: its axes in the rig frame.
        self._axes: list[list[Vector3]] = [[vector(row) for row in camera.R_camera_rig] for camera in cameras]
        self._seen: list[list[tuple[float, float, float, float] | None]] = [
            [None] * len(self._axes) for _ in range(markers)
        ]

    def clear(self) -> None:
        """Discard all observations."""
        for cameras in self._seen:
            cameras[:] = [None] * len(cameras)

    def of_camera(self, camera: int) -> list[tuple[float, float, float, float] | None]:
        """Return what is stored for one camera, by marker; `restore` puts it back."""
        return [cameras[camera] for cameras in self._seen]

    def restore(self, camera: int, seen: list[tuple[float, float, float, float] | None]) -> None:
        """Put back what `of_camera` returned."""
        for cameras, one in zip(self._seen, seen, strict=True):
            cameras[camera] = one

    def observe(self, camera: int, t_s: float, markers: Sequence[int], sides: FloatArray) -> None:
        """Store where skin adjoins markers (N,) in a camera's frame at a time, sides (N, 2) in the image."""
        (right, down, _) = self._axes[camera]
        for marker, (u, v) in zip(markers, sides.tolist(), strict=True):
            x, y, z = u * right[0] + v * down[0], u * right[1] + v * down[1], u * right[2] + v * down[2]
            cameras = self._seen[marker]
            before = cameras[camera]
            if before is not None and 0.0 <= t_s - before[0] < _SKIN_LASTS_S:
                # Time constant of the mean direction to adjoining skin, seconds. Between 0 and 0.08 the
                # errors are the same.
                keep = math.exp((before[0] - t_s) / 0.04)
                _, old_x, old_y, old_z = before
                x, y, z = x + keep * (old_x - x), y + keep * (old_y - y), z + keep * (old_z - z)
            cameras[camera] = t_s, x, y, z

    def _sum(self, marker: int, t_s: float) -> tuple[int, Vector3]:
        """Return how many cameras saw a marker shortly before or at a time, and the sum of their vectors to skin."""
        since_s, count, x, y, z = t_s - _SKIN_LASTS_S, 0, 0.0, 0.0, 0.0
        for seen in self._seen[marker]:
            if seen is not None and seen[0] > since_s:
                count, x, y, z = count + 1, x + seen[1], y + seen[2], z + seen[3]
        return count, (x, y, z)

    def apart(self, camera: int, marker: int, t_s: float) -> tuple[float, float]:
        """Return how a camera's own mean vector to adjoining skin differs from that of all cameras, in its image.

        (0, 0) where it or every other camera has none.
        """
        own = self._seen[marker][camera]
        if own is None or own[0] <= t_s - _SKIN_LASTS_S:
            return 0.0, 0.0
        count, (x, y, z) = self._sum(marker, t_s)
        away = own[1] - x / count, own[2] - y / count, own[3] - z / count
        right, down, _ = self._axes[camera]
        return dot(right, away), dot(down, away)

    def direction(self, camera: int, marker: int, t_s: float) -> Vector3 | None:
        """Return the direction of the finger in a camera's frame, away from the skin, as a unit vector.

        It is the mean over all cameras that saw the marker shortly before or at a time, which makes it the same for
        all, so that its error changes the depth only little. None = no camera sees skin on one side of it.
        """
        count, (x, y, z) = self._sum(marker, t_s)
        length = math.sqrt(x * x + y * y + z * z)
        if count == 0 or length < _LEAST_SKIN * count:
            return None
        away = -x / length, -y / length, -z / length
        right, down, forward = self._axes[camera]
        return dot(right, away), dot(down, away), dot(forward, away)


def visible_side(
    finger: Sequence[tuple[float, Vector3]], tip: Vector3, middle: Vector3, c: float, area: VisibleArea
) -> tuple[float, Vector3, float]:
    """Return bend and direction of a finger in one camera, and how much of it this camera sees.

    Args:
        finger: weights and directions of the finger from knuckle to tip as observed in different ways, camera frame.
        tip: position, metres, camera frame; the camera is at the origin.
        middle: centroid of all cameras, camera frame; `c` is the bend as seen from there.
        c: −1 to 0.
        area: the model of visible areas.

    Returns:
        The displacement in units of (π/4) ρ r, the unit direction perpendicular to the line of sight along which it
        acts, and the width of the whole marker relative to that seen from the middle.
    """
    sight = unit((middle[0] - tip[0], middle[1] - tip[1], middle[2] - tip[2]))
    total, x, y, z = 0.0, 0.0, 0.0, 0.0
    for weight, direction in finger:
        one = unit(across(direction, sight))
        total, x, y, z = total + weight, x + weight * one[0], y + weight * one[1], z + weight * one[2]
    agreement = math.sqrt(x * x + y * y + z * z) / max(total, 1.0)
    sideways, s = unit((x, y, z)), math.sqrt(1.0 - c * c)
    d = (c * sight[0] + s * sideways[0], c * sight[1] + s * sideways[1], c * sight[2] + s * sideways[2])
    own = unit((-tip[0], -tip[1], -tip[2]))
    bent = dot(d, own)
    wider = (area.seen(bent) / area.seen(c)) ** (0.5 * agreement)
    return agreement * bent, unit(across(d, own)), wider
