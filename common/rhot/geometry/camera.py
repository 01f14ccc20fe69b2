"""The camera model: OpenCV's pinhole with lens distortion, between the rig frame and raw pixels.

With X_camera = inv(T_rig_camera) · X_rig and (x, y) = (X/Z, Y/Z), the lens bends (x, y) to (x', y')
(`rhot.geometry.distortion`), and (u, v, 1) = K · (x', y', 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.distortion import RATIONAL, distorted
from rhot.geometry.rotations import cross_matrix, rigid


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A calibrated camera.

    Attributes:
        width, height: pixels.
        K: (3, 3) intrinsics, pixels.
        distortion: (n,) OpenCV's coefficients; empty = none.
        R_camera_rig: (3, 3) rotates rig directions into the camera frame.
        t_camera_rig: (3,) metres; X_camera = R_camera_rig · X_rig + t_camera_rig.
        center: (3,) optical centre, metres, rig frame.
    """

    width: int
    height: int
    K: FloatArray
    distortion: FloatArray
    R_camera_rig: FloatArray
    t_camera_rig: FloatArray
    center: FloatArray

    @classmethod
    def from_arrays(
        cls, width: int, height: int, K: FloatArray, distortion: FloatArray, T_rig_camera: FloatArray
    ) -> CameraModel:
        """Build a model from plain arrays: K (3, 3), distortion (n,), T_rig_camera (4, 4)."""
        R_camera_rig = T_rig_camera[:3, :3].T.copy()
        center = np.array(T_rig_camera[:3, 3], dtype=np.float64)
        t = -R_camera_rig @ center
        arrays = [np.array(K, float), np.array(distortion, float).reshape(-1), R_camera_rig, t, center]
        for array in arrays:
            array.setflags(write=False)
        return cls(width, height, *arrays)

    @property
    def T_rig_camera(self) -> FloatArray:
        """(4, 4), maps camera coordinates to rig coordinates."""
        return rigid(self.R_camera_rig.T, self.center)

    def to_camera(self, points: FloatArray) -> FloatArray:
        """Return rig points (N, 3) in the camera frame, metres."""
        transformed: FloatArray = points @ self.R_camera_rig.T + self.t_camera_rig
        return transformed

    def project(self, points: FloatArray) -> FloatArray:
        """Return raw pixels (N, 2) of rig points (N, 3), metres; NaN where a point is not in front of the camera."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if len(points) == 0:
            return np.empty((0, 2))
        camera_points = self.to_camera(points)
        z = np.where(camera_points[:, 2:] > 1e-6, camera_points[:, 2:], np.nan)
        xy = camera_points[:, :2] / z
        if self.distortion.any():
            xy = _bent(xy, self.distortion)
        return xy * self.K.diagonal()[:2] + self.K[:2, 2]

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Return normalised image coordinates (N, 2) (x = X/Z, y = Y/Z) of raw pixels (N, 2)."""
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        if not self.distortion.any():
            return (pixels - self.K[:2, 2]) / self.K.diagonal()[:2]
        if len(pixels) == 0:
            return np.empty((0, 2))
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
        normalised = cv2.undistortPoints(pixels[:, None], self.K, self.distortion, criteria=criteria)
        return np.asarray(normalised, dtype=np.float64).reshape(-1, 2)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Return unit viewing directions (N, 3) of raw pixels (N, 2), rig frame."""
        xy = self.undistort(pixels)
        directions = np.column_stack([xy, np.ones(len(xy))])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        rotated: FloatArray = directions @ self.R_camera_rig
        return rotated

    def contains(self, pixels: FloatArray) -> NDArray[np.bool_]:
        """Tell which pixels (N, 2) lie inside the picture."""
        u, v = pixels[:, 0], pixels[:, 1]
        inside: NDArray[np.bool_] = (u > -0.5) & (u < self.width - 0.5) & (v > -0.5) & (v < self.height - 0.5)
        return inside


@dataclass(frozen=True, slots=True)
class CameraRig:
    """The cameras of a rig, in the order of `rig.toml`; made once from its files (`rhot.rig.cameras.camera_rig`).

    Attributes:
        names: of the cameras.
        models: of each.
        rates_hz: frames per second of each.
        calibrated: the models come from `cameras.json`, not from nominal values.
        quality: what the calibration states of itself, as in `cameras.json`; see `rhot.quality`.
    """

    names: tuple[str, ...]
    models: tuple[CameraModel, ...]
    rates_hz: tuple[float, ...]
    calibrated: bool = True
    quality: Any = None

    def pairs(self) -> list[tuple[str, str]]:
        """Return every two cameras, by name."""
        return list(combinations(self.names, 2))


def _bent(xy: FloatArray, distortion: FloatArray) -> FloatArray:
    """Return where a lens with OpenCV's coefficients bends normalised coordinates (N, 2) to."""
    if len(distortion) > RATIONAL:
        # A thin prism or a tilted sensor, which no camera of this project has had.
        rays = np.column_stack([xy, np.ones(len(xy))])
        bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), distortion)
        return np.asarray(bent, dtype=np.float64).reshape(-1, 2)
    # OpenCV works out derivatives that nobody asked for: it takes 20 times as long.
    coefficients: list[float] = distortion.tolist()
    return distorted(xy[:, 0], xy[:, 1], coefficients).xy


