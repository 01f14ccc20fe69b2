"""The paired methods: evaluate all cameras' tracks at a common time and compute points from them.

The time is as late as the extrapolation of the other cameras' tracks allows; see `schedule` and `tracks`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.rig import FusionConfig, HandFile, MarkerConfig
from rhot_bench.thesis.paired.marker_states import Geometry, MarkerStates, PixelViews, Prior, Solution, Triangulation
from rhot_bench.thesis.paired.one_euro import PAIRED, OneEuroFilter, OneEuroSettings, PairedConfig
from rhot_fusion.schedule import FrameSchedule
from rhot_fusion.views.epipolar import LONGEST_GAP, ROWS_SHARE, EpipolarModel, Snapshot, Tracks
from rhot_fusion.views.sightings import HandCoherence, Outcome, Sightings

# The 1-euro filter as in the 2018 thesis: on each camera's view of each marker, before depth is computed.
#
# The noise of an image position is the same in u and v and at any depth. Smoothing it, with a cut-off in image units,
# also smooths the disparity; depth has a separate filter.


class PixelFilters:
    """1-euro filters of C cameras and M markers; normalised image coordinates and seconds."""

    def __init__(self, focal_px: Sequence[float], markers: int, config: PairedConfig) -> None:
        """Build the filters.

        Args:
            focal_px: of each camera; converts β from pixels to normalised coordinates.
            markers: their number.
            config: `one_euro` and its pixel settings.
        """
        self._focal_px = tuple(focal_px)
        self._filters = [OneEuroFilter(markers, _settings(config, focal)) for focal in self._focal_px]
        self._on = config.options.one_euro == "pixels"

    def configure(self, config: PairedConfig) -> None:
        """Change the settings; the states are kept unless the filters were off."""
        on = config.options.one_euro == "pixels"
        if on and not self._on:
            self.clear()
        self._on = on
        for filters, focal in zip(self._filters, self._focal_px, strict=True):
            filters.settings = _settings(config, focal)

    def clear(self) -> None:
        """Discard all states."""
        for filters in self._filters:
            filters.forget(np.arange(len(filters.value)))

    def smoothed(
        self, camera: int, markers: IndexArray, t_s: FloatArray, xy: FloatArray, max_rate: float
    ) -> FloatArray:
        """Return filtered views (K, 2); unchanged if the filter is off.

        Args:
            camera: index.
            markers: (K,) indices.
            t_s: (K,) times, later than the last ones of these markers.
            xy: (K, 2) normalised coordinates.
            max_rate: highest plausible image speed, normalised units per second; a faster step restarts the filter.
        """
        if not self._on or not len(markers):
            return xy
        filters = self._filters[camera]
        views = np.column_stack([xy, np.zeros(len(xy))])
        step = np.linalg.norm(views - filters.value[markers], axis=1)
        elapsed = t_s - filters.t_s[markers]
        # Markers without a state restart, too: comparisons with NaN are false.
        follows = step <= max_rate * elapsed
        for row in np.flatnonzero(~follows):
            filters.start(markers[row : row + 1], views[row : row + 1], float(t_s[row]))
        if follows.any():
            filters.update(markers[follows], views[follows], t_s[follows][:, None])
        smoothed: FloatArray = filters.value[markers, :2]
        return smoothed


def _settings(config: PairedConfig, focal_px: float) -> OneEuroSettings:
    # β is in hertz per (pixel per second), the filter's speed in normalised units per second.
    return OneEuroSettings(
        config.options.pixel_min_cutoff_hz, config.options.pixel_beta * focal_px, config.options.derivative_cutoff_hz
    )


# Association of views with markers, and triangulation of points.
#
# There are three passes. Markers are measured from views that agree with the prediction and with each other. The
# others are triangulated from all their views without the prediction, and accepted after several consistent points.
# The rest are updated along the ray of their best single view.

# Depth by the empirical law of the 2018 thesis, depth[cm] = k · d^z with the disparity d in pixels.
#
# The disparity is signed, d = u_left − u_right in undistorted pixels, and must be positive; the thesis used its
# absolute value, which does not reveal swapped cameras. The lateral position follows from the pinhole model of the
# reference (first) camera. The law is valid for one pair of parallel cameras: it uses the first two cameras of the
# rig and rotates the rays of the second into the orientation of the first (without a calibration, the rotation is the
# identity).


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

    def solve(self, views: PixelViews, prior: Prior, sigma: float) -> Solution:
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


# Association of views with markers, and triangulation of points.

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
    views: PixelViews
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
        config: PairedConfig,
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
        depth_only = config.options.one_euro == "pixels"
        self._states = MarkerStates(
            len(markers), _one_euro(config), config.options.max_speed_m_s, depth_only=depth_only
        )
        self._last_s = -np.inf
        self.epipolar = EpipolarModel(cameras, config.fusion.epipolar_limit_px)

    def configure(self, config: PairedConfig) -> None:
        """Change the settings; the states are discarded only if the method changes.

        Raises:
            ConfigError: the new method cannot use the cameras; the old settings stay in force.
        """
        self._geometry = self._make_geometry(config)
        if config.fusion.method != self._config.fusion.method:
            self.clear()
        self._config = config
        self.epipolar.set_limit(config.fusion.epipolar_limit_px)
        depth_only = config.options.one_euro == "pixels"
        self._states.configure(_one_euro(config), config.options.max_speed_m_s, depth_only=depth_only)

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
        states.drop(states.tracked & (t_s - states.measured_s > self._config.fusion.hold_s))
        states.coast(self._hands.siblings, t_s)
        position = states.publish(t_s, longest_step_s)
        age = np.where(states.tracked, t_s - states.measured_s, 0.0)
        sigma = np.hypot(states.sigma_m, PAIRED.maneuver_m_s * age)
        columns = (position, sigma, views, measured, moment.views.used)
        return Outcome(t_s, *(column.tolist() for column in columns))

    def _prepare(self, shot: Snapshot, t_s: float) -> _Moment:
        views = PixelViews(self.epipolar.correct(shot.xy), shot.valid & self._geometry.uses[:, None])
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
        solution = self._geometry.solve(PixelViews(moment.views.xy[:, index], used[:, index]), prior, moment.sigma)
        low, high = np.array(self._config.fusion.volume_m)
        gate_px = min(
            1.0 + PAIRED.view_gate_sigmas * self.epipolar.spread_px, max(self._config.fusion.epipolar_limit_px, 2.0)
        )
        with np.errstate(invalid="ignore"):
            inside = ((solution.position >= low) & (solution.position <= high)).all(axis=1)
            near = self._hands.near(index, solution.position, self._states.filter.value, self._states.tracked)
        good: BoolArray = inside & near & (solution.residual <= gate_px / self._focal_px)
        return solution, good

    def _make_geometry(self, config: PairedConfig) -> Geometry:
        if config.fusion.method == "disparity":
            return DisparityLaw(self._cameras, config.options.depth_law)
        return Triangulation(self._cameras)


def _one_euro(config: PairedConfig) -> OneEuroSettings:
    return OneEuroSettings(config.options.min_cutoff_hz, config.options.beta, config.options.derivative_cutoff_hz)


class PairedTracker:
    """Triangulation, or the depth law, of tracks at common times; see `Tracker`."""

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        markers: Mapping[str, MarkerConfig],
        hand: HandFile,
        periods_s: Sequence[float],
        config: FusionConfig,
        counts: Counter[str],
    ) -> None:
        """Build from the rig's parts; increments `measured`, `gated`, `behind_cameras` and `late_marker` of counts.

        Raises:
            ConfigError: the configured method cannot use the cameras.
        """
        self._config = paired = PairedConfig.of(config)
        self._counts = counts
        self._association = Association(cameras, markers, hand.length_m, paired, counts)
        self._schedule = FrameSchedule(list(periods_s))
        self._tracks = Tracks(len(cameras), len(markers))
        self._pixels = PixelFilters([float(camera.K[0, 0]) for camera in cameras], len(markers), paired)
        self._cameras = len(cameras)

    @property
    def epipolar(self) -> EpipolarModel:
        """Estimated epipolar residuals of the cameras."""
        return self._association.epipolar

    @epipolar.setter
    def epipolar(self, model: EpipolarModel) -> None:
        self._association.epipolar = model

    def configure(self, config: FusionConfig) -> None:
        """Change the settings.

        Raises:
            ConfigError: the new method cannot use the cameras; the old settings stay in force.
        """
        paired = PairedConfig.of(config)
        self._association.configure(paired)
        self._config = paired
        self._pixels.configure(paired)

    def clear(self) -> None:
        """Discard all markers; the estimated epipolar residuals are kept."""
        self._schedule.clear()
        self._tracks.clear()
        self._pixels.clear()
        self._association.clear()

    def advance(self, sightings: Sightings) -> Outcome | None:
        """Process a frame; return the markers at the next common time if it was reached."""
        camera, t = sightings.camera, sightings.times_s
        later = t > self._tracks.last_t_s[camera, sightings.index]
        self._counts["late_marker"] += int(np.count_nonzero(~later))
        low, high = self._config.fusion.volume_m
        max_rate = self._config.options.max_speed_m_s / max(0.5 * (low[2] + high[2]), 0.1)
        index, t, xy = sightings.index[later], t[later], sightings.xy[later]
        self._tracks.append(camera, index, t, self._pixels.smoothed(camera, index, t, xy, max_rate), max_rate)
        self._schedule.arrived(camera, sightings.t_s)
        moment_s = self._schedule.moment(self._config.options.extrapolation)
        if moment_s is None:
            return None
        period_s = max(self._schedule.period_s(index) for index in range(self._cameras))
        reach_s = (self._config.options.extrapolation + ROWS_SHARE) * period_s
        shot = self._tracks.at(moment_s, reach_s, LONGEST_GAP * period_s)
        return self._association.advance(shot, moment_s, period_s)
