"""The pose of a marker, from its corners and the depth inside it, with an honest covariance.

A square's picture has two poses that explain it nearly as well, mirrored at the line of sight (Collins and Bartoli,
"Infinitesimal plane-based pose estimation", IJCV 2014). Both are refined here to the most likely pose given

    corners:  u_i = π(R · X_i + t) + noise of a few tenths of a pixel,
    depth:    n / (n·t) = a + noise of the plane fit, n = R · (0, 0, 1)   (see `fit_depth_plane`)

by Gauss–Newton over (δ, τ): R' = exp([δ]×) · R, t' = t + τ. Marker axes are OpenCV's: x right, y up, z out of the
paper; R and t map them to the camera frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import cross_matrix, rotation_from_vector
from rhot_feet.depth.plane import DepthPlane

CORNER_SIGMA_PX: Final = 0.2
"""Of a sub-pixel corner, per axis, where nothing better is known."""
SIZE_SIGMA: Final = 0.002
"""Of a printed marker's side, as a share of it: 0.1 mm of 60 mm."""
_ITERATIONS: Final = 4
"""Gauss–Newton steps; chosen."""
_SAME_POSE: Final = 1.0 + 2.0 * float(np.cos(0.01))
"""Trace of the rotation between two poses that are the same to 0.01 rad."""


@dataclass(frozen=True, slots=True)
class MarkerPose:
    """One of the poses that explain a marker's picture.

    Attributes:
        R_camera_marker: (3, 3).
        t_camera_marker: (3,) centre of the marker, metres, camera frame.
        covariance: (6, 6) of (δ, τ): rotation about the camera's axes, radians, then position, metres.
        cost: squared residuals of corners and depth over their variances, χ² with 2 degrees of freedom or 5 with depth.
    """

    R_camera_marker: FloatArray
    t_camera_marker: FloatArray
    covariance: FloatArray
    cost: float

    @property
    def normal(self) -> FloatArray:
        """(3,) unit vector out of the paper, camera frame."""
        return self.R_camera_marker[:, 2]


@dataclass(frozen=True, slots=True)
class SquareView:
    """A marker's picture and the one or two poses that its corners alone suggest, the better first.

    Attributes:
        xy: (4, 2) corners in normalised image coordinates.
        sigma: of these, per axis.
        square: (4, 3) the corners in the marker's own frame, metres.
        R: (S, 3, 3) marker to camera.
        t: (S, 3) metres, camera frame.
        reprojection_px: root mean square distance of the corners under the first pose.
    """

    xy: FloatArray
    sigma: float
    square: FloatArray
    R: FloatArray
    t: FloatArray
    reprojection_px: float


def square_corners(size_m: float) -> FloatArray:
    """Return the corners (4, 3) of a marker in its own frame, metres, in the order of OpenCV's detector."""
    half = 0.5 * size_m
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])


