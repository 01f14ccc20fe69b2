"""Fusion by filtering: each camera frame updates all markers of a hand, each at its image row's exposure time."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from statistics import fmean
from typing import TYPE_CHECKING

import numpy as np

from rhot.anatomy.hand_proportions import HandMeasures
from rhot.anatomy.markers import PaintedMarker
from rhot.arrays import FloatArray, IndexArray
from rhot.geometry.camera import CameraModel, CameraRig
from rhot.quality import pair_epipolar_p95_px
from rhot_fusion.filter.acquisition import Acquisition, TrackedHand, hands_of, radii_of
from rhot_fusion.filter.agreement import CameraAgreement
from rhot_fusion.filter.paint import Paint, PaintBefore
from rhot_fusion.filter.smoothing.record import outcomes
from rhot_fusion.filter.smoothing.smoother import RecordedFrame
from rhot_fusion.filter.state import ROUND, Innovation, State, Views, pace_squares
from rhot_fusion.filter.systematic import CameraNoise, Systematic, stated_px
from rhot_fusion.filter.tracks import (
    CALIBRATED,
    LOOSE_M,
    LOST_M,
    LOST_PERIODS,
    UNCALIBRATED,
    Track,
    TrackStatus,
    outcome_of,
    within_hand,
)
from rhot_fusion.schedule import FrameSchedule
from rhot_fusion.views.epipolar import EpipolarModel
from rhot_fusion.views.sightings import NOTHING, NOWHERE, HandCoherence, Outcome, Sightings, TrackingLimits, vector

# Paint corrections of the views in a recording, recomputed from the smoothed marker positions.

if TYPE_CHECKING:
    from rhot_fusion.filter.acquisition import TrackedHand

_NEAREST_M = 0.1
"""Lower bound of a marker's depth."""


@dataclass(frozen=True, slots=True)
class PaintCorrection:
    """Recomputes the corrected views of one hand.

    Attributes:
        hand: the hand.
        cameras: of the rig.
        paint: a model of its own, which is cleared at each call.
        variance_of: returns the pixel noise of a camera, normalised units².
        periods_s: frame period of each camera.
        loose_m: a marker's size is learnt only while its standard deviation is below this, metres.
        time_variance: of the time stamps, square seconds.
    """

    hand: TrackedHand
    cameras: Sequence[CameraModel]
    paint: Paint
    variance_of: Callable[[int], float]
    periods_s: Sequence[float]
    loose_m: float
    time_variance: float

    def __call__(self, frames: Sequence[RecordedFrame], states: Sequence[State]) -> list[Views]:
        """Return the corrected views of frames in order of time, given the smoothed states.

        The variance for paint hidden from all cameras is stored in the frames.
        """
        self.paint.clear()
        hand_depths_m = [math.inf for _ in self.cameras]
        views = []
        for frame, state in zip(frames, states, strict=True):
            views.append(self._views(frame, state, hand_depths_m))
            frame.hidden_m2 = np.array([self.paint.hidden_m2(marker) for marker in self.hand.markers])
        return views

    def _views(self, frame: RecordedFrame, state: State, hand_depths_m: list[float]) -> Views:
        """Return a frame's corrected views; updates the hand's depth in its camera, which is kept while unknown."""
        views, local = frame.views, frame.views.index.tolist()
        if not local:
            return views
        camera, alive = self.cameras[frame.camera], state.alive.tolist()
        tips = camera.to_camera(state.mean[0].reshape(-1, 3)).tolist()
        away = [max(z, _NEAREST_M) for _, _, z in tips]
        if any(alive):
            hand_depths_m[frame.camera] = fmean(compress(away, alive))
        depths = [away[k] if alive[k] else hand_depths_m[frame.camera] for k in local]
        well_known = (state.alive & (state.spread_m2 <= self.loose_m**2))[views.index].tolist()
        markers, areas_px = [self.hand.markers[k] for k in local], frame.area_px.tolist()
        period_s = self.periods_s[frame.camera]
        of_paint = areas_px, depths, period_s, well_known, frame.border, frame.skin
        shift, doubt = self.paint.correct(frame.camera, markers, frame.t_s, *of_paint)
        if self.hand.base >= 0 and alive[self.hand.base]:
            roots = self.hand.roots(tips, alive)
            columns = [tips[k] for k in local], [roots[k] for k in local], [self.hand.reach_m[k] for k in local]
            along = np.array(self.paint.along(frame.camera, markers, areas_px, *columns))
            shift = shift + state.alive[views.index][:, None] * along
        variance = (doubt * doubt + self.variance_of(frame.camera))[:, None] * ROUND
        if self.time_variance:
            velocity = state.mean[1].reshape(-1, 3)[views.index]
            variance += self.time_variance * pace_squares(camera, velocity, np.array(depths))
        return replace(views, xy=frame.seen_xy + shift, variance=variance)


