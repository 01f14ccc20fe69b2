"""State of each marker: position, velocity, and gating of new points.

The innovation of a point is gated along the axes of its noise. A point inside the gate updates the 1-euro filter with a
bounded innovation. A point outside becomes a candidate, which is accepted after several consistent points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot_bench.thesis.paired.one_euro import Axes, OneEuroFilter, OneEuroSettings
from rhot_bench.thesis.paired.settings import PAIRED


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
