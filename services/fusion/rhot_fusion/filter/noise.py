"""Pixel noise of each camera: the stated calibration error, and an estimate from its innovations.

Let S be the covariance of an innovation y, and r² the pixel noise in it. The log-likelihood −½ (log |S| + yᵀ S⁻¹ y) has
the derivative ½ (yᵀ S⁻² y − tr S⁻¹) with respect to r² and the expected curvature ½ tr S⁻². Each innovation therefore
contributes r² + derivative / curvature, weighted by the curvature (a scoring step): innovations that are dominated by
motion contribute little.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.rig.quality import figure
from rhot_fusion.filter.settings import NoiseSettings
from rhot_fusion.filter.state import Innovation

_CLEAR = 9.0
"""Squared Mahalanobis distance at which innovations are clipped, because outliers are not noise."""

_SHORTEST_M = 1e-3
"""Shorter baselines give no depth, or are one camera that was entered twice."""


class CameraNoise:
    """Pixel noise of C cameras.

    Attributes:
        calibration_px: (C,) systematic errors between the cameras, as stated by their calibration.
    """

    def __init__(
        self, cameras: Sequence[CameraModel], settings: NoiseSettings, calibration_px: FloatArray, calibrated: bool
    ) -> None:
        self._settings = settings
        self._focal_px = [float(camera.K[0, 0]) for camera in cameras]
        self._baseline_m = max(_SHORTEST_M, *(math.dist(a.center, b.center) for a, b in combinations(cameras, 2)))
        self.calibration_px = calibration_px
        first = settings.first_px if calibrated else settings.uncalibrated_px
        least = settings.least_px if calibrated else settings.uncalibrated_least_px
        self._bounds_px2 = least**2, settings.most_px**2 if calibrated else math.inf
        # Per camera: sums of weights and of weights times r², in pixels.
        self._weight = [0.5 * settings.first_weight / first**4] * len(cameras)
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
        keep = math.exp(-count / self._settings.memory)
        known = self._asked[camera] / self._weight[camera]
        self._weight[camera] = keep * self._weight[camera] + curvature
        self._asked[camera] = keep * self._asked[camera] + curvature * known + derivative


def stated_px(names: Sequence[str], quality: Any, settings: NoiseSettings) -> FloatArray:
    """Return the systematic error (C,) of each camera relative to the others, pixels, as stated by `cameras.json`.

    It is the RMS epipolar error of a camera's worst pair at the calibration, with half of its variance in either view.
    """
    worst = dict.fromkeys(names, 0.0)
    for first, second in combinations(names, 2):
        stated = [
            figure(quality, "pairs", f"{a}-{b}", "epipolar_rms_px") for a, b in ((first, second), (second, first))
        ]
        known = next((value for value in stated if value is not None), settings.calibration_px)
        for name in (first, second):
            worst[name] = max(worst[name], known)
    return np.array([worst[name] * 0.5**0.5 for name in names])
