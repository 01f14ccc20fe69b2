"""The core of fusion: marker frames in, point sets out."""

from __future__ import annotations

from collections import Counter
from statistics import median

import numpy as np
from numpy.typing import NDArray

from rhot.camera import CameraModel
from rhot.messages import MarkerFrame, Point, PointSet
from rhot.rig import FusionConfig, Rig
from rhot.stage import Output
from rhot_fusion.coherence import HandCoherence
from rhot_fusion.corners import PatchCorners
from rhot_fusion.disparity import DisparityLaw
from rhot_fusion.epipolar import EpipolarModel
from rhot_fusion.guard import StreamGuard
from rhot_fusion.marker_states import MANEUVER_M_S, MarkerStates
from rhot_fusion.one_euro import OneEuroSettings
from rhot_fusion.schedule import Schedule
from rhot_fusion.tracks import Tracks
from rhot_fusion.triangulate import Geometry, Prior, Solution, Triangulation, Views

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]

POINTS_KEY = "rhot/points"
RIG_FRAME = "rig"

_ROW_SPREAD_S = 0.1
"""A marker's own time may differ from its frame's by no more than a read-out takes."""
_GATE_SIGMAS = 5.0


class FusionStage:
    """Turns MarkerFrames of any number of cameras, in any order of arrival, into PointSets in the rig frame.

    Attributes:
        counts: what was ignored, by reason, and `published` sets.
    """

    def __init__(self, rig: Rig) -> None:
        """Build the stage of a rig.

        Raises:
            ConfigError: the rig's cameras cannot be used with the method it asks for.
        """
        self.counts: Counter[str] = Counter()
        self._cameras = {name: CameraModel.from_calibration(camera) for name, camera in rig.cameras.items()}
        self._camera_index = {name: place for place, name in enumerate(self._cameras)}
        self._models = list(self._cameras.values())
        self._markers = tuple(rig.config.markers)
        self._marker_index = {name: place for place, name in enumerate(self._markers)}
        self._centers: FloatArray = np.stack([camera.center for camera in self._models])
        self._focal_px = float(np.mean([camera.K[0, 0] for camera in self._models]))
        self._hands = HandCoherence(rig.config.markers, rig.hand.length_m)
        self._corners = PatchCorners(rig.config.markers, self._models)
        self._config = rig.config.fusion
        self._geometry = self._make_geometry(self._config)
        self._schedule = Schedule([1.0 / camera.rate_hz for camera in rig.config.cameras.values()])
        self._guard = StreamGuard(self._cameras, self.counts)
        self._epipolar = EpipolarModel(self._models, self._config.epipolar_limit_px)
        self._tracks = Tracks(len(self._models), len(self._markers))
        self._states = self._make_states(self._config)
        self._base_ns = 0
        self._last_s = -np.inf

    def configure(self, config: FusionConfig) -> None:
        """Change the settings while running; points go on from where they are.

        Raises:
            ConfigError: the rig's cameras cannot be used with the new method; the old settings stay.
        """
        geometry = self._make_geometry(config)
        restart = config.method != self._config.method
        self._geometry, self._config = geometry, config
        self._epipolar.set_limit(config.epipolar_limit_px)
        if restart:
            self._states = self._make_states(config)
        else:
            self._states.configure(_one_euro(config), config.max_speed_m_s)

    @property
    def epipolar_px(self) -> tuple[float, float]:
        """Mean and 95th percentile of the recent epipolar residuals after the learnt correction, pixels."""
        return self._epipolar.figures_px

    @property
    def problem(self) -> str:
        """What is wrong with the rig as a whole, one sentence; empty when nothing is."""
        behind, solved = self.counts["behind_cameras"], self.counts["measured"]
        if behind > 50 and behind > solved:
            first, second = list(self._cameras)[:2]
            return (
                f"{behind} points lie behind the cameras, {solved} before them: cameras {first} and {second} are "
                "probably swapped; exchange their names or places in rig.toml (and cameras.json)"
            )
        return ""

    def feed(self, message: MarkerFrame) -> list[Output]:
        """Take one frame of one camera; return the point set that became possible by it, if any."""
        verdict = self._guard.judge(message)
        if verdict == "refuse":
            return []
        if verdict == "restart" or not self._base_ns:
            self._restart(message.t_ns)
        camera = self._camera_index[message.camera]
        self._observe(camera, message)
        moment_s = self._schedule.moment(self._config.extrapolation)
        if moment_s is None:
            return []
        points = self._solve(moment_s)
        self.counts["published"] += 1
        t_ns = self._base_ns + round(moment_s * 1e9)
        return [(POINTS_KEY, PointSet(t_ns=t_ns, seq=self.counts["published"] - 1, frame=RIG_FRAME, points=points))]

    def _restart(self, t_ns: int) -> None:
        # One second of room, so that frames of other cameras from just before stay positive times.
        self._base_ns = max(t_ns - 1_000_000_000, 1)
        self._schedule.clear()
        self._tracks.clear()
        self._corners.clear()
        self._states.drop(np.ones(len(self._markers), dtype=bool))
        self._last_s = -np.inf

    def _observe(self, camera: int, frame: MarkerFrame) -> None:
        frame_s = (frame.t_ns - self._base_ns) * 1e-9
        places: list[int] = []
        uv: list[tuple[float, float]] = []
        times: list[float] = []
        for name, marker in frame.markers.items():
            place = self._marker_index.get(name)
            if place is None:
                self.counts["unknown_marker"] += 1
                continue
            t_s = frame_s if marker.t_ns is None else (marker.t_ns - self._base_ns) * 1e-9
            if abs(t_s - frame_s) > _ROW_SPREAD_S:
                self.counts["wrong_marker_time"] += 1
                continue
            places.append(place)
            uv.append((marker.u, marker.v))
            times.append(t_s)
        model = self._models[camera]
        index, pixels, t = np.array(places, dtype=np.intp), np.array(uv).reshape(-1, 2), np.array(times)
        usable = model.contains(pixels) & (t > self._tracks.last_t_s[camera, index])
        self.counts["outside"] += len(usable) - int(usable.sum())
        index, pixels, t = index[usable], pixels[usable], t[usable]
        low, high = self._config.volume_m
        max_rate = self._config.max_speed_m_s / max(0.5 * (low[2] + high[2]), 0.1)
        self._tracks.append(camera, index, t, model.undistort(pixels), max_rate)
        self._corners.observe(camera, frame, frame_s)
        self._schedule.arrived(camera, median(t.tolist()) if len(t) else frame_s)

    def _solve(self, t_s: float) -> dict[str, Point]:
        longest = max(self._schedule.period_s(camera) for camera in range(len(self._models)))
        shot = self._tracks.at(t_s, (self._config.extrapolation + 0.5) * longest, 3.5 * longest)
        views = Views(self._epipolar.correct(shot.xy), shot.valid & self._geometry.uses[:, None])
        predicted = self._states.predict(t_s)
        sigma = max(self._epipolar.spread_px / np.sqrt(2.0), 0.05) / self._focal_px
        misses = self._misses(views, predicted, sigma, t_s)
        plausible = views.used & (misses <= 1.0)
        prior = Prior(predicted, 0.01 + MANEUVER_M_S * np.clip(t_s - self._states.backed_s, 0.0, 1.0))
        measured = self._confirm(views, plausible, prior, sigma, t_s)
        self._reacquire(views, measured, prior, sigma, t_s)
        followed = self._follow(views, plausible, misses, prior, sigma, t_s)
        self._states.backed_s[measured] = t_s
        self.counts["measured"] += int(measured.sum())
        self._epipolar.learn(shot.xy, shot.valid & measured, t_s - self._last_s if np.isfinite(self._last_s) else 0.0)
        self._last_s = t_s
        self._states.drop(self._states.tracked & (t_s - self._states.backed_s > self._config.hold_s))
        self._states.coast(self._hands.siblings, t_s)
        positions = self._states.show(t_s, longest)
        return self._points(positions, t_s, np.where(measured, plausible.sum(axis=0), followed), measured, views.xy)

    def _misses(self, views: Views, predicted: FloatArray, sigma: float, t_s: float) -> FloatArray:
        """Return how far views (C, M) are from where tracked markers are believed to be, in units of the gate."""
        with np.errstate(invalid="ignore"):
            away = views.xy - self._geometry.project(predicted)
            miss = np.hypot(away[:, :, 0], away[:, :, 1])
            direction = predicted - self._centers[:, None]
            distance = np.sqrt((direction * direction).sum(axis=2))
            gate = _GATE_SIGMAS * np.hypot(sigma, self._states.uncertainty_m(t_s) / np.maximum(distance, 0.1))
            misses: FloatArray = miss / (gate + 4.0 / self._focal_px)
        return misses

    def _confirm(self, views: Views, plausible: BoolArray, prior: Prior, sigma: float, t_s: float) -> BoolArray:
        """Measure tracked markers by two views or more that agree with the prediction and each other; return which."""
        measured = np.zeros(len(self._markers), dtype=bool)
        index = np.flatnonzero(self._states.tracked & (plausible.sum(axis=0) >= 2))
        solution = self._solve_some(views, plausible, index, prior, sigma)
        good = self._believable(solution, index)
        index, position, covariance = index[good], solution.position[good], solution.covariance[good]
        measured[index] = self._states.accept(index, position, covariance, prior.position[index], t_s)
        return measured

    def _reacquire(self, views: Views, measured: BoolArray, prior: Prior, sigma: float, t_s: float) -> None:
        """Measure markers that nothing confirmed by all their views, whatever was believed of them, if this repeats."""
        index = np.flatnonzero(~measured & (views.used.sum(axis=0) >= 2))
        if not len(index):
            return
        solution = self._solve_some(views, views.used, index, prior, sigma)
        self.counts["behind_cameras"] += int(np.count_nonzero(~solution.in_front))
        good = self._believable(solution, index)
        self.counts["gated"] += len(index) - int(good.sum())
        index, position, covariance = index[good], solution.position[good], solution.covariance[good]
        known = self._states.tracked[index]
        confirmed = self._states.propose(index, position, covariance, t_s)
        moved = confirmed & known
        self._states.accept(
            index[moved], position[moved], covariance[moved], prior.position[index[moved]], t_s, gated=False
        )
        measured[index[confirmed]] = True

    def _follow(
        self, views: Views, plausible: BoolArray, misses: FloatArray, prior: Prior, sigma: float, t_s: float
    ) -> NDArray[np.int_]:
        """Move markers that are still where they were along their best view's ray; return views used (M,), 0 or 1."""
        followed = np.zeros(len(self._markers), dtype=np.int64)
        index = np.flatnonzero(self._states.still_to_move(t_s) & plausible.any(axis=0))
        if not len(index):
            return followed
        best = np.argmin(np.where(plausible, misses, np.inf), axis=0)
        only = plausible & (np.arange(len(plausible))[:, None] == best)
        solution = self._solve_some(views, only, index, prior, sigma)
        good = self._believable(solution, index)
        index, position, covariance = index[good], solution.position[good], solution.covariance[good]
        followed[index] = self._states.accept(index, position, covariance, prior.position[index], t_s)
        return followed

    def _solve_some(self, views: Views, used: BoolArray, index: IndexArray, prior: Prior, sigma: float) -> Solution:
        """Return the points of some markers (K,)."""
        return self._geometry.solve(
            Views(views.xy[:, index], used[:, index]), Prior(prior.position[index], prior.sigma_m[index]), sigma
        )

    def _believable(self, solution: Solution, index: IndexArray) -> BoolArray:
        """Tell which points (K,) of markers (K,) lie in the volume, near their hand, and are agreed upon by views."""
        low, high = np.array(self._config.volume_m)
        gate_px = min(1.0 + _GATE_SIGMAS * self._epipolar.spread_px, self._config.epipolar_limit_px)
        with np.errstate(invalid="ignore"):
            inside = ((solution.position >= low) & (solution.position <= high)).all(axis=1)
            near = self._hands.near(index, solution.position, self._states.filter.value, self._states.tracked)
        believable: BoolArray = inside & near & (solution.residual <= gate_px / self._focal_px)
        return believable

    def _points(
        self, positions: FloatArray, t_s: float, views: NDArray[np.int_], measured: BoolArray, xy: FloatArray
    ) -> dict[str, Point]:
        age = t_s - self._states.backed_s
        points: dict[str, Point] = {}
        for index in np.flatnonzero(self._states.tracked).tolist():
            position = (float(positions[index, 0]), float(positions[index, 1]), float(positions[index, 2]))
            sigma = float(np.hypot(self._states.sigma_m[index], MANEUVER_M_S * age[index]))
            name = self._markers[index]
            points[name] = Point(
                position=position,
                sigma=min(sigma, 1e3),
                views=int(views[index]),
                state="measured" if measured[index] else "predicted",
                corners=self._corners.solve(name, xy[:, index], positions[index], t_s) if measured[index] else None,
            )
        return points

    def _make_geometry(self, config: FusionConfig) -> Geometry:
        if config.method == "disparity":
            return DisparityLaw(self._models, config.depth_law)
        return Triangulation(self._models)

    def _make_states(self, config: FusionConfig) -> MarkerStates:
        return MarkerStates(len(self._markers), _one_euro(config), config.max_speed_m_s)


def _one_euro(config: FusionConfig) -> OneEuroSettings:
    return OneEuroSettings(config.min_cutoff_hz, config.beta, config.derivative_cutoff_hz)
