"""From the visible middle of a painted fingertip to the middle of its painted volume, in the picture.

Where the fingers point is what inverse kinematics made of earlier points. It moves a point by millimetres at most, and
by a tenth of a millimetre for a degree, so the loop through it is stable.
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
_MEMORY: Final = 0.15
"""Shares of the visible area are smoothed by this: they flicker by some hundredths."""
_UNEVEN: Final = 0.05
"""Views of a whole marker differ by this share of its area."""
_HIDDEN_SHIFT: Final = 0.7
"""Hiding a strip of a marker shifts its visible middle by half the strip; chosen by the error on simulated hands."""
_HIDDEN_SIGMA_M: Final = 0.04
"""Error of a place, in depth above all, per share of the marker that is hidden."""
_WHOLE: Final = 0.84
"""Least share of the expected area that is reported of a cap of which nothing is hidden."""


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
        self._viewpoint: FloatArray = np.mean([camera.center for camera in cameras], axis=0)
        self._all = np.arange(len(markers))
        self._share: FloatArray = np.full((len(cameras), len(markers)), np.nan)
        centers = np.stack([camera.center for camera in cameras])
        self._side: list[FloatArray] = [_sideways(camera, centers) for camera in cameras]
        self._direction: FloatArray = np.full((len(markers), 3), np.nan)
        self.sigma_m: FloatArray = np.zeros(len(markers))
        self.clear()

    def clear(self) -> None:
        """Forget all directions."""
        self._direction[:] = np.nan
        self._share[:] = np.nan
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

    def offsets(self, position: FloatArray) -> FloatArray:
        """Return from the middles of caps to what the rig as a whole sees as their middles (M, 3), metres.

        Args:
            position: (M, 3) of the markers, metres, rig frame.
        """
        u = self._viewpoint - position
        d = self._direction
        cosine = (d * u).sum(axis=1) / np.sqrt((u * u).sum(axis=1))
        known = np.isfinite(cosine)
        shift, _ = self._model.look_up(self._all, np.where(known, cosine, 0.0))
        # Across the view alone: along it an error of the direction would bend the fingers that it came from further.
        across = d - u * ((d * u).sum(axis=1) / (u * u).sum(axis=1))[:, None]
        offsets: FloatArray = np.where(known[:, None], across, 0.0) * shift[:, None]
        return offsets

    def hidden_shift(self, sightings: Sightings, known: FloatArray, tracked: BoolArray) -> FloatArray:
        """Return by how much (N, 2), normalised units, hiding shifts sightings beyond what it does in other views.

        What hides a part of a marker is nearer than it, and so covers more of it in the camera on its own side: from
        there to the other camera the visible middle moves less. The difference is what depth is made of. The shift that
        both views share stays unknown; it errs sideways by a millimetre or two.

        Args:
            sightings: of the visible parts; what they show of each marker's area is noted.
            known: (M, 6) places of the markers, for their distance.
            tracked: (M,) which of them are known.
        """
        index, xy, camera = sightings.index, sightings.xy, sightings.camera
        d = self._direction[index] @ self._R[camera].T
        # The distance of an unknown marker is not needed well: its shift is a few pixels.
        depth = np.where(tracked[index], np.maximum(known[index, 2], 0.1), _TYPICAL_DEPTH_M)
        cosine = -(d[:, 0] * xy[:, 0] + d[:, 1] * xy[:, 1] + d[:, 2]) / np.sqrt(1.0 + (xy * xy).sum(axis=1))
        seen = np.isfinite(cosine) & tracked[index]
        if not seen.any():
            return np.zeros((len(index), 2))
        _, area = self._model.look_up(index, np.where(seen, cosine, 0.0))
        whole = np.maximum(area / (depth * depth), 1e-12)
        share = np.where(seen, sightings.area_px / (whole * self._focal_px[camera] ** 2), np.nan)
        before = self._share[camera, index]
        share += np.where(np.isfinite(before), (1.0 - _MEMORY) * (before - share), 0.0)
        self._share[camera, index] = share
        best = np.fmax.reduce(self._share[:, index], axis=0)
        less = np.where(seen, np.maximum(best - share - _UNEVEN, 0.0), 0.0)
        shift: FloatArray = (_HIDDEN_SHIFT * less * np.sqrt(whole))[:, None] * self._side[camera]
        return shift

    def sigmas(self) -> FloatArray:
        """Return what places of markers (M,) may be wrong by for their shape and what hides them, metres."""
        hidden = np.maximum(_WHOLE - np.fmin.reduce(self._share, axis=0), 0.0)
        doubt = np.where(np.isfinite(hidden), _HIDDEN_SIGMA_M * hidden, 0.0)
        sigmas: FloatArray = np.sqrt(self.sigma_m**2 + doubt**2)
        return sigmas


def _sideways(camera: CameraModel, centers: FloatArray) -> FloatArray:
    """Return the direction (2,) in a camera's picture away from the other cameras."""
    away = (camera.center - centers.mean(axis=0)) @ camera.R_camera_rig.T
    length = float(np.hypot(away[0], away[1]))
    return away[:2] / length if length > 1e-6 else np.zeros(2)
