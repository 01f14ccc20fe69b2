"""Errors of measurement: pixel noise, learnt per camera, and what averaging does not reduce: calibration and paint.

`cameras.json` states the calibration's error of points at some distances, which is mostly depth. This and the error of
the paint model are added to the filter's covariance, so that the published covariance covers the total error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any, Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.quality import figure
from rhot.types import Vector3
from rhot_fusion.filter.state import Innovation
from rhot_fusion.views.sightings import Upper, interpolated, vector

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

    def distance_m(self, position: Vector3) -> float:
        """Return the distance of a position from the centroid of the cameras, metres."""
        return math.dist(position, self._middle)

    def covariance(self, marker: int, position: Vector3) -> Upper:
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


_FIRST_WEIGHT: Final = 50.0
"""Number of observations that the initial value counts as."""
CALIBRATION_PX: Final = 0.2
"""Systematic error between cameras if `cameras.json` states none, pixels."""

# Pixel noise of each camera: the stated calibration error, and an estimate from its innovations.
#
# Let S be the covariance of an innovation y, and r² the pixel noise in it. The log-likelihood −½ (log |S| + yᵀ S⁻¹ y)
# has the derivative ½ (yᵀ S⁻² y − tr S⁻¹) with respect to r² and the expected curvature ½ tr S⁻². Each innovation
# therefore contributes r² + derivative / curvature, weighted by the curvature (a scoring step): innovations that are
# dominated by motion contribute little.

_CLEAR = 9.0
"""Squared Mahalanobis distance at which innovations are clipped, because outliers are not noise."""


class CameraNoise:
    """Pixel noise of C cameras.

    Attributes:
        calibration_px: (C,) systematic errors between the cameras, as stated by their calibration.
    """

    def __init__(self, cameras: Sequence[CameraModel], calibration_px: FloatArray, calibrated: bool) -> None:
        self._focal_px = [float(camera.K[0, 0]) for camera in cameras]
        # Shorter baselines give no depth, or are one camera that was entered twice.
        self._baseline_m = max(1e-3, *(math.dist(a.center, b.center) for a, b in combinations(cameras, 2)))
        self.calibration_px = calibration_px
        # Initial standard deviation of a pixel coordinate: centroids of painted tips in photo-real pictures have
        # errors of 0.2 to 0.3 px. Without `cameras.json` a pixel, not counting errors of time stamps.
        first = 0.3 if calibrated else 1.0
        # Bounds of the estimate, pixels. Without `cameras.json`, coordinates are whole pixels, or the lens's
        # distortion is unknown.
        least = 0.05 if calibrated else 0.3
        self._bounds_px2 = least**2, 2.0**2 if calibrated else math.inf
        # Per camera: sums of weights and of weights times r², in pixels.
        self._weight = [0.5 * _FIRST_WEIGHT / first**4] * len(cameras)
        self._asked = [weight * first**2 for weight in self._weight]

    @property
    def sigma_px(self) -> FloatArray:
        """(C,) estimated standard deviation of a coordinate, pixels."""
        return np.sqrt([self._variance_px2(camera) for camera in range(len(self._focal_px))])

    def variance(self, camera: int) -> float:
        """Return the variance of a coordinate, normalised units."""
        systematic = float(self.calibration_px[camera])
        return (self._variance_px2(camera) + systematic * systematic) / self._focal_px[camera] ** 2

    @property
    def pair_variance(self) -> float:
        """Variance of the depth from two views divided by the fourth power of the distance, 1/m²."""
        count = len(self._focal_px)
        return 2.0 * sum(self.variance(camera) for camera in range(count)) / count / self._baseline_m**2

    def _variance_px2(self, camera: int) -> float:
        """Return the estimated variance of a coordinate, square pixels."""
        low, high = self._bounds_px2
        return min(max(self._asked[camera] / self._weight[camera], low), high)

    def learn(self, camera: int, innovation: Innovation) -> None:
        """Update the estimate with a frame's accepted innovations."""
        pixels2 = self._focal_px[camera] ** 2
        count, derivative, curvature = 0, 0.0, 0.0
        columns = (innovation.accepted, innovation.y, innovation.S, innovation.nis)
        for taken, (y0, y1), (a, b, c), nis in zip(*(column.tolist() for column in columns), strict=True):
            if not taken:
                continue
            count += 1
            # S⁻¹ and S⁻¹ y.
            det = (a * c - b * b) * pixels2
            d, e, f = c / det, -b / det, a / det
            u0, u1 = d * y0 + e * y1, e * y0 + f * y1
            shrink = pixels2 * min(1.0, _CLEAR / max(nis, 1e-9))
            derivative += 0.5 * (shrink * (u0 * u0 + u1 * u1) - (d + f))
            curvature += 0.5 * (d * d + 2.0 * e * e + f * f)
        if not count:
            return
        # Number of observations after which the weight of an old observation has decayed to 37 %; about 20 s
        # of a hand in front of one camera.
        keep = math.exp(-count / 5000.0)
        known = self._asked[camera] / self._weight[camera]
        self._weight[camera] = keep * self._weight[camera] + curvature
        self._asked[camera] = keep * self._asked[camera] + curvature * known + derivative


def stated_px(names: Sequence[str], quality: Any) -> FloatArray:
    """Return the systematic error (C,) of each camera relative to the others, pixels, as stated by `cameras.json`.

    It is the RMS epipolar error of a camera's worst pair at the calibration, with half of its variance in either view.
    """
    worst = dict.fromkeys(names, 0.0)
    for first, second in combinations(names, 2):
        stated = [
            figure(quality, "pairs", f"{a}-{b}", "epipolar_rms_px") for a, b in ((first, second), (second, first))
        ]
        known = next((value for value in stated if value is not None), CALIBRATION_PX)
        for name in (first, second):
            worst[name] = max(worst[name], known)
    return np.array([worst[name] * 0.5**0.5 for name in names])
