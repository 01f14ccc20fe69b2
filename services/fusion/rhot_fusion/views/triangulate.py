"""Triangulation from any number of calibrated views, batched over markers.

Linear start, then a Gauss–Newton step on the reprojection error in normalised image coordinates (Hartley and Zisserman,
"Multiple View Geometry", 2nd ed., sections 12.2 and 12.3; the linear system here is the inhomogeneous one). The
covariance is the inverse of Σ JᵀJ / σ² at the solution (section 5.2.3, forward from the Jacobian).
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
"""A point must lie this far in front of every camera that saw it."""


@dataclass(frozen=True, slots=True)
class Solution:
    """Points from views.

    Attributes:
        position: (N, 3) metres, rig frame; NaN = no solution.
        covariance: (N, 3, 3) square metres.
        residual: (N,) largest reprojection error over the views, normalised units; 0 for a single view.
        in_front: (N,) whether the point lies in front of all cameras that saw it; false tells of swapped cameras.
    """

    position: FloatArray
    covariance: FloatArray
    residual: FloatArray
    in_front: BoolArray


@dataclass(frozen=True, slots=True)
class Views:
    """What several cameras see of N points.

    Attributes:
        xy: (C, N, 2) normalised image coordinates.
        used: (C, N) which of them count; the others may be NaN.
    """

    xy: FloatArray
    used: BoolArray


@dataclass(frozen=True, slots=True)
class Prior:
    """Where points are believed to be before looking; it decides the depth of a point with a single view.

    Attributes:
        position: (N, 3) metres, rig frame; NaN = nothing believed.
        sigma_m: (N,) standard deviation along each axis.
    """

    position: FloatArray
    sigma_m: FloatArray


class Geometry(Protocol):
    """How views become points and back; lens calibration or the depth law.

    Attributes:
        uses: (C,) which cameras it can use.
    """

    uses: BoolArray

    def solve(self, views: Views, prior: Prior, sigma: float) -> Solution:
        """Return the points behind the views; sigma is the noise of a coordinate, normalised units."""
        ...

    def project(self, points: FloatArray) -> FloatArray:
        """Return the normalised image coordinates (C, N, 2) of points (N, 3), metres, rig frame."""
        ...


class Triangulation:
    """Cameras of known pose and their points."""

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
        """Triangulate; a point with a single view takes its depth from the prior.

        Args:
            views: N points seen by C cameras.
            prior: used for points with one view only.
            sigma: standard deviation of a normalised coordinate.
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

        Rays that meet nowhere (parallel, or cameras in one place) leave a direction free; damping it by a billionth
        keeps the step finite and moves no point that the views do fix.
        """
        normal = np.einsum("cnri,cnrj->nij", jacobian, jacobian)
        damping = 1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-15
        damped: FloatArray = normal + (information + blank + damping)[:, None, None] * np.eye(3)
        return damped

    def _linear(self, xy: FloatArray, weight: FloatArray, solvable: BoolArray) -> FloatArray:
        """Least squares of (r₁ − x r₃)·X = x t₃ − t₁ and its twin in y, over all views."""
        rows = weight[:, :, None, None] * (self._R[:, None, :2] - xy[:, :, :, None] * self._R[:, None, 2:])
        right = weight[:, :, None] * (xy * self._t[:, None, 2:] - self._t[:, None, :2])
        normal = np.einsum("cnri,cnrj->nij", rows, rows)
        # Views along one line leave the system singular; the ridge keeps it solvable and the gates refuse the result.
        normal = normal + np.where(solvable, 1e-12, 1.0)[:, None, None] * np.eye(3)
        moment = np.einsum("cnri,cnr->ni", rows, right)
        solution: FloatArray = np.linalg.solve(normal, moment[:, :, None])[:, :, 0]
        return solution

    def _linearise(
        self, position: FloatArray, xy: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return errors (C, N, 2), their Jacobian by position (C, N, 2, 3) and depths (C, N)."""
        local = np.einsum("cij,nj->cni", self._R, position) + self._t[:, None]
        depth = local[:, :, 2]
        # A point on or behind the image plane has no useful derivative; it is refused by its depth in the end.
        inverse = weight / np.where(np.abs(depth) > 1e-3, depth, 1e-3)
        projected = local[:, :, :2] * inverse[:, :, None]
        error = weight[:, :, None] * xy - projected
        jacobian = inverse[:, :, None, None] * (self._R[:, None, :2] - projected[:, :, :, None] * self._R[:, None, 2:])
        return error, jacobian, depth
