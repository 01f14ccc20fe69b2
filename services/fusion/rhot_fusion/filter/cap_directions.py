"""From the visible middle of a painted fingertip to the middle of its painted volume, in the picture.

Where the fingers point is what inverse kinematics made of earlier points; how far they point towards the camera or away
from it is what the visible area says, so that the loop through inverse kinematics stays stable.

Plain numbers: for five fingertips numpy's calls cost three times what the sums do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import CHAINS
from rhot.geometry.camera import CameraModel
from rhot.messages import HandPose, Side
from rhot.rig import MarkerConfig
from rhot_fusion.filter.cap_model import CapModel
from rhot_fusion.views.sightings import BoolArray, FloatArray, Sightings
from rhot_fusion.views.vectors import Vector, vector

_UNKNOWN_SIGMA_M: Final = 0.003
"""Where the middle of a cap may be from the middle of its visible part, when nobody knows where it points."""
_KNOWN_SIGMA_M: Final = 0.0008
_SLOWEST_GAIN: Final = 0.05
_FASTEST_GAIN: Final = 0.5
_FAST_TURN_RAD: Final = 0.3
"""Directions are smoothed by this share of their step, small or beyond this angle."""
_TYPICAL_DEPTH_M: Final = 0.8
_QUIET_STEP: Final = 0.02
_QUICK_STEP: Final = 0.6
_REAL_STEP: Final = 0.2
"""Areas are smoothed by a share of their step, from small to large ones: they flicker by some hundredths of themselves,
and fall within three frames when something hides."""
_UNEVEN: Final = 0.05
"""Views of a whole marker differ by this share of its area."""
_HIDDEN_SHIFT: Final = 0.7
"""Hiding a strip of a marker shifts its visible middle by half the strip; chosen by the error on simulated hands."""
_HIDDEN_SIGMA_M: Final = 0.04
"""Error of a place, in depth above all, per share of the marker that is hidden."""
_HIDDEN_DOUBT: Final = 0.25
"""Error of the shift by what is hidden, as a share of the marker's width per share hidden."""
_STEEPEST: Final = 0.98
"""Beyond this cosine the visible part of a cap is too small to have a middle."""
_PAINT_SHARE: Final = 0.9
"""Share of a cap's expected area that is found as its colour: its rim is mixed with what is behind."""


