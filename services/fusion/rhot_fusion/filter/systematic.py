"""Systematic errors that averaging does not reduce: those of the calibration and of the paint model.

`cameras.json` states the calibration's error of points at some distances, which is mostly depth. This and the error of
the paint model are added to the filter's covariance, so that the published covariance covers the total error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot_fusion.views.sightings import Upper
from rhot_fusion.views.vectors import Vector, interpolated, vector

CALIBRATION_DOUBT: Final = 1.6
"""Factor applied to the stated calibration error: it is stated for the image centre and is three times as large near
the border (simulated calibrations of 30 rigs, `rhot evaluate motion`).
"""
_ACROSS: Final = 0.15
"""Share of the squared calibration error along each axis perpendicular to the viewing ray; the rest is depth. With a
baseline of an eighth of the distance, depth is eight times less accurate than the lateral position; this share is
larger, to allow for lens distortion.
"""
_SHAPE: Final = 0.15
"""Standard deviation of a fingertip's centre due to its paint and the visible side, each axis, as a share of its
radius: 1 of 6.5 mm. At 0.3, 83 and 98 % of the errors of eight develop rigs at 60 fps lie within one and two stated
sigma; at 0.15, 72 and 96 %.
"""


class Systematic:
    """Systematic error of marker positions."""

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        quality: Any,
        calibration_px: float,
        radius_m: FloatArray,
    ) -> None:
        """Build from the quality figures of `cameras.json`.

        Args:
            cameras: of the rig.
            quality: of `cameras.json`; if it states no errors in millimetres, they are derived from those in pixels.
            calibration_px: systematic error of a view.
            radius_m: (M,) of painted fingertips; 0 for other markers.
        """
        centers = np.stack([camera.center for camera in cameras])
        self._middle = vector(centers.mean(axis=0))
        stated = quality.get("expected_error_mm") if isinstance(quality, dict) else None
        known = sorted(_stated(stated)) if isinstance(stated, dict) else []
        if not known:
            baseline = max(float(np.ptp(centers, axis=0).max()), 1e-3)
            focal_px = float(np.mean([camera.K[0, 0] for camera in cameras]))
            distances = np.linspace(0.2, 2.0, 10)
            known = [(z, 2.0**0.5 * calibration_px * z * z / (baseline * focal_px)) for z in distances.tolist()]
        self._distance_m, self._error_m = (list(column) for column in zip(*known, strict=True))
        # One share of the squared error is isotropic; the rest acts along the viewing ray.
        self._along = CALIBRATION_DOUBT**2 * (1.0 - 3.0 * _ACROSS)
        self._around = CALIBRATION_DOUBT**2 * _ACROSS
        self._shape2: list[float] = np.square(_SHAPE * radius_m).tolist()

    def distance_m(self, position: Vector) -> float:
        """Return the distance of a position from the centroid of the cameras, metres."""
        return math.dist(position, self._middle)

    def covariance(self, marker: int, position: Vector) -> Upper:
        """Return the error covariance (xx, xy, xz, yy, yz, zz), m², of a marker at a position, metres."""
        (x, y, z), (middle_x, middle_y, middle_z) = position, self._middle
        x, y, z = x - middle_x, y - middle_y, z - middle_z
        distance2 = max(x * x + y * y + z * z, 1e-12)
        error2 = interpolated(distance2**0.5, self._distance_m, self._error_m) ** 2
        depth, around = self._along * error2 / distance2, self._around * error2 + self._shape2[marker]
        return (
            depth * x * x + around,
            depth * x * y,
            depth * x * z,
            depth * y * y + around,
            depth * y * z,
            depth * z * z + around,
        )


def _stated(stated: dict[str, Any]) -> list[tuple[float, float]]:
    """Return distances and errors, metres, from a record such as `{"75 cm": {"calibration": 1.1}}`."""
    known = []
    for distance, figures in stated.items():
        number, _, unit = str(distance).partition(" ")
        error = figures.get("calibration") if isinstance(figures, dict) else None
        if unit == "cm" and number.isdigit() and isinstance(error, int | float):
            known.append((0.01 * int(number), 1e-3 * float(error)))
    return known
