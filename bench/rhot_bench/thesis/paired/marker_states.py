"""State of each marker: position, velocity, and gating of new points.

The innovation of a point is gated along the axes of its noise. A point inside the gate updates the 1-euro filter with a
bounded innovation. A point outside becomes a candidate, which is accepted after several consistent points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.geometry.camera import CameraModel
from rhot_bench.thesis.paired.one_euro import PAIRED, Axes, OneEuroFilter, OneEuroSettings

# Triangulation from any number of calibrated views, batched over markers.
#
# The linear solution, refined by a Gauss–Newton step on the reprojection error in normalised image coordinates (Hartley
# and Zisserman, "Multiple View Geometry", 2nd ed., sections 12.2 and 12.3; inhomogeneous linear system). The covariance
# is the inverse of Σ JᵀJ / σ² at the solution (section 5.2.3).

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
class PixelViews:
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

    def solve(self, views: PixelViews, prior: Prior, sigma: float) -> Solution:
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

    def solve(self, views: PixelViews, prior: Prior, sigma: float) -> Solution:
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


class MarkerStates:
    """States of M markers.

    Attributes:
        filter: smooths the points.
        tracked: (M,) whether a marker has a state.
        measured_s: (M,) time at which a marker was last measured by two cameras or more.
        sigma_m: (M,) standard deviation of the last accepted point, metres.
        depth_only: smooth only along the noisiest axis of each point, which is its depth.
    """

    def __init__(
        self, count: int, settings: OneEuroSettings, max_speed_m_s: float, *, depth_only: bool = False
    ) -> None:
        self.depth_only = depth_only
        self.filter = OneEuroFilter(count, settings)
        self.max_speed_m_s = max_speed_m_s
        self.tracked: BoolArray = np.zeros(count, dtype=bool)
        self.measured_s: FloatArray = np.full(count, -np.inf)
        self.sigma_m: FloatArray = np.zeros(count)
        self._candidate: FloatArray = np.full((count, 3), np.nan)
        self._candidate_s: FloatArray = np.full(count, -np.inf)
        self._agreed = np.zeros(count, dtype=np.int64)
        self._trusted_speed: FloatArray = np.zeros((count, 3))
        self._anchor_s: FloatArray = np.full(count, -np.inf)
        self._published: FloatArray = np.full((count, 3), np.nan)
        self._published_s = -np.inf
        self._longest_step_s = np.inf

    def configure(self, settings: OneEuroSettings, max_speed_m_s: float, *, depth_only: bool = False) -> None:
        """Change the settings; the states are kept."""
        self.depth_only = depth_only
        self.filter.settings = settings
        self.max_speed_m_s = max_speed_m_s

    def predict(self, t_s: float) -> FloatArray:
        """Return the predicted positions (M, 3), metres, with decaying velocity; NaN = no state."""
        elapsed = np.clip(t_s - self._anchor_s, 0.0, 10.0)
        reach = PAIRED.damping_s * -np.expm1(-elapsed / PAIRED.damping_s)
        predicted: FloatArray = self.filter.value + self._trusted_speed * reach[:, None]
        predicted[~self.tracked] = np.nan
        return predicted

    def uncertainty_m(self, t_s: float) -> FloatArray:
        """Return the standard deviation (M,) of the prediction along each axis, metres."""
        elapsed = np.clip(t_s - self.filter.t_s, 0.0, 10.0)
        uncertainty: FloatArray = np.minimum(PAIRED.maneuver_m_s * elapsed, PAIRED.maneuver_limit_m)
        return uncertainty

    def accept(
        self,
        index: IndexArray,
        position: FloatArray,
        covariance: FloatArray,
        predicted: FloatArray,
        t_s: float,
        *,
        gated: bool = True,
    ) -> BoolArray:
        """Update the filters of tracked markers with points inside the gate; innovations are bounded.

        Args:
            index: (K,) markers.
            position: (K, 3) metres.
            covariance: (K, 3, 3) square metres.
            predicted: (K, 3) metres.
            t_s: their time.
            gated: False to accept all points.

        Returns:
            (K,) which points are inside the gate along all axes. Points outside it in depth only update the filters
            laterally and are not included.
        """
        variances, basis = np.linalg.eigh(covariance)
        sigma = np.sqrt(np.maximum(variances, 0.0))
        expected = np.hypot(sigma, self.uncertainty_m(t_s)[index][:, None])
        innovation = np.einsum("kji,kj->ki", basis, position - predicted)
        relative = np.abs(innovation) / np.maximum(expected, 1e-9)
        within = (relative <= PAIRED.point_gate_sigmas) | (not gated)
        confirmed: BoolArray = within.all(axis=1)
        # When views of a fast marker disagree in depth (cameras are never exactly synchronised), its lateral position
        # is still valid. Eigenvalues ascend, so the last axis is the noisy one.
        passed = within[:, :2].all(axis=1) & (within[:, 2] | (sigma[:, 2] > PAIRED.elongated * sigma[:, 1]))
        # Huber: clip the innovation.
        innovation *= np.minimum(1.0, PAIRED.full_weight_sigmas / np.maximum(relative, 1e-9)) * within
        bounded = predicted + np.einsum("kij,kj->ki", basis, innovation)
        quiet = np.minimum(1.0, PAIRED.quiet_sigma_m / np.maximum(sigma, 1e-9))
        moved, basis, quiet = index[passed], basis[passed], quiet[passed]
        cutoff_scale = np.maximum(quiet, PAIRED.slowest_cutoff)
        if self.depth_only:
            # Eigenvalues ascend: the last axis is depth; the others were smoothed in the images.
            cutoff_scale[:, :2] = PAIRED.open_cutoff
        axes = Axes(basis, quiet, cutoff_scale)
        advance = (predicted - self.filter.value[index])[passed]
        self.filter.update(moved, bounded[passed], t_s, axes, advance=advance)
        self._anchor_s[moved] = t_s
        self._limit_speed(moved, basis, quiet, t_s)
        # The speed along a noisy axis is mostly noise and must not enter the prediction.
        along_axes = quiet * np.einsum("kji,kj->ki", basis, self.filter.speed[moved])
        self._trusted_speed[moved] = np.einsum("kij,kj->ki", basis, along_axes)
        self.sigma_m[moved] = np.sqrt(variances[passed].sum(axis=1))
        if gated:
            self._agreed[index[confirmed]] = 0
        return confirmed

    def _limit_speed(self, index: IndexArray, basis: FloatArray, quiet: FloatArray, t_s: float) -> None:
        """Limit the speed of markers (K,) since they were last published, with lower limits along noisy axes."""
        interval = min(t_s - self._published_s, self._longest_step_s)
        limit = self.max_speed_m_s * interval * np.maximum(quiet, PAIRED.slowest_share)
        step = np.einsum("kji,kj->ki", basis, self.filter.value[index] - self._published[index])
        # NaN, of markers not published yet, passes through the bounds.
        step = np.einsum("kij,kj->ki", basis, np.clip(step, -limit, limit))
        longest = self.max_speed_m_s * interval
        step *= np.minimum(1.0, longest / np.maximum(np.sqrt((step * step).sum(axis=1)), 1e-9))[:, None]
        shown = np.isfinite(step[:, 0])
        self.filter.value[index[shown]] = self._published[index[shown]] + step[shown]

    def not_updated(self, t_s: float) -> BoolArray:
        """Return which tracked markers (M,) have not been updated at a time."""
        waiting: BoolArray = self.tracked & (self.filter.t_s < t_s)
        return waiting

    def coast(self, siblings: Sequence[IndexArray], t_s: float) -> None:
        """Move tracked markers without an update by the median displacement of their hand's others.

        Args:
            siblings: per marker, the others of its hand.
            t_s: current time; updated markers have been accepted for it.
        """
        moved = self.tracked & (self.filter.t_s >= t_s) & np.isfinite(self._published[:, 0])
        steps = self.filter.value - self._published
        for marker in np.flatnonzero(self.not_updated(t_s) & np.isfinite(self._published[:, 0])).tolist():
            others = siblings[marker][moved[siblings[marker]]]
            if len(others) < PAIRED.fewest_siblings:
                continue
            self.filter.value[marker] = self._published[marker] + np.median(steps[others], axis=0)
            self._trusted_speed[marker] = np.median(self._trusted_speed[others], axis=0)
            self._anchor_s[marker] = t_s

    def publish(self, t_s: float, longest_step_s: float) -> FloatArray:
        """Return the positions (M, 3), metres, to publish for a time; NaN = no state.

        Args:
            t_s: the time.
            longest_step_s: after a gap, markers move by no more than the highest speed times this.
        """
        self._published = self.predict(t_s)
        self._published_s, self._longest_step_s = t_s, longest_step_s
        return self._published

    def propose(self, index: IndexArray, position: FloatArray, covariance: FloatArray, t_s: float) -> BoolArray:
        """Store points of markers that have no state or whose points are outside the gate.

        A marker without a state is started after several consistent points.

        Args:
            index: (K,) markers.
            position: (K, 3) their points, metres, rig frame.
            covariance: (K, 3, 3) square metres.
            t_s: their time.

        Returns:
            (K,) which are confirmed by several consecutive consistent points.
        """
        elapsed = t_s - self._candidate_s[index]
        noise = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        step = np.linalg.norm(position - self._candidate[index], axis=1)
        with np.errstate(invalid="ignore"):
            agrees = (elapsed < PAIRED.agreement_s) & (step <= 0.5 * self.max_speed_m_s * elapsed + 3.0 * noise)
        self._agreed[index] = np.where(agrees, self._agreed[index] + 1, 1)
        self._candidate[index] = position
        self._candidate_s[index] = t_s
        confirmed: BoolArray = self._agreed[index] >= PAIRED.confirmations
        new = confirmed & ~self.tracked[index]
        started = index[new]
        self.filter.start(started, position[new], t_s)
        self._trusted_speed[started] = 0.0
        self._anchor_s[started] = t_s
        self._published[started] = np.nan
        self.sigma_m[started] = noise[new]
        self.tracked[started] = True
        return confirmed

    def drop(self, lost: BoolArray) -> None:
        """Discard the states of markers (M,)."""
        index = np.flatnonzero(lost)
        if len(index):
            self.filter.forget(index)
            self.tracked[index] = False
