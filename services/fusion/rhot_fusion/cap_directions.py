"""From the visible middle of a painted fingertip to the middle of its painted volume, in the picture.

Where the fingers point is what inverse kinematics made of earlier points; how far they point towards the camera or away
from it is what the visible area says, so that the loop through inverse kinematics stays stable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from rhot.camera import CameraModel
from rhot.hand import HandModel
from rhot.messages import HandPose, Side
from rhot.rig import MarkerConfig
from rhot.skeleton import CHAINS
from rhot_fusion.cap_model import CapModel
from rhot_fusion.sightings import BoolArray, FloatArray, Sightings

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
_SUM: FloatArray = np.ones(3)
_PAINT_SHARE: Final = 0.9
"""Share of a cap's expected area that is found as its colour: its rim is mixed with what is behind."""


class CapDirections:
    """Where the painted fingertips among M markers point.

    Attributes:
        sigma_m: (M,) what a marker's place may be wrong by because of its shape.
    """

    def __init__(
        self, cameras: Sequence[CameraModel], markers: Mapping[str, MarkerConfig], hands: Mapping[Side, HandModel]
    ) -> None:
        self._model = CapModel(markers, hands)
        self._R = [camera.R_camera_rig for camera in cameras]
        self._focal_px = [float(camera.K[0, 0]) for camera in cameras]
        before = {chain[-1]: chain[-2] for chain in CHAINS.values()}
        self._joints: dict[Side, list[tuple[int, str, str]]] = {}
        for place, marker in enumerate(markers.values()):
            if self._model.is_cap[place]:
                self._joints.setdefault(marker.hand, []).append((place, before[marker.joint], marker.joint))
        self._share: FloatArray = np.full((len(cameras), len(markers)), np.nan)
        self._area: FloatArray = np.full((len(cameras), len(markers)), np.nan)
        self._bent: FloatArray = np.full((len(cameras), len(markers)), np.nan)
        centers = np.stack([camera.center for camera in cameras])
        # From the middle of the rig to each camera, in that camera's frame.
        self._aside = [camera.R_camera_rig @ (camera.center - centers.mean(axis=0)) for camera in cameras]
        self._side: list[FloatArray] = [_sideways(camera, centers) for camera in cameras]
        self._aimed: BoolArray = np.zeros(len(markers), dtype=bool)
        self._direction: FloatArray = np.zeros((len(markers), 3))
        self.sigma_m: FloatArray = np.zeros(len(markers))
        self._sigmas: FloatArray | None = None
        self.clear()

    def clear(self) -> None:
        """Forget all directions."""
        self._aimed[:] = False
        self._direction[:] = 0.0
        self._share[:] = self._area[:] = self._bent[:] = np.nan
        self.sigma_m[:] = np.where(self._model.is_cap, _UNKNOWN_SIGMA_M, 0.0)
        self._sigmas = None

    def learn(self, hand: HandPose) -> None:
        """Take where a hand's fingers point."""
        # Plain numbers: for single vectors they cost a fifth of what arrays do.
        for place, hinge, tip in self._joints.get(hand.side, []):
            if hinge not in hand.joints or tip not in hand.joints:
                continue
            (ax, ay, az), (bx, by, bz) = hand.joints[hinge].position, hand.joints[tip].position
            x, y, z = bx - ax, by - ay, bz - az
            length = math.sqrt(x * x + y * y + z * z)
            if length < 1e-6:
                continue
            x, y, z = x / length, y / length, z / length
            if self._aimed[place]:
                x0, y0, z0 = self._direction[place].tolist()
                dx, dy, dz = x - x0, y - y0, z - z0
                turn = dx * dx + dy * dy + dz * dz
                gain = _SLOWEST_GAIN + (_FASTEST_GAIN - _SLOWEST_GAIN) * min(1.0, turn / _FAST_TURN_RAD**2)
                x, y, z = x0 + gain * dx, y0 + gain * dy, z0 + gain * dz
                # Half-way to the opposite direction lies nothing.
                length = max(math.sqrt(x * x + y * y + z * z), 1e-6)
                x, y, z = x / length, y / length, z / length
            self._direction[place], self._aimed[place] = (x, y, z), True
            self.sigma_m[place] = _KNOWN_SIGMA_M
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
        index, xy, camera = sightings.index, sightings.xy, sightings.camera
        shift, doubt = np.zeros((len(index), 2)), np.zeros(len(index))
        if len(index) < len(self.sigma_m):
            absent = np.ones(len(self.sigma_m), dtype=bool)
            absent[index] = False
            for past in (self._area, self._bent, self._share):
                past[camera, absent] = np.nan
            self._sigmas = None
        aimed = self._aimed[index]
        if not aimed.any():
            return shift, doubt
        d = self._direction[index] @ self._R[camera].T
        depth, here = known[index, 2], tracked[index]
        anywhere = bool(tracked.any())
        if not here.all():
            typical = float(np.median(known[tracked, 2])) if anywhere else _TYPICAL_DEPTH_M
            depth = np.where(here, depth, typical)
        depth = np.maximum(depth, 0.1)
        judged = aimed & (sightings.area_px > 0.0) & anywhere
        aside = self._aside[camera]
        ray = np.ones((2, len(index), 3))
        ray[:, :, :2] = xy
        ray[1] += aside / depth[:, None]
        ray, middle_ray = _unit(ray)
        cosine = -((d * middle_ray) @ _SUM)
        scale = depth / (_PAINT_SHARE**0.5 * self._focal_px[camera])
        area = np.where(judged, sightings.area_px * (scale * scale), np.nan)
        before = self._area[camera, index]
        step = np.minimum(np.abs(area - before) / (_REAL_STEP * before), 1.0)
        gain = _QUIET_STEP + (_QUICK_STEP - _QUIET_STEP) * step * step
        area = np.where(np.isfinite(before), before + gain * (area - before), area)
        self._area[camera, index] = area
        # What d·u is in this camera beyond what it is from the middle of the rig.
        turn = (d @ aside) / depth
        own = self._model.cosine_of(index, np.where(judged, area, 0.0))
        self._bent[camera, index] = np.where(judged, own - turn, np.nan)
        best = np.fmax.reduce(self._bent[:, index], axis=0)
        bent = np.minimum(np.maximum(np.where(judged, best, cosine), -_STEEPEST), _STEEPEST)
        # The direction is tilted to what the area says, about the axis across it and the line of sight.
        tilted = _unit(d + middle_ray * cosine[:, None]) * np.sqrt(1.0 - bent * bent)[:, None]
        tilted -= middle_ray * bent[:, None]
        sight = np.where(judged[:, None], ray, middle_ray)
        seen = -((tilted * sight) @ _SUM)
        along, whole = self._model.look_up(index, seen)
        self._sigmas = None
        self._share[camera, index] = share = np.where(judged, area / np.maximum(whole, 1e-9), 1.0)
        across = (tilted + sight * seen[:, None]) * (along / depth)[:, None]
        shift += xy * across[:, 2:] - across[:, :2]
        less = np.maximum(1.0 - share, 0.0)
        less = np.maximum(np.minimum(2.0 * (less - _UNEVEN), less), 0.0)
        width = np.sqrt(whole) / depth
        shift += (_HIDDEN_SHIFT * less * width)[:, None] * self._side[camera]
        return shift, _HIDDEN_DOUBT * less * width

    def sigmas(self) -> FloatArray:
        """Return what places of markers (M,) may be wrong by for their shape and what hides them, metres."""
        if self._sigmas is None:
            hidden = np.maximum(1.0 - np.fmin.reduce(self._share, axis=0), 0.0)
            doubt = np.where(np.isfinite(hidden), _HIDDEN_SIGMA_M * hidden, 0.0)
            self._sigmas = np.sqrt(self.sigma_m**2 + doubt**2)
        return self._sigmas


def _unit(vectors: FloatArray) -> FloatArray:
    """Return vectors (..., 3) of length one; nothing stays nothing."""
    unit: FloatArray = vectors / np.maximum(np.sqrt((vectors * vectors) @ _SUM), 1e-9)[..., None]
    return unit


def _sideways(camera: CameraModel, centers: FloatArray) -> FloatArray:
    """Return the direction (2,) in a camera's picture away from the other cameras."""
    away = (camera.center - centers.mean(axis=0)) @ camera.R_camera_rig.T
    length = float(np.hypot(away[0], away[1]))
    return away[:2] / length if length > 1e-6 else np.zeros(2)
