"""Association of views with markers, and triangulation of points.

There are three passes. Markers are measured from views that agree with the prediction and with each other. The others
are triangulated from all their views without the prediction, and accepted after several consistent points. The rest are
updated along the ray of their best single view.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.geometry.camera import CameraModel
from rhot.rig import FusionConfig, MarkerConfig
from rhot_fusion.paired.disparity import DisparityLaw
from rhot_fusion.paired.marker_states import MarkerStates
from rhot_fusion.paired.one_euro import OneEuroSettings
from rhot_fusion.paired.settings import PAIRED
from rhot_fusion.views.coherence import HandCoherence
from rhot_fusion.views.epipolar import EpipolarModel
from rhot_fusion.views.sightings import Outcome
from rhot_fusion.views.tracks import Snapshot
from rhot_fusion.views.triangulate import Geometry, Prior, Solution, Triangulation, Views

CountArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class _Moment:
    """Views of one time, with the predictions.

    Attributes:
        t_s: the time.
        views: corrected views of all markers.
        misses: (C, M) distance of each view from its marker's prediction, in units of the gate; NaN = no prediction.
        plausible: (C, M) views inside the gate.
        prior: predictions.
        sigma: noise of a coordinate, normalised units.
    """

    t_s: float
    views: Views
    misses: FloatArray
    plausible: BoolArray
    prior: Prior
    sigma: float


class Association:
    """Holds the states of all markers of a rig and updates them with new views."""

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        markers: Mapping[str, MarkerConfig],
        hand_length_m: float,
        config: FusionConfig,
        counts: Counter[str],
    ) -> None:
        """Build from the rig's parts; increments `measured`, `gated` and `behind_cameras` of counts.

        Raises:
            ConfigError: the configured method cannot use the cameras.
        """
        self._cameras = list(cameras)
        self._centers: FloatArray = np.stack([camera.center for camera in cameras])
        self._focal_px = float(np.mean([camera.K[0, 0] for camera in cameras]))
        self._counts = counts
        self._config = config
        self._geometry = self._make_geometry(config)
        self._hands = HandCoherence(markers, hand_length_m)
        depth_only = config.one_euro == "pixels"
        self._states = MarkerStates(len(markers), _one_euro(config), config.max_speed_m_s, depth_only=depth_only)
        self._last_s = -np.inf
        self.epipolar = EpipolarModel(cameras, config.epipolar_limit_px)

    def configure(self, config: FusionConfig) -> None:
        """Change the settings; the states are discarded only if the method changes.

        Raises:
            ConfigError: the new method cannot use the cameras; the old settings stay in force.
        """
        self._geometry = self._make_geometry(config)
        if config.method != self._config.method:
            self.clear()
        self._config = config
        self.epipolar.set_limit(config.epipolar_limit_px)
        depth_only = config.one_euro == "pixels"
        self._states.configure(_one_euro(config), config.max_speed_m_s, depth_only=depth_only)

    def clear(self) -> None:
        """Discard all markers; the estimated epipolar residuals are kept."""
        self._states.drop(np.ones(len(self._states.tracked), dtype=bool))
        self._last_s = -np.inf

    def advance(self, shot: Snapshot, t_s: float, longest_step_s: float) -> Outcome:
        """Update all markers with the tracks at a time later than the last.

        Args:
            shot: the tracks, uncorrected.
            t_s: the time.
            longest_step_s: see `MarkerStates.publish`.
        """
        moment = self._prepare(shot, t_s)
        views = self._confirm(moment)
        self._reacquire(moment, views)
        measured = views > 0
        self._follow(moment, views)
        states = self._states
        states.measured_s[measured] = t_s
        self._counts["measured"] += int(np.count_nonzero(measured))
        self.epipolar.learn(shot.xy, shot.valid & measured, t_s - self._last_s)
        self._last_s = t_s
        states.drop(states.tracked & (t_s - states.measured_s > self._config.hold_s))
        states.coast(self._hands.siblings, t_s)
        position = states.publish(t_s, longest_step_s)
        age = np.where(states.tracked, t_s - states.measured_s, 0.0)
        sigma = np.hypot(states.sigma_m, PAIRED.maneuver_m_s * age)
        columns = (position, sigma, views, measured, moment.views.used)
        return Outcome(t_s, *(column.tolist() for column in columns))

    def _prepare(self, shot: Snapshot, t_s: float) -> _Moment:
        views = Views(self.epipolar.correct(shot.xy), shot.valid & self._geometry.uses[:, None])
        predicted = self._states.predict(t_s)
        sigma = max(self.epipolar.spread_px / np.sqrt(2.0), PAIRED.least_noise_px) / self._focal_px
        away = views.xy - self._geometry.project(predicted)
        direction = predicted - self._centers[:, None]
        with np.errstate(invalid="ignore"):
            distance = np.maximum(np.sqrt((direction * direction).sum(axis=2)), 0.1)
            gate = PAIRED.view_gate_sigmas * np.hypot(sigma, self._states.uncertainty_m(t_s) / distance)
            misses = np.hypot(away[:, :, 0], away[:, :, 1]) / (gate + PAIRED.view_gate_slack_px / self._focal_px)
            plausible = views.used & (misses <= 1.0)
        age = np.clip(t_s - self._states.measured_s, 0.0, 1.0)
        return _Moment(
            t_s, views, misses, plausible, Prior(predicted, PAIRED.depth_sigma_m + PAIRED.maneuver_m_s * age), sigma
        )

    def _confirm(self, moment: _Moment) -> CountArray:
        """Update tracked markers from two or more views inside the gate; return the numbers of views used (M,)."""
        count = moment.plausible.sum(axis=0)
        views = np.zeros(len(count), dtype=np.int64)
        index = np.flatnonzero(self._states.tracked & (count >= 2))
        solution, good = self._solve(moment, moment.plausible, index)
        index = index[good]
        passed = self._states.accept(
            index, solution.position[good], solution.covariance[good], moment.prior.position[index], moment.t_s
        )
        views[index[passed]] = count[index[passed]]
        return views

    def _reacquire(self, moment: _Moment, views: CountArray) -> None:
        """Triangulate the other markers from all views, ignoring predictions; accept points that repeat."""
        count = moment.views.used.sum(axis=0)
        index = np.flatnonzero((views == 0) & (count >= 2))
        if not len(index):
            return
        solution, good = self._solve(moment, moment.views.used, index)
        self._counts["behind_cameras"] += int(np.count_nonzero(~solution.in_front))
        self._counts["gated"] += int(np.count_nonzero(~good))
        index, position, covariance = index[good], solution.position[good], solution.covariance[good]
        known = self._states.tracked[index]
        confirmed = self._states.propose(index, position, covariance, moment.t_s)
        moved = confirmed & known
        self._states.accept(
            index[moved],
            position[moved],
            covariance[moved],
            moment.prior.position[index[moved]],
            moment.t_s,
            gated=False,
        )
        views[index[confirmed]] = count[index[confirmed]]

    def _follow(self, moment: _Moment, views: CountArray) -> None:
        """Update the remaining markers with a view inside the gate along the ray of the best view."""
        index = np.flatnonzero(self._states.not_updated(moment.t_s) & moment.plausible.any(axis=0))
        if not len(index):
            return
        best = np.argmin(np.where(moment.plausible, moment.misses, np.inf), axis=0)
        only = moment.plausible & (np.arange(len(moment.plausible))[:, None] == best)
        solution, good = self._solve(moment, only, index)
        index = index[good]
        views[index] = self._states.accept(
            index, solution.position[good], solution.covariance[good], moment.prior.position[index], moment.t_s
        )

    def _solve(self, moment: _Moment, used: BoolArray, index: IndexArray) -> tuple[Solution, BoolArray]:
        """Return the points of markers (K,) from the views used, and which of them (K,) are plausible.

        A plausible point is inside the volume and near its hand, and its views agree.
        """
        prior = Prior(moment.prior.position[index], moment.prior.sigma_m[index])
        solution = self._geometry.solve(Views(moment.views.xy[:, index], used[:, index]), prior, moment.sigma)
        low, high = np.array(self._config.volume_m)
        gate_px = min(1.0 + PAIRED.view_gate_sigmas * self.epipolar.spread_px, max(self._config.epipolar_limit_px, 2.0))
        with np.errstate(invalid="ignore"):
            inside = ((solution.position >= low) & (solution.position <= high)).all(axis=1)
            near = self._hands.near(index, solution.position, self._states.filter.value, self._states.tracked)
        good: BoolArray = inside & near & (solution.residual <= gate_px / self._focal_px)
        return solution, good

    def _make_geometry(self, config: FusionConfig) -> Geometry:
        if config.method == "disparity":
            return DisparityLaw(self._cameras, config.depth_law)
        return Triangulation(self._cameras)


def _one_euro(config: FusionConfig) -> OneEuroSettings:
    return OneEuroSettings(config.min_cutoff_hz, config.beta, config.derivative_cutoff_hz)