class FilterTracker:
    """The `filter` method; see `Tracker`.

    Attributes:
        agreement: online check of the calibration.
        noise: estimated pixel noise of the cameras.
        gates: gate results of each camera's newest frame, by camera: markers, innovations and the gate's slack.
    """

    def __init__(
        self,
        rig: CameraRig,
        markers: Mapping[str, PaintedMarker],
        hand: HandMeasures,
        limits: TrackingLimits,
        counts: Counter[str],
        *,
        record: bool = False,
    ) -> None:
        """Build for a rig; `record` keeps the data that `smoothed` needs.

        Increments `measured`, `refused`, `late_frames`, `too_late`, `gated` and `behind_cameras` of counts.
        """
        self._settings = CALIBRATED if rig.calibrated else UNCALIBRATED
        cameras = self._cameras = list(rig.models)
        self._limits, self._counts, self._count = limits, counts, len(markers)
        self._hands = hands_of(markers, hand, cameras, record=record)
        self._schedule = FrameSchedule([1.0 / rate_hz for rate_hz in rig.rates_hz])
        coherence = HandCoherence(markers, hand.length_m)
        self._acquisition = Acquisition(self._hands, cameras, coherence, self._schedule, limits, self._settings, counts)
        self.noise = CameraNoise(cameras, stated_px(rig.names, rig.quality), rig.calibrated)
        stated = [pair_epipolar_p95_px(rig.quality, a, b) or 0.0 for a, b in rig.pairs()]
        self.agreement = CameraAgreement(
            cameras, self._count, limits.epipolar_limit_px, rig.calibrated, max(stated, default=0.0)
        )
        radii = radii_of(markers, hand)
        calibration_px = float(self.noise.calibration_px.max())
        self._radii, self._paint = radii, Paint(cameras, radii)
        self._systematic = Systematic(cameras, rig.quality, calibration_px, radii)
        self._middle = vector(np.mean([camera.center for camera in cameras], axis=0))
        # Standard deviation of the time stamps of such a rig, seconds: frames are stamped on arrival.
        self._time_variance = 0.0 if rig.calibrated else 0.006**2
        self.gates: dict[int, tuple[IndexArray, Innovation, FloatArray]] = {}
        longest_history = 32
        self._history: deque[tuple[Sightings, list[State], PaintBefore]] = deque(maxlen=longest_history)
        self.clear()

    @property
    def epipolar(self) -> EpipolarModel:
        """Residuals estimated since the cameras were calibrated."""
        return self.agreement.epipolar

    @epipolar.setter
    def epipolar(self, model: EpipolarModel) -> None:
        self.agreement.epipolar = model

    @property
    def tracks(self) -> list[Track]:
        """Tracks of all markers, read-only."""
        return self._acquisition.tracks

    def focal_px(self, camera: int) -> float:
        """Return a camera's focal length, pixels."""
        return float(self._cameras[camera].K[0, 0])

    def configure(self, limits: TrackingLimits) -> None:
        """Change the settings."""
        self._limits = self._acquisition.limits = limits
        self.epipolar.set_limit(limits.epipolar_limit_px)

    def clear(self) -> None:
        """Discard all markers; estimated camera residuals and noise are kept."""
        for hand in self._hands:
            hand.filter.clear()
            if hand.record is not None:
                hand.record.clear()
        self._acquisition.clear()
        # Per camera and marker, the coordinates in its newest frame.
        self._last_xy: list[dict[int, list[float]]] = [{} for _ in self._cameras]
        self._hand_depth: dict[tuple[int, int], float] = {}
        self._history.clear()
        self._schedule.clear()
        self.agreement.clear()
        self._paint.clear()
        self.gates.clear()

    def advance(self, sightings: Sightings) -> Outcome | None:
        """Process one frame; return the markers then, or None while another camera's simultaneous frame is due."""
        self._schedule.arrived(sightings.camera, sightings.t_s)
        self.agreement.watch(sightings, self._schedule)
        sightings = self._without_held(sightings)
        corrected = self.agreement.correct(sightings.camera, sightings.xy)
        self._in_order(sightings if corrected is sightings.xy else sightings.at(corrected))
        moment_s = self._schedule.newest_moment()
        return None if moment_s is None else self.outcome(moment_s)

    def outcome(self, t_s: float) -> Outcome:
        """Return the markers at a time not before the filter's, plus the configured prediction interval."""
        self._acquisition.forget(t_s)
        then_s = t_s + self._limits.predict_s
        # A camera counts as seeing the markers in its newest frame while that frame is fresh.
        newest_s, nobody = zip(self._schedule.newest_s, self._fresh_s(), strict=True), [False] * len(self._cameras)
        since_s = [seen_s if t_s - seen_s <= lasts else math.inf for seen_s, lasts in newest_s]
        position, covariance, shown = [NOWHERE] * self._count, [NOTHING] * self._count, [nobody] * self._count
        for hand in self._hands:
            state = hand.filter.predicted(then_s)
            places = state.mean[0].reshape(-1, 3).tolist()
            for marker, point, own in zip(hand.markers, places, hand.filter.own(state), strict=True):
                track = self.tracks[marker]
                if track.status is TrackStatus.CONFIRMED:
                    position[marker], covariance[marker], shown[marker] = point, own, track.views(since_s)
            known = [marker for marker in hand.markers if self.tracks[marker].status is TrackStatus.CONFIRMED]
            within_hand(position, covariance, known, shown, self._middle, hand.patch)
            for marker in known:
                xx, _, _, yy, _, zz = covariance[marker]
                if xx + yy + zz > LOST_M**2:
                    position[marker] = NOWHERE
        seen = [list(column) for column in zip(*shown, strict=True)]
        rest = self._systematic, self._settings, self.noise.pair_variance
        hidden_m2 = [self._paint.hidden_m2(marker) for marker in range(self._count)]
        outcome = outcome_of(then_s, position, covariance, seen, *rest, hidden_m2)
        self._counts["measured"] += sum(outcome.measured)
        return outcome

    def smoothed(self) -> list[Outcome]:
        """Return the markers at all frames since the last `clear` or call, smoothed over all of them."""
        periods_s = [self._schedule.period_s(camera) for camera in range(len(self._cameras))]
        loose_m, every = LOOSE_M, []
        for hand in self._hands:
            if hand.record is not None:
                paint, variance_of = Paint(self._cameras, self._radii), self.noise.variance
                columns = hand, self._cameras, paint, variance_of, periods_s, loose_m, self._time_variance
                correct = PaintCorrection(*columns)
                every.append((hand.index, hand.patch, hand.record.smoothed(variance_of, self._settings, correct)))
        rest = self._systematic, self._settings, self.noise.pair_variance
        return outcomes(every, self._count, periods_s, *rest, self._middle) if every else []

    def _fresh_s(self) -> list[float]:
        """Return for how long each camera's newest frame (C,) is fresh, seconds."""
        return [
            # A camera counts as seeing a marker while its last observation is no
            # older than the longer of these, frame periods and seconds.
            max(1.5 * self._schedule.period_s(camera), 0.04)
            for camera in range(len(self._cameras))
        ]

    def _without_held(self, sightings: Sightings) -> Sightings:
        """Return a frame without views that exactly repeat the previous position of a moving marker.

        Some capture programs repeat the last position of a lost marker.
        """
        camera, last = self._cameras[sightings.camera], self._last_xy[sightings.camera]
        now = dict(zip(sightings.index.tolist(), sightings.xy.tolist(), strict=True))
        self._last_xy[sightings.camera] = now
        held = np.array([last.get(marker) == xy for marker, xy in now.items()])
        if not held.any():
            return sightings
        for row in np.flatnonzero(held).tolist():
            hand, k = self._acquisition.hand_of[int(sightings.index[row])]
            alive = hand.filter.state.alive
            # An unknown marker is assumed to move with its hand.
            one = np.arange(len(alive)) == k if alive[k] else alive
            if not one.any():
                held[row] = False
                continue
            position, velocity = hand.filter.position[one].mean(axis=0), hand.filter.velocity[one].mean(axis=0)
            depth = max(float(position @ camera.R_camera_rig[2] + camera.t_camera_rig[2]), 0.1)
            pace = camera.R_camera_rig[:2] @ velocity / depth
            # Above this image speed, exactly repeated coordinates are treated as stale data.
            held[row] = float(np.hypot(*pace)) * self.focal_px(sightings.camera) >= 60.0
        return sightings.chosen(~held)

    def _in_order(self, sightings: Sightings) -> None:
        """Process a frame; if newer ones were processed already, roll back and process them again."""
        newer: list[Sightings] = []
        # Frames that arrive later than this after a newer one are discarded, seconds.
        if self._history and self._history[-1][0].t_s - sightings.t_s > 0.06:
            self._counts["too_late"] += 1
            return
        while self._history and self._history[-1][0].t_s > sightings.t_s:
            later, states, paint = self._history.pop()
            newer.append(later)
            self._paint.restore(paint)
            for hand, state in zip(self._hands, states, strict=True):
                # Markers initialised or deleted since then keep their state.
                if (hand.filter.state.alive == state.alive).all():
                    hand.filter.state = state
        self._counts["late_frames"] += bool(newer)
        self._process(sightings)
        for later in reversed(newer):
            self._process(later, again=True)

    def _process(self, sightings: Sightings, *, again: bool = False) -> None:
        """Update the markers with a frame; `again` = it was processed before, only states are recomputed."""
        begun, camera, t_s = self._acquisition.begun, sightings.camera, sightings.t_s
        self._history.append((sightings, [hand.filter.state for hand in self._hands], self._paint.before(camera)))
        variance, period_s = self.noise.variance(camera), self._schedule.period_s(camera)
        loose_m2 = LOOSE_M**2
        for hand in self._hands:
            mine = hand.of(sightings, alone=len(self._hands) == 1)
            markers = mine.index.tolist()
            depths = self._depths(hand, camera, markers)
            # Views that initialise a marker are corrected, too: the cameras see unequal parts of a reappearing marker.
            alive, spread_m2 = hand.filter.state.alive.tolist(), hand.filter.spread_m2
            places = [hand.place_of[marker] for marker in markers]
            known, well_known = [alive[k] for k in places], [alive[k] and spread_m2[k] <= loose_m2 for k in places]
            areas_px = mine.area_px.tolist()
            of_paint = areas_px, depths, period_s, well_known, mine.border, mine.skin
            shift, doubt = self._paint.correct(camera, markers, t_s, *of_paint)
            if hand.record is not None and not again:
                hand.record.add(mine, shift, self._paint.slack(camera, areas_px), doubt * doubt)
            mine, own = mine.at(mine.xy + shift), doubt * doubt + variance
            if again:
                self._update(hand, mine, own, known, again=True)
                continue
            wide = [
                each + self._paint.doubt_back(marker, depth) ** 2
                for marker, depth, each in zip(markers, depths, own.tolist(), strict=True)
            ]
            self._acquisition.add(camera, markers, mine.times_s.tolist(), mine.xy, wide)
            taken = [not self._acquisition.is_free(marker, camera, t_s) for marker in markers]
            self._update(hand, mine, own, taken)
            for marker in markers:
                if self.tracks[marker].accepted_s[camera] != t_s:
                    self._acquisition.try_start(marker, camera, t_s)
        if self._acquisition.begun > begun:
            self._history.clear()

    def _depths(self, hand: TrackedHand, camera: int, markers: Sequence[int]) -> list[float]:
        """Return the depths (N,) of markers in a camera; unknown ones get the current or last depth of their hand."""
        alive = hand.filter.state.alive.tolist()
        depths = [max(depth, 0.1) for _, _, depth in hand.filter.seen_from(self._cameras[camera])]
        if not all(alive):
            key = hand.markers[0], camera
            if any(alive):
                self._hand_depth[key] = fmean(compress(depths, alive))
            of_hand = self._hand_depth.get(key, math.inf)
            depths = [depth if known else of_hand for depth, known in zip(depths, alive, strict=True)]
        return [depths[hand.place_of[marker]] for marker in markers]

    def _update(
        self, hand: TrackedHand, sightings: Sightings, variance: FloatArray, taken: list[bool], *, again: bool = False
    ) -> None:
        """Update a hand's filter with those (N,) of its occlusion-corrected views that are `taken`; see `_process`."""
        if not any(taken):
            return
        if not all(taken):
            chosen = np.array(taken)
            sightings, variance = sightings.chosen(chosen), variance[chosen]
        camera, markers = self._cameras[sightings.camera], sightings.index.tolist()
        places, areas_px = [hand.place_of[marker] for marker in markers], sightings.area_px.tolist()
        local, t_s, xy = np.array(places), max(sightings.t_s, hand.filter.state.t_s), sightings.xy
        if hand.base >= 0 and hand.filter.state.alive[hand.base]:
            tips = hand.filter.seen_from(camera)
            roots = hand.roots(tips, hand.filter.state.alive.tolist())
            # `along` skips views without an area: they are not paint, or the bend of the finger is unknown.
            columns = [tips[k] for k in places], [roots[k] for k in places], [hand.reach_m[k] for k in places]
            xy = xy + self._paint.along(sightings.camera, markers, areas_px, *columns)
        variances = variance[:, None] * ROUND
        if self._time_variance:
            depths = np.array(self._depths(hand, sightings.camera, markers))
            variances += self._time_variance * pace_squares(camera, hand.filter.velocity[local], depths)
        slack = self._paint.slack(sightings.camera, areas_px)
        settings = self._settings
        since_s = sightings.t_s - LOST_PERIODS * self._schedule.longest_period_s
        lost = [not again and self.tracks[marker].accepted_s[sightings.camera] < since_s for marker in markers]
        certain = np.where(lost, settings.reacquisition_gate, settings.inflation_gate)
        views = Views(camera, local, sightings.times_s - t_s, xy, variances, slack, certain)
        innovation, _ = hand.filter.step(t_s, views)
        if again:
            return
        if hand.record is not None:
            hand.record.add_innovation(views, innovation, self.noise.variance(sightings.camera))
        self.noise.learn(sightings.camera, innovation)
        self.gates[sightings.camera] = sightings.index, innovation, slack
        for marker, accepted in zip(markers, innovation.accepted.tolist(), strict=True):
            if accepted:
                self.tracks[marker].accept(sightings.camera, sightings.t_s, settings)
            else:
                self._counts["refused"] += 1
                if self.tracks[marker].status is TrackStatus.TENTATIVE:
                    self._acquisition.end(marker)
