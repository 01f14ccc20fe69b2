"""How far each camera's pixels are trusted: what its calibration states, and what its innovations teach.

With S the covariance of an innovation y, r² of it the pixels' own, the log-likelihood −½ (log |S| + yᵀ S⁻¹ y) has the
derivative ½ (yᵀ S⁻² y − tr S⁻¹) by r² and the expected curvature ½ tr S⁻². Each innovation so asks for
r² + derivative / curvature, with the curvature for its weight: where motion explains the innovations, little is learnt.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel
from rhot.rig.quality import figure
from rhot_fusion.filter.settings import NoiseSettings
from rhot_fusion.filter.state import Innovation

FloatArray = NDArray[np.float64]

_CLEAR = 9.0
"""Innovations beyond this squared Mahalanobis distance teach as if they were at it: outliers are not noise."""


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
        self.calibration_px = calibration_px
        self._calibrated = calibrated
        first = settings.first_px if calibrated else settings.uncalibrated_px
        # By camera: sums of weights and of weights times r², in px.
        self._weight: FloatArray = np.full(len(cameras), 0.5 * settings.first_weight / first**4)
        self._asked: FloatArray = self._weight * first**2

    @property
    def sigma_px(self) -> FloatArray:
        """(C,) standard deviation of a coordinate, pixels, as learnt."""
        settings = self._settings
        least = settings.least_px if self._calibrated else settings.uncalibrated_least_px
        most = settings.most_px if self._calibrated else np.inf
        return np.sqrt(np.clip(self._asked / self._weight, least**2, most**2))

    def variance(self, camera: int) -> float:
        """Return the variance of a coordinate, normalised units."""
        sigma, systematic = float(self.sigma_px[camera]), float(self.calibration_px[camera])
        return (sigma * sigma + systematic * systematic) / self._focal_px[camera] ** 2

    def learn(self, camera: int, innovation: Innovation) -> None:
        """Take a frame's innovations; those that were refused teach nothing."""
        chosen = innovation.accepted
        count = int(np.count_nonzero(chosen))
        if not count:
            return
        pixels2 = self._focal_px[camera] ** 2
        y, S = innovation.y[chosen], innovation.S[chosen] * pixels2
        y = y * np.sqrt(pixels2 * np.minimum(1.0, _CLEAR / np.maximum(innovation.nis[chosen], 1e-9)))[:, None]
        inverse = np.linalg.inv(S)
        u = (inverse @ y[:, :, None])[:, :, 0]
        derivative = 0.5 * float((u * u).sum() - np.trace(inverse, axis1=1, axis2=2).sum())
        curvature = 0.5 * float((inverse * inverse).sum())
        keep = np.exp(-count / self._settings.memory)
        known = float(self._asked[camera] / self._weight[camera])
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
