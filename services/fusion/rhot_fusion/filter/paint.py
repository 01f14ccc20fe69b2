"""From the middle of the paint that a camera sees to the middle of the marker.

What hides part of a marker is nearer than it, so it hides more of it in the camera on its own side: of two cameras the
one that sees less paint sees the middle of that too far towards the other camera, by half of the strip that is hidden.
With the share h that is hidden in one view and not in the fullest one, and w the marker's width, that is ½ h w.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rhot.camera import CameraModel
from rhot_fusion.filter.settings import PaintSettings

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]


class HiddenPaint:
    """What C cameras see of the paint of M markers."""

    def __init__(self, cameras: Sequence[CameraModel], markers: int, settings: PaintSettings) -> None:
        self._settings = settings
        self._focal_px = [float(camera.K[0, 0]) for camera in cameras]
        centers = np.stack([camera.center for camera in cameras])
        # In each camera's picture, the direction away from the other cameras.
        away = [camera.R_camera_rig[:2] @ (camera.center - centers.mean(axis=0)) for camera in cameras]
        self._away: FloatArray = np.array([a / max(float(np.hypot(*a)), 1e-9) for a in away])
        self._width: FloatArray = np.zeros((len(cameras), markers))
        self._seen_s: FloatArray = np.full((len(cameras), markers), -np.inf)

    def clear(self) -> None:
        """Forget all areas."""
        self._seen_s[:] = -np.inf

    def correct(
        self, camera: int, index: IndexArray, t_s: float, area_px: FloatArray, depth_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return how far the middles of markers (N,) lie beside what is seen, and how sure that is.

        Args:
            camera: that sees them.
            index: (N,) markers.
            t_s: when.
            area_px: (N,) visible, square pixels; 0 = not told.
            depth_m: (N,) of the markers.

        Returns:
            (N, 2) what to add to the views and (N,) its standard deviation, normalised units.
        """
        settings = self._settings
        width = np.sqrt(area_px) / self._focal_px[camera]
        # Both cameras' widths lag by the same time: a marker that turns away shrinks in both.
        elapsed = t_s - self._seen_s[camera, index]
        gain = np.where(elapsed > settings.compare_s, 1.0, -np.expm1(-elapsed / settings.settle_s))
        old = self._width[camera, index]
        # Widths in metres: how far the cameras are from the marker makes no difference.
        self._width[camera, index] = old + gain * (width * depth_m - old)
        self._seen_s[camera, index] = t_s
        recent = self._seen_s[:, index] >= t_s - settings.compare_s
        full = np.where(recent, self._width[:, index], 0.0).max(axis=0)
        share = np.square(self._width[camera, index] / np.maximum(full, 1e-9))
        uneven = settings.uneven + settings.rim_px / np.sqrt(np.maximum(area_px, 1.0))
        hidden = np.where(area_px > 0.0, np.clip(1.0 - share - uneven, 0.0, 1.0), 0.0)
        size = hidden * full / depth_m
        doubt = np.hypot(settings.doubt * size, settings.wander * width)
        return settings.shift * size[:, None] * self._away[camera], doubt

    def slack(self, camera: int, area_px: FloatArray) -> FloatArray:
        """Return how far views of markers (N,) may be off for what hides them, normalised units."""
        slack: FloatArray = (self._settings.slack_px + self._settings.slack * np.sqrt(area_px)) / self._focal_px[camera]
        return slack
