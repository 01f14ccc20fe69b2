"""State of each marker: position, velocity, and the gating of new points.

A point is gated by its innovation against the prediction, in the axes of its own noise; one that passes moves the
1-euro filter, by a bounded amount. One that does not is kept as a candidate, and believed once it repeats.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot_fusion.paired.one_euro import Axes, OneEuroFilter, OneEuroSettings
from rhot_fusion.paired.settings import PAIRED


class MarkerStates:
    """States of M markers.

    Attributes:
        filter: the smoothed points.
        tracked: (M,) whether a marker has a state.
        backed_s: (M,) when a marker was last seen by two cameras or more.
        sigma_m: (M,) noise of the last accepted point.
        depth_only: the filters smooth along the noisiest axis of each point alone, which is its depth.
    """

    def __init__(
        self, count: int, settings: OneEuroSettings, max_speed_m_s: float, *, depth_only: bool = False
    ) -> None:
        self.depth_only = depth_only
        self.filter = OneEuroFilter(count, settings)
        self.max_speed_m_s = max_speed_m_s
        self.tracked: BoolArray = np.zeros(count, dtype=bool)
        self.backed_s: FloatArray = np.full(count, -np.inf)
        self.sigma_m: FloatArray = np.zeros(count)
        self._candidate: FloatArray = np.full((count, 3), np.nan)
        self._candidate_s: FloatArray = np.full(count, -np.inf)
        self._agreed = np.zeros(count, dtype=np.int64)
        self._trusted_speed: FloatArray = np.zeros((count, 3))
        self._anchor_s: FloatArray = np.full(count, -np.inf)
        self._shown: FloatArray = np.full((count, 3), np.nan)
        self._shown_s = -np.inf
        self._longest_step_s = np.inf

    def configure(self, settings: OneEuroSettings, max_speed_m_s: float, *, depth_only: bool = False) -> None:
        """Change the settings; states stay."""
        self.depth_only = depth_only
        self.filter.settings = settings
        self.max_speed_m_s = max_speed_m_s

    def predict(self, t_s: float) -> FloatArray:
        """Return where the markers are believed to be (M, 3), metres; the velocity fades. NaN = no state."""
        elapsed = np.clip(t_s - self._anchor_s, 0.0, 10.0)
        reach = PAIRED.damping_s * -np.expm1(-elapsed / PAIRED.damping_s)
        predicted: FloatArray = self.filter.value + self._trusted_speed * reach[:, None]
        predicted[~self.tracked] = np.nan
        return predicted

    def uncertainty_m(self, t_s: float) -> FloatArray:
        """Return the standard deviation (M,) of the prediction along each axis."""
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
        """Let points of tracked markers move the filters, if they pass the gate; by a bounded amount in any case.

        Args:
            index: (K,) markers.
            position: (K, 3) metres.
            covariance: (K, 3, 3).
            predicted: (K, 3) metres.
            t_s: their time.
            gated: whether a point must agree with the prediction.

        Returns:
            (K,) which agreed with the prediction in all axes. Points that disagree in depth alone move their filters
            sideways only and do not count.
        """
        variances, basis = np.linalg.eigh(covariance)
        sigma = np.sqrt(np.maximum(variances, 0.0))
        expected = np.hypot(sigma, self.uncertainty_m(t_s)[index][:, None])
        innovation = np.einsum("kji,kj->ki", basis, position - predicted)
        relative = np.abs(innovation) / np.maximum(expected, 1e-9)
        within = (relative <= PAIRED.point_gate_sigmas) | (not gated)
        confirmed: BoolArray = within.all(axis=1)
        # Cameras that disagree about the depth of a fast marker (they are never quite in step) still know where it is
        # sideways; eigenvalues ascend, so the last axis is the noisy one.
        passed = within[:, :2].all(axis=1) & (within[:, 2] | (sigma[:, 2] > PAIRED.elongated * sigma[:, 1]))
        # Huber: beyond its full weight a point pulls no harder.
        innovation *= np.minimum(1.0, PAIRED.full_weight_sigmas / np.maximum(relative, 1e-9)) * within
        bounded = predicted + np.einsum("kij,kj->ki", basis, innovation)
        quiet = np.minimum(1.0, PAIRED.quiet_sigma_m / np.maximum(sigma, 1e-9))
        moved, basis, quiet = index[passed], basis[passed], quiet[passed]
        cutoff_scale = np.maximum(quiet, PAIRED.slowest_cutoff)
        if self.depth_only:
            # Eigenvalues ascend: the last axis is depth, the others were smoothed in the pictures.
            cutoff_scale[:, :2] = PAIRED.open_cutoff
        axes = Axes(basis, quiet, cutoff_scale)
        advance = (predicted - self.filter.value[index])[passed]
        self.filter.update(moved, bounded[passed], t_s, axes, advance=advance)
        self._anchor_s[moved] = t_s
        self._glide(moved, basis, quiet, t_s)
        # The speed along a noisy axis is mostly noise; a prediction must not run away with it.
        along_axes = quiet * np.einsum("kji,kj->ki", basis, self.filter.speed[moved])
        self._trusted_speed[moved] = np.einsum("kij,kj->ki", basis, along_axes)
        self.sigma_m[moved] = np.sqrt(variances[passed].sum(axis=1))
        if gated:
            self._agreed[index[confirmed]] = 0
        return confirmed

    def _glide(self, index: IndexArray, basis: FloatArray, quiet: FloatArray, t_s: float) -> None:
        """Keep markers from moving faster than is believable since they were last shown, most of all along noise."""
        interval = min(t_s - self._shown_s, self._longest_step_s)
        limit = self.max_speed_m_s * interval * np.maximum(quiet, PAIRED.slowest_glide)
        step = np.einsum("kji,kj->ki", basis, self.filter.value[index] - self._shown[index])
        # Not shown yet: NaN, which passes through the bounds.
        step = np.einsum("kij,kj->ki", basis, np.clip(step, -limit, limit))
        longest = self.max_speed_m_s * interval
        step *= np.minimum(1.0, longest / np.maximum(np.sqrt((step * step).sum(axis=1)), 1e-9))[:, None]
        shown = np.isfinite(step[:, 0])
        self.filter.value[index[shown]] = self._shown[index[shown]] + step[shown]

    def still_to_move(self, t_s: float) -> BoolArray:
        """Return which tracked markers (M,) nothing has moved yet at a moment."""
        waiting: BoolArray = self.tracked & (self.filter.t_s < t_s)
        return waiting

    def coast(self, siblings: Sequence[IndexArray], t_s: float) -> None:
        """Carry tracked markers that nothing moved at this moment along with the others of their hand.

        Args:
            siblings: per marker the others of its hand.
            t_s: the moment; markers that moved have been accepted for it.
        """
        moved = self.tracked & (self.filter.t_s >= t_s) & np.isfinite(self._shown[:, 0])
        steps = self.filter.value - self._shown
        for marker in np.flatnonzero(self.still_to_move(t_s) & np.isfinite(self._shown[:, 0])).tolist():
            others = siblings[marker][moved[siblings[marker]]]
            if len(others) < PAIRED.fewest_siblings:
                continue
            self.filter.value[marker] = self._shown[marker] + np.median(steps[others], axis=0)
            self._trusted_speed[marker] = np.median(self._trusted_speed[others], axis=0)
            self._anchor_s[marker] = t_s

    def show(self, t_s: float, longest_step_s: float) -> FloatArray:
        """Return the markers' positions (M, 3), metres, to be published for a moment; NaN = no state.

        Args:
            t_s: the moment.
            longest_step_s: markers glide to where they are found after a gap by no more than the way of this time.
        """
        self._shown = self.predict(t_s)
        self._shown_s, self._longest_step_s = t_s, longest_step_s
        return self._shown

    def propose(self, index: IndexArray, position: FloatArray, covariance: FloatArray, t_s: float) -> BoolArray:
        """Note points of markers that have no state, or whose state contradicts them.

        A marker without a state starts at its point as soon as a few have agreed.

        Args:
            index: (K,) markers.
            position: (K, 3) their points, metres, rig frame.
            covariance: (K, 3, 3) square metres.
            t_s: the moment.

        Returns:
            (K,) which are confirmed, because their points agreed several times running.
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
        self._shown[started] = np.nan
        self.sigma_m[started] = noise[new]
        self.tracked[started] = True
        return confirmed

    def drop(self, lost: BoolArray) -> None:
        """Forget markers (M,) that were not measured for too long."""
        index = np.flatnonzero(lost)
        if len(index):
            self.filter.forget(index)
            self.tracked[index] = False
