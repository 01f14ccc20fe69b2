"""Depth by the empirical law of the 2018 thesis, depth[cm] = k · d^z with the disparity d in pixels.

The disparity is signed, d = u_left − u_right in undistorted pixels, and must be positive; the thesis used its absolute
value, which does not reveal swapped cameras. The lateral position follows from the pinhole model of the reference
(first) camera. The law is valid for one pair of parallel cameras: it uses the first two cameras of the rig and rotates
the rays of the second into the orientation of the first (without a calibration, the rotation is the identity).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot_fusion.views.triangulate import Prior, Solution, Views


def depth_from_disparity(disparity_px: FloatArray, law: tuple[float, float]) -> FloatArray:
    """Return depths (N,), metres, of disparities d (N,), pixels: 0.01 · k · d^z; NaN where d is not positive."""
    k, z = law
    positive = disparity_px > 0.0
    depth: FloatArray = np.where(positive, 0.01 * k * np.where(positive, disparity_px, 1.0) ** z, np.nan)
    return depth


def disparity_from_depth(depth_m: FloatArray, law: tuple[float, float]) -> FloatArray:
    """Return disparities (N,), pixels, of depths (N,), metres; NaN where the depth is not positive."""
    k, z = law
    positive = depth_m > 0.0
    disparity: FloatArray = np.where(positive, (np.where(positive, depth_m, 1.0) / (0.01 * k)) ** (1.0 / z), np.nan)
    return disparity


class DisparityLaw:
    """Triangulation with the first two cameras of a rig by the depth law."""

    def __init__(self, cameras: Sequence[CameraModel], law: tuple[float, float]) -> None:
        """Determine from the cameras' positions which of the two is the left one.

        Raises:
            ConfigError: fewer than two cameras, no lateral baseline, or an exponent that is not negative.
        """
        if len(cameras) < 2:
            raise ConfigError('fusion.method = "disparity" needs two cameras in rig.toml; it has one')
        if law[1] >= 0.0:
            raise ConfigError(
                f"fusion.depth_law: the exponent must be negative, because depth decreases with disparity; got {law[1]}"
            )
        baseline_m = float(cameras[0].to_camera(cameras[1].center[None])[0, 0])
        if abs(baseline_m) < 1e-3:
            raise ConfigError(
                f"the lateral distance of the first two cameras is {baseline_m * 1e3:.1f} mm; the depth law needs them "
                "side by side: set position_m of the second camera in rig.toml, or calibrate the cameras"
            )
        self._law = law
        self.uses: BoolArray = np.arange(len(cameras)) < 2
        self._reference = cameras[0]
        self._sign = 1.0 if baseline_m > 0.0 else -1.0
        self._focal_px = float(cameras[0].K[0, 0])
        self._R: FloatArray = cameras[0].R_camera_rig @ cameras[1].R_camera_rig.T

    def project(self, points: FloatArray) -> FloatArray:
        """Return normalised coordinates (C, N, 2) of points (N, 3) by the law; NaN for cameras beyond the second."""
        local = self._reference.to_camera(points)
        xy = np.full((len(self.uses), len(points), 2), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            xy[0] = local[:, :2] / local[:, 2:]
            disparity = disparity_from_depth(local[:, 2], self._law)
        seen = xy[0].copy()
        seen[:, 0] -= self._sign * disparity / self._focal_px
        xy[1] = _rotated(seen, self._R.T)
        return xy

    def solve(self, views: Views, prior: Prior, sigma: float) -> Solution:
        """Triangulate by the law; the depth of a point with a single view comes from the prior."""
        count = views.xy.shape[1]
        used = views.used[:2]
        both = used.all(axis=0)
        single = used.any(axis=0) & ~both & np.isfinite(prior.position[:, 0])
        first, second = views.xy[0], _rotated(views.xy[1], self._R)
        disparity = self._sign * self._focal_px * (first[:, 0] - second[:, 0])
        in_front = (both & (disparity > 0.0)) | single
        depth = depth_from_disparity(np.where(both, disparity, np.nan), self._law)
        y = np.where(both, 0.5 * (first[:, 1] + second[:, 1]), first[:, 1])
        x = first[:, 0].copy()
        if single.any():
            depth[single] = self._reference.to_camera(prior.position[single])[:, 2]
            in_front &= ~single | (depth > 0.0)
            other = single & used[1]
            shift_px = self._sign * disparity_from_depth(depth[other], self._law)
            x[other] = second[other, 0] + shift_px / self._focal_px
            y[other] = second[other, 1]
        ray = np.stack([x, y, np.ones(count)], axis=1)
        local = ray * depth[:, None]
        position = (local - self._reference.t_camera_rig) @ self._reference.R_camera_rig
        residual = np.where(both, 0.5 * np.abs(first[:, 1] - second[:, 1]), 0.0)
        return Solution(
            np.where(in_front[:, None], position, np.nan),
            self._covariance(ray, depth, np.where(single, prior.sigma_m, np.nan), sigma),
            residual,
            in_front,
        )

    def _covariance(self, ray: FloatArray, depth: FloatArray, depth_sigma_m: FloatArray, sigma: float) -> FloatArray:
        """Return (N, 3, 3): lateral noise Z·σ; depth noise |z|·Z/d·σ_d with σ_d = √2·f·σ, or the prior's."""
        with np.errstate(invalid="ignore", divide="ignore"):
            of_law = (
                -self._law[1] * depth / disparity_from_depth(depth, self._law) * np.sqrt(2.0) * self._focal_px * sigma
            )
        along = np.where(np.isfinite(depth_sigma_m), depth_sigma_m, of_law)
        axes = ray @ self._reference.R_camera_rig
        lateral = (depth * sigma) ** 2
        covariance: FloatArray = (
            lateral[:, None, None] * np.eye(3) + (along**2)[:, None, None] * axes[:, :, None] * axes[:, None, :]
        )
        return covariance


def _rotated(xy: FloatArray, R: FloatArray) -> FloatArray:
    """Return normalised coordinates (N, 2) after rotating their rays by R."""
    rays = np.column_stack([xy, np.ones(len(xy))]) @ R.T
    rotated: FloatArray = rays[:, :2] / rays[:, 2:]
    return rotated