def view_square(
    corners: FloatArray, size_m: float, camera: CameraModel, corner_sigma_px: float = CORNER_SIGMA_PX
) -> SquareView | None:
    """Return what the four corners alone suggest; None where they are no picture of a square.

    Args:
        corners: (4, 2) pixels, see `MarkerDetection`.
        size_m: side of the black square.
        camera: its lens.
        corner_sigma_px: of the corners, per axis.
    """
    square = square_corners(size_m)
    xy = camera.undistort(corners)
    try:
        _, rotations, translations, errors = cv2.solvePnPGeneric(
            square, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
    except cv2.error:
        # Three corners on a line, or a corner inside the triangle of the others.
        return None
    turns = np.asarray(rotations, dtype=np.float64).reshape(-1, 3)
    t = np.asarray(translations, dtype=np.float64).reshape(-1, 3)
    usable = np.isfinite(turns).all(axis=1) & np.isfinite(t).all(axis=1) & (t[:, 2] > 0.0)
    if not usable.any():
        return None
    R = np.stack([rotation_from_vector(turn) for turn in turns[usable]])
    focal_px = 0.5 * float(camera.K[0, 0] + camera.K[1, 1])
    # OpenCV's error is the root mean square over all eight coordinates.
    reprojection_px = float(np.sqrt(2.0)) * focal_px * float(np.asarray(errors).ravel()[usable][0])
    return SquareView(xy, corner_sigma_px / focal_px, square, R, t[usable], reprojection_px)


def marker_poses(view: SquareView, plane: DepthPlane | None = None) -> tuple[MarkerPose, ...]:
    """Return the poses that explain a marker's picture, the likelier first: two, or one where they have become one.

    Args:
        view: the corners.
        plane: of the depths inside the marker, if there are any.
    """
    R, t = view.R.copy(), view.t.copy()
    whiten = None if plane is None else np.linalg.inv(np.linalg.cholesky(plane.covariance))
    sound = np.ones(len(R), dtype=np.bool_)
    J, r = _linearised(R, t, view, plane, whiten)
    for _ in range(_ITERATIONS):
        H, g = np.swapaxes(J, 1, 2) @ J, np.einsum("sij,si->sj", J, r)
        trace = np.trace(H, axis1=1, axis2=2)[:, None, None]
        step = np.linalg.solve(H + 1e-6 * trace * np.eye(6), g[..., None])[..., 0]
        turned = np.stack([rotation_from_vector(turn) @ old for turn, old in zip(step[:, :3], R, strict=True)])
        moved = t + step[:, 3:]
        # A step through the camera, or to where its back would be seen, is the end of a solution.
        sound &= (moved[:, 2] > 0.01) & (np.einsum("si,si->s", turned[:, :, 2], moved) < 0.0)
        R, t = np.where(sound[:, None, None], turned, R), np.where(sound[:, None], moved, t)
        J, r = _linearised(R, t, view, plane, whiten)
        if float((step * step).sum()) < 1e-10:
            break
    covariances = _covariances(J)
    costs = np.einsum("si,si->s", r, r)
    freedom = r.shape[1] - 6
    poses = [
        # What does not fit tells of blur or a bad corner: then all of it is worth less.
        MarkerPose(
            R[which],
            t[which],
            covariances[which] * max(1.0, float(costs[which]) / freedom) + _size_covariance(t[which]),
            float(costs[which]),
        )
        for which in np.argsort(costs).tolist()
        if sound[which]
    ]
    if len(poses) == 2 and float((poses[0].R_camera_marker * poses[1].R_camera_marker).sum()) > _SAME_POSE:
        # Depth was clear enough to pull both onto the same answer.
        poses.pop()
    return tuple(poses)


def pose_covariance(view: SquareView) -> FloatArray:
    """Return the covariances (S, 6, 6) of (δ, τ) that the noise of the corners alone gives the poses of a view."""
    return _covariances(_linearised(view.R, view.t, view, None, None)[0])


def _covariances(J: FloatArray) -> FloatArray:
    H = np.swapaxes(J, 1, 2) @ J
    covariances: FloatArray = np.linalg.inv(H + 1e-9 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(6))
    return covariances


def _size_covariance(t: FloatArray) -> FloatArray:
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = SIZE_SIGMA**2 * np.outer(t, t)
    return covariance


def _linearised(
    R: FloatArray, t: FloatArray, view: SquareView, plane: DepthPlane | None, whiten: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return Jacobians (S, N, 6) and residuals (S, N), measured less expected, over the standard deviations."""
    count = len(R)
    turned = view.square @ np.swapaxes(R, 1, 2)
    P = turned + t[:, None]
    projected = P[..., :2] / P[..., 2:]
    to_point = np.zeros((count, 4, 2, 3))
    to_point[..., 0, 0] = to_point[..., 1, 1] = 1.0
    to_point[..., 2] = -projected
    to_point /= P[..., 2, None, None]
    J = np.concatenate([-to_point @ cross_matrix(turned), to_point], axis=3).reshape(count, 8, 6) / view.sigma
    r = (view.xy - projected).reshape(count, 8) / view.sigma
    if plane is None or whiten is None:
        return J, r
    n = R[:, :, 2]
    d = np.einsum("si,si->s", n, t)[:, None]
    outer = n[:, :, None] * t[:, None, :] / d[..., None]
    to_normal = (np.eye(3) - outer) / d[..., None]
    J_plane = np.concatenate([-to_normal @ cross_matrix(n), -n[:, :, None] * n[:, None, :] / d[..., None] ** 2], axis=2)
    r_plane = (plane.coefficients - n / d) @ whiten.T
    return np.concatenate([J, whiten @ J_plane], axis=1), np.concatenate([r, r_plane], axis=1)
