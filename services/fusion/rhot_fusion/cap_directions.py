"""From the visible middle of a painted fingertip to the middle of its painted volume, in the picture.

Where the fingers point is what inverse kinematics made of earlier points; how far they point towards the camera or away
from it is what the visible area says, so that the loop through inverse kinematics stays stable.
"""

from __future__ import annotations

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
        self._aside: FloatArray = centers - centers.mean(axis=0)
        self._side: list[FloatArray] = [_sideways(camera, centers) for camera in cameras]
        self._direction: FloatArray = np.full((len(markers), 3), np.nan)
        self.sigma_m: FloatArray = np.zeros(len(markers))
        self.clear()

    def clear(self) -> None:
        """Forget all directions."""
        self._direction[:] = np.nan
        self._share[:] = self._area[:] = self._bent[:] = np.nan
        self.sigma_m[:] = np.where(self._model.is_cap, _UNKNOWN_SIGMA_M, 0.0)

    def learn(self, hand: HandPose) -> None:
        """Take where a hand's fingers point."""
        for place, hinge, tip in self._joints.get(hand.side, []):
            if hinge not in hand.joints or tip not in hand.joints:
                continue
            direction = np.subtract(hand.joints[tip].position, hand.joints[hinge].position)
            length = float(np.linalg.norm(direction))
            if length < 1e-6:
                continue
            direction /= length
            if np.isfinite(self._direction[place, 0]):
                step = direction - self._direction[place]
                turn = float(step @ step)
                gain = _SLOWEST_GAIN + (_FASTEST_GAIN - _SLOWEST_GAIN) * min(1.0, turn / _FAST_TURN_RAD**2)
                direction = self._direction[place] + gain * step
                direction /= float(np.linalg.norm(direction))
            self._direction[place] = direction
            self.sigma_m[place] = _KNOWN_SIGMA_M

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
        absent = np.ones(len(self.sigma_m), dtype=bool)
        absent[index] = False
        for past in (self._area, self._bent, self._share):
            past[camera, absent] = np.nan
        aimed = np.isfinite(self._direction[index, 0])
        if not aimed.any():
            return shift, doubt
        d = np.where(aimed[:, None], self._direction[index], 0.0) @ self._R[camera].T
        anywhere = tracked.any()
        typical = float(np.median(known[tracked, 2])) if anywhere else _TYPICAL_DEPTH_M
        depth = np.maximum(np.where(tracked[index], known[index, 2], typical), 0.1)
        judged = aimed & (sightings.area_px > 0.0) & anywhere
        ray = np.ones((len(index), 3))
        ray[:, :2] = xy
        aside = self._aside[camera] @ self._R[camera].T
        ray, middle_ray = _unit(ray), _unit(ray + aside / depth[:, None])
        cosine = -(d * middle_ray).sum(axis=1)
        area = np.where(judged, sightings.area_px / _PAINT_SHARE * (depth / self._focal_px[camera]) ** 2, np.nan)
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
        bent = np.clip(np.where(judged, best, cosine), -_STEEPEST, _STEEPEST)
        # The direction is tilted to what the area says, about the axis across it and the line of sight.
        tilted = _unit(d + middle_ray * cosine[:, None]) * np.sqrt(1.0 - bent * bent)[:, None]
        tilted -= middle_ray * bent[:, None]
        sight = np.where(judged[:, None], ray, middle_ray)
        seen = -(tilted * sight).sum(axis=1)
        along, whole = self._model.look_up(index, seen)
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
        hidden = np.maximum(1.0 - np.fmin.reduce(self._share, axis=0), 0.0)
        doubt = np.where(np.isfinite(hidden), _HIDDEN_SIGMA_M * hidden, 0.0)
        sigmas: FloatArray = np.sqrt(self.sigma_m**2 + doubt**2)
        return sigmas


def _unit(vectors: FloatArray) -> FloatArray:
    """Return vectors (N, 3) of length one; nothing stays nothing."""
    unit: FloatArray = vectors / np.maximum(np.sqrt((vectors * vectors).sum(axis=1)), 1e-9)[:, None]
    return unit


def _sideways(camera: CameraModel, centers: FloatArray) -> FloatArray:
    """Return the direction (2,) in a camera's picture away from the other cameras."""
    away = (camera.center - centers.mean(axis=0)) @ camera.R_camera_rig.T
    length = float(np.hypot(away[0], away[1]))
    return away[:2] / length if length > 1e-6 else np.zeros(2)