def essential_matrix(first: CameraModel, second: CameraModel) -> FloatArray:
    """Return E (3, 3): normalised views x1, x2 (x, y, 1) of one point meet x2ᵀ · E · x1 = 0.

    With X_second = R · X_first + t: E = [t]× · R (Hartley and Zisserman, "Multiple View Geometry", 2nd ed., eq. 9.12).
    """
    R = second.R_camera_rig @ first.R_camera_rig.T
    t = second.to_camera(first.center[None])[0]
    E: FloatArray = cross_matrix(t) @ R
    return E


def epipolar_distance(first: CameraModel, second: CameraModel, uv: FloatArray, uv_second: FloatArray) -> FloatArray:
    """Return signed distances (n,), pixels, of points from the epipolar lines of their partners.

    Args:
        first, second: cameras.
        uv: (n, 2) raw pixels in the first camera.
        uv_second: (n, 2) raw pixels of the same points in the second.
    """
    E = essential_matrix(first, second)
    one = np.column_stack([first.undistort(uv), np.ones(len(uv))])
    two = np.column_stack([second.undistort(uv_second), np.ones(len(uv))])
    lines = one @ E.T
    focal_px = 0.5 * (second.K[0, 0] + second.K[1, 1])
    distance: FloatArray = focal_px * np.sum(lines * two, axis=1) / np.linalg.norm(lines[:, :2], axis=1)
    return distance


def rays_meet_ahead(
    first: CameraModel, second: CameraModel, xy: FloatArray, xy_second: FloatArray
) -> NDArray[np.bool_]:
    """Return (n,) whether the rays of two cameras come nearest to each other in front of both.

    Args:
        first, second: cameras.
        xy, xy_second: (n, 2) normalised image coordinates of the same points.
    """
    # With both rays in the rig frame, d1 and d2, from centres a baseline b apart: z1·d1 − z2·d2 = b in least squares.
    d1 = np.column_stack([xy, np.ones(len(xy))]) @ first.R_camera_rig
    d2 = np.column_stack([xy_second, np.ones(len(xy))]) @ second.R_camera_rig
    b = second.center - first.center
    a11, a12, a22 = (d1 * d1).sum(1), -(d1 * d2).sum(1), (d2 * d2).sum(1)
    c1, c2 = d1 @ b, -(d2 @ b)
    ahead: NDArray[np.bool_] = (a22 * c1 - a12 * c2 > 0.0) & (a11 * c2 - a12 * c1 > 0.0)
    return ahead


def meeting_points(cameras: Sequence[CameraModel], pixels: Sequence[FloatArray], seen: NDArray[np.bool_]) -> FloatArray:
    """Return the points (n, 3) nearest to the rays of all cameras that see them, metres, rig frame.

    Args:
        cameras: C of them.
        pixels: of each camera, (n, 2) raw; where it does not see a point, anything.
        seen: (C, n) which camera sees which point; two or more see each.
    """
    A, b = np.zeros((seen.shape[1], 3, 3)), np.zeros((seen.shape[1], 3))
    for model, uv, visible in zip(cameras, pixels, seen, strict=True):
        xy1 = np.column_stack([model.undistort(np.where(np.isfinite(uv), uv, 0.0)), np.ones(len(uv))])
        rays = xy1 @ model.T_rig_camera[:3, :3].T
        directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        across = visible[:, None, None] * (np.eye(3) - directions[:, :, None] * directions[:, None, :])
        A += across
        b += across @ model.center
    return np.asarray(np.linalg.solve(A, b[..., None])[..., 0], dtype=np.float64)