class CapDirections:
    """Where the painted fingertips among M markers point."""

    def __init__(
        self, cameras: Sequence[CameraModel], markers: Mapping[str, MarkerConfig], hands: Mapping[Side, HandModel]
    ) -> None:
        self._model = CapModel(markers, hands)
        self._R = [[vector(row) for row in camera.R_camera_rig] for camera in cameras]
        # Metres to the root of the paint that is found, per pixel and metre of depth.
        self._scale = [1.0 / (_PAINT_SHARE**0.5 * float(camera.K[0, 0])) for camera in cameras]
        before = {chain[-1]: chain[-2] for chain in CHAINS.values()}
        self._joints: dict[Side, list[tuple[int, str, str]]] = {}
        for place, marker in enumerate(markers.values()):
            if self._model.is_cap[place]:
                self._joints.setdefault(marker.hand, []).append((place, before[marker.joint], marker.joint))
        self._markers = range(len(markers))
        centers = np.stack([camera.center for camera in cameras])
        # From the middle of the rig to each camera, in that camera's frame.
        self._aside = [vector(camera.R_camera_rig @ (camera.center - centers.mean(axis=0))) for camera in cameras]
        self._side = [_sideways(camera, centers) for camera in cameras]
        self.clear()

    def clear(self) -> None:
        """Forget all directions."""
        self._direction: list[Vector | None] = [None for _ in self._markers]
        # By camera and marker; NaN = not judged in its newest frame.
        self._share, self._area, self._bent = ([[math.nan for _ in self._markers] for _ in self._R] for _ in range(3))
        self._sigma_m = [_UNKNOWN_SIGMA_M if cap else 0.0 for cap in self._model.is_cap.tolist()]
        self._sigmas: list[float] | None = None

    def learn(self, hand: HandPose) -> None:
        """Take where a hand's fingers point."""
        for place, hinge, tip in self._joints.get(hand.side, []):
            if hinge not in hand.joints or tip not in hand.joints:
                continue
            (ax, ay, az), (bx, by, bz) = hand.joints[hinge].position, hand.joints[tip].position
            x, y, z = bx - ax, by - ay, bz - az
            length = math.sqrt(x * x + y * y + z * z)
            if length < 1e-6:
                continue
            x, y, z = x / length, y / length, z / length
            known = self._direction[place]
            if known is not None:
                x0, y0, z0 = known
                dx, dy, dz = x - x0, y - y0, z - z0
                turn = dx * dx + dy * dy + dz * dz
                gain = _SLOWEST_GAIN + (_FASTEST_GAIN - _SLOWEST_GAIN) * min(1.0, turn / _FAST_TURN_RAD**2)
                # Half-way to the opposite direction lies nothing.
                x, y, z = _unit(x0 + gain * dx, y0 + gain * dy, z0 + gain * dz)
            self._direction[place] = (x, y, z)
            self._sigma_m[place] = _KNOWN_SIGMA_M
        self._sigmas = None

    def correct(self, sightings: Sightings, known: FloatArray, tracked: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return how far the middles of caps lie beside what is seen of them, and how sure that is.

        The solver of the hand bends fingers that point away from the cameras wrong by 10 to 20 degrees, which moves
        their middles by millimetres. The area tells better: a tenth of it is 0.03 of d·u where that is −0.7. The camera
        that shows most of a cap corrects d·u; what another one shows less than that is hidden from it. Where no area is
        reported the shift is taken as seen from the middle of the rig, so that a wrong direction changes no depth.

        What hides a part of a marker is nearer than it, and so covers more of it in the camera on its own side: from
        there to the other camera the visible middle moves less. The difference is what depth is made of. The shift that
        both views share stays unknown; it errs sideways by a millimetre or two.

        Args:
            sightings: of the visible parts; what they show of each marker's area is noted.
            known: (M, 6) places of the markers, for their distance.
            tracked: (M,) which of them are known.

        Returns:
            (N, 2) what to add to the sightings and (N,) its standard deviation, normalised units.
        """
        camera, index = sightings.camera, sightings.index.tolist()
        if len(index) < len(self._markers):
            for absent in set(self._markers).difference(index):
                self._area[camera][absent] = self._bent[camera][absent] = self._share[camera][absent] = math.nan
        self._sigmas = None
        shift, doubt = [(0.0, 0.0)] * len(index), [0.0] * len(index)
        depths, anywhere = known[:, 2].tolist(), bool(tracked.any())
        if not tracked.all():
            typical = float(np.median(known[tracked, 2])) if anywhere else _TYPICAL_DEPTH_M
            depths = [depth if here else typical for depth, here in zip(depths, tracked.tolist(), strict=True)]
        for row, (marker, xy, area_px) in enumerate(
            zip(index, sightings.xy.tolist(), sightings.area_px.tolist(), strict=True)
        ):
            direction = self._direction[marker]
            if direction is not None:
                depth = max(depths[marker], 0.1)
                shift[row], doubt[row] = self._shift(camera, marker, direction, xy, area_px if anywhere else 0.0, depth)
        return np.array(shift).reshape(-1, 2), np.array(doubt)

    def _shift(
        self, camera: int, marker: int, direction: Vector, xy: list[float], area_px: float, depth: float
    ) -> tuple[tuple[float, float], float]:
        """Return the shift of a cap at a depth, metres, and its standard deviation; an area of 0 is no judgement."""
        d0, d1, d2 = direction
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = self._R[camera]
        dx, dy, dz = r00 * d0 + r01 * d1 + r02 * d2, r10 * d0 + r11 * d1 + r12 * d2, r20 * d0 + r21 * d1 + r22 * d2
        x, y = xy
        ax, ay, az = self._aside[camera]
        # The line of sight from the middle of the rig.
        mx, my, mz = _unit(x + ax / depth, y + ay / depth, 1.0 + az / depth)
        cosine = -(dx * mx + dy * my + dz * mz)
        areas, bents = self._area[camera], self._bent[camera]
        if judged := area_px > 0.0:
            scale = depth * self._scale[camera]
            area, before = area_px * (scale * scale), areas[marker]
            # NaN, where there was none before, is not greater.
            if before > 0.0:
                step = min(abs(area - before) / (_REAL_STEP * before), 1.0)
                area = before + (_QUIET_STEP + (_QUICK_STEP - _QUIET_STEP) * step * step) * (area - before)
            # Without what d·u is in this camera beyond what it is from the middle of the rig.
            bent = self._model.cosine_of(marker, area) - (dx * ax + dy * ay + dz * az) / depth
            areas[marker], bents[marker] = area, bent
            for others in self._bent:
                bent = max(bent, others[marker])
            sx, sy, sz = _unit(x, y, 1.0)
        else:
            areas[marker] = bents[marker] = math.nan
            bent = cosine
            sx, sy, sz = mx, my, mz
        bent = min(max(bent, -_STEEPEST), _STEEPEST)
        # The direction is tilted to what the area says, about the axis across it and the line of sight.
        tx, ty, tz = _unit(dx + mx * cosine, dy + my * cosine, dz + mz * cosine)
        sine = math.sqrt(1.0 - bent * bent)
        tx, ty, tz = tx * sine - mx * bent, ty * sine - my * bent, tz * sine - mz * bent
        seen = -(tx * sx + ty * sy + tz * sz)
        along, whole = self._model.look_up(marker, seen)
        along /= depth
        aside = (tz + sz * seen) * along
        shift_x, shift_y = x * aside - (tx + sx * seen) * along, y * aside - (ty + sy * seen) * along
        share = area / max(whole, 1e-9) if judged else 1.0
        self._share[camera][marker] = share
        less = min(1.0 - share, 2.0 * (1.0 - share - _UNEVEN))
        if less <= 0.0:
            return (shift_x, shift_y), 0.0
        width = less * math.sqrt(whole) / depth
        side_x, side_y = self._side[camera]
        return (
            (shift_x + _HIDDEN_SHIFT * width * side_x, shift_y + _HIDDEN_SHIFT * width * side_y),
            _HIDDEN_DOUBT * width,
        )

    def sigmas(self) -> list[float]:
        """Return what places of markers (M,) may be wrong by for their shape and what hides them, metres."""
        if self._sigmas is None:
            # NaN is never less than what all of a marker is.
            hidden = [_HIDDEN_SIGMA_M * (1.0 - min(1.0, *shares)) for shares in zip(*self._share, strict=True)]
            self._sigmas = [math.sqrt(one * one + more * more) for one, more in zip(self._sigma_m, hidden, strict=True)]
        return self._sigmas


def _unit(x: float, y: float, z: float) -> Vector:
    """Return a vector of length one; nothing stays nothing."""
    length = max(math.sqrt(x * x + y * y + z * z), 1e-9)
    return (x / length, y / length, z / length)


def _sideways(camera: CameraModel, centers: FloatArray) -> tuple[float, float]:
    """Return the direction in a camera's picture away from the other cameras."""
    away = (camera.center - centers.mean(axis=0)) @ camera.R_camera_rig.T
    length = float(np.hypot(away[0], away[1]))
    return (float(away[0]) / length, float(away[1]) / length) if length > 1e-6 else (0.0, 0.0)
