"""Triangulation from any number of calibrated views, batched over markers.

The linear solution, refined by a Gauss–Newton step on the reprojection error in normalised image coordinates (Hartley
and Zisserman, "Multiple View Geometry", 2nd ed., sections 12.2 and 12.3; inhomogeneous linear system). The covariance
is the inverse of Σ JᵀJ / σ² at the solution (section 5.2.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.camera import CameraModel

_ITERATIONS = 1
"""Gauss–Newton steps from the linear solution; chosen."""
_NEAREST_M = 0.02
"""Smallest valid depth of a point in every camera that sees it."""


@dataclass(frozen=True, slots=True)
class Solution:
    """Triangulated points.

    Attributes:
        position: (N, 3) metres, rig frame; NaN = no solution.
        covariance: (N, 3, 3) square metres.
        residual: (N,) largest reprojection error over the views, normalised units; 0 for a single view.
        in_front: (N,) whether the point is in front of all cameras that see it; often false if cameras are swapped.
    """

    position: FloatArray
    covariance: FloatArray
    residual: FloatArray
    in_front: BoolArray


@dataclass(frozen=True, slots=True)
class Views:
    """Views of N points in C cameras.

    Attributes:
        xy: (C, N, 2) normalised image coordinates.
        used: (C, N) which of them to use; the others may be NaN.
    """

    xy: FloatArray
    used: BoolArray


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior positions of points; determine the depth of points with a single view.

    Attributes:
        position: (N, 3) metres, rig frame; NaN = no prior.
        sigma_m: (N,) standard deviation along each axis, metres.
    """

    position: FloatArray
    sigma_m: FloatArray


class Geometry(Protocol):
    """Triangulation and projection, by the cameras' calibration or by the depth law.

    Attributes:
        uses: (C,) which cameras are used.
    """

    uses: BoolArray

    def solve(self, views: Views, prior: Prior, sigma: float) -> Solution:
        """Return the points of views; sigma is the standard deviation of a coordinate, normalised units."""
        ...

    def project(self, points: FloatArray) -> FloatArray:
        """Return the normalised image coordinates (C, N, 2) of points (N, 3), metres, rig frame."""
        ...


class Triangulation:
    """Triangulation by cameras of known pose."""

    def __init__(self, cameras: Sequence[CameraModel]) -> None:
        self._R: FloatArray = np.stack([camera.R_camera_rig for camera in cameras])
        self._t: FloatArray = np.stack([camera.t_camera_rig for camera in cameras])
        self.uses: BoolArray = np.ones(len(cameras), dtype=bool)

    def project(self, points: FloatArray) -> FloatArray:
        """Return the normalised image coordinates (C, N, 2) of points (N, 3), metres, rig frame."""
        local = np.einsum("cij,nj->cni", self._R, points) + self._t[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            projected: FloatArray = local[:, :, :2] / local[:, :, 2:]
        return projected

    def solve(self, views: Views, prior: Prior, sigma: float) -> Solution:
        """Triangulate; the depth of a point with a single view comes from the prior.

        Args:
            views: of N points in C cameras.
            prior: used for points with one view only.
            sigma: standard deviation of a coordinate, normalised units.
        """
        used = views.used
        count = used.sum(axis=0)
        single = count == 1
        solvable = (count >= 2) | (single & np.isfinite(prior.position[:, 0]))
        xy = np.where(used[:, :, None], views.xy, 0.0)
        weight = used.astype(np.float64)
        information = np.where(single & solvable, (sigma / prior.sigma_m) ** 2, 0.0)
        start = np.where(single[:, None], np.nan_to_num(prior.position), 0.0)
        position = np.where(single[:, None], start, self._linear(xy, weight, solvable & ~single))
        blank = np.where(solvable, 0.0, 1.0)
        for _ in range(_ITERATIONS):
            error, jacobian, _ = self._linearise(position, xy, weight)
            normal = self._normal(jacobian, information, blank)
            gradient = np.einsum("cnri,cnr->ni", jacobian, error) + information[:, None] * (start - position)
            position = position + np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        error, jacobian, depth = self._linearise(position, xy, weight)
        normal = self._normal(jacobian, information, blank)
        in_front = ((depth > _NEAREST_M) | ~used).all(axis=0) & solvable
        residual = np.sqrt((error * error).sum(axis=2).max(axis=0))
        covariance = np.asarray(sigma * sigma * np.linalg.inv(normal), dtype=np.float64)
        return Solution(np.where(in_front[:, None], position, np.nan), covariance, residual, in_front)

    def _normal(self, jacobian: FloatArray, information: FloatArray, blank: FloatArray) -> FloatArray:
        """Return the normal matrices (N, 3, 3), never singular.

        Parallel rays and coincident cameras leave one direction undetermined. Damping by a billionth of the trace keeps
        the step finite and does not shift points that the views determine.
        """
        normal = np.einsum("cnri,cnrj->nij", jacobian, jacobian)
        damping = 1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-15
        damped: FloatArray = normal + (information + blank + damping)[:, None, None] * np.eye(3)
        return damped

    def _linear(self, xy: FloatArray, weight: FloatArray, solvable: BoolArray) -> FloatArray:
        """Return the least squares solution (N, 3) of (r₁ − x r₃)·X = x t₃ − t₁, and the same in y, over all views."""
        rows = weight[:, :, None, None] * (self._R[:, None, :2] - xy[:, :, :, None] * self._R[:, None, 2:])
        right = weight[:, :, None] * (xy * self._t[:, None, 2:] - self._t[:, None, :2])
        normal = np.einsum("cnri,cnrj->nij", rows, rows)
        # Collinear rays make the system singular; the ridge keeps it solvable, and the gates reject the result.
        normal = normal + np.where(solvable, 1e-12, 1.0)[:, None, None] * np.eye(3)
        moment = np.einsum("cnri,cnr->ni", rows, right)
        solution: FloatArray = np.linalg.solve(normal, moment[:, :, None])[:, :, 0]
        return solution

    def _linearise(
        self, position: FloatArray, xy: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return errors (C, N, 2), their Jacobians with respect to the position (C, N, 2, 3), and depths (C, N)."""
        local = np.einsum("cij,nj->cni", self._R, position) + self._t[:, None]
        depth = local[:, :, 2]
        # A point on or behind the image plane has no useful derivative; `in_front` rejects it at the end.
        inverse = weight / np.where(np.abs(depth) > 1e-3, depth, 1e-3)
        projected = local[:, :, :2] * inverse[:, :, None]
        error = weight[:, :, None] * xy - projected
        jacobian = inverse[:, :, None, None] * (self._R[:, None, :2] - projected[:, :, :, None] * self._R[:, None, 2:])
        return error, jacobian, depth
