"""Pixel noise of each camera: the stated calibration error, and an estimate from its innovations.

With S the covariance of an innovation y, r² of it the pixels' own, the log-likelihood −½ (log |S| + yᵀ S⁻¹ y) has the
derivative ½ (yᵀ S⁻² y − tr S⁻¹) by r² and the expected curvature ½ tr S⁻². Each innovation so asks for
r² + derivative / curvature, with the curvature for its weight: where motion explains the innovations, little is learnt.
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
"""Innovations beyond this squared Mahalanobis distance teach as if they were at it: outliers are not noise."""

_SHORTEST_M = 1e-3
"""Cameras nearer to each other than this show no depth, or are one camera that was entered twice."""


class CameraNoise:
    """The noise of C cameras.

    Attributes:
        calibration_px: (C,) systematic errors between the cameras, as their calibration states them.
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
        # By camera: sums of weights and of weights times r², in px.
        self._weight = [0.5 * settings.first_weight / first**4] * len(cameras)
        self._asked = [weight * first**2 for weight in self._weight]

    @property
    def sigma_px(self) -> FloatArray:
        """(C,) standard deviation of a coordinate, pixels, as learnt."""
        return np.sqrt([self._variance_px2(camera) for camera in range(len(self._focal_px))])

    def variance(self, camera: int) -> float:
        """Return the variance of a coordinate, normalised units."""
        systematic = float(self.calibration_px[camera])
        return (self._variance_px2(camera) + systematic * systematic) / self._focal_px[camera] ** 2

    @property
    def pair_variance(self) -> float:
        """Variance of the depth of what two views show, 1/m²: times the fourth power of how far away it is."""
        count = len(self._focal_px)
        return 2.0 * sum(self.variance(camera) for camera in range(count)) / count / self._baseline_m**2

    def _variance_px2(self, camera: int) -> float:
        """Return the variance of a coordinate, square pixels, as learnt."""
        low, high = self._bounds_px2
        return min(max(self._asked[camera] / self._weight[camera], low), high)

    def learn(self, camera: int, innovation: Innovation) -> None:
        """Take a frame's innovations; those that were refused teach nothing."""
        pixels2 = self._focal_px[camera] ** 2
        count, derivative, curvature = 0, 0.0, 0.0
        columns = (innovation.accepted, innovation.y, innovation.S, innovation.nis)
        for taken, (y0, y1), (a, b, c), nis in zip(*(column.tolist() for column in columns), strict=True):
            if not taken:
                continue
            count += 1
            # The inverse of S, and what it makes of y.
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
    """Return the systematic error (C,) of each camera against the others, pixels, as `cameras.json` states it.

    It is the RMS epipolar error at the calibration, of the worst pair of a camera, half of it in either view.
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
