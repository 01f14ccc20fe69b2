"""Fusion by asynchronous filtering: each camera's frame moves the markers when it comes, each marker at its own time.

No frame waits for another camera's, nothing is interpolated and no pair is needed: an observation is a plane's worth of
information about a marker's path at one moment (`motion_bank`). Pairs matter only where a marker is not known yet or
has gone where it was not expected; see `acquisition`.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.geometry.camera import CameraModel
from rhot.messages import HandPose
from rhot.rig import FusionConfig, HandFile, MarkerConfig
from rhot_fusion.filter.acquisition import Acquisition
from rhot_fusion.filter.cap_directions import CapDirections
from rhot_fusion.filter.gates import Gates
from rhot_fusion.filter.innovation import Eye, innovate, pace
from rhot_fusion.filter.motion_bank import MotionBank
from rhot_fusion.filter.output import Showing, ahead_s
from rhot_fusion.filter.path_smoothing import PathRecord, SmoothedPath
from rhot_fusion.filter.presence import Presence
from rhot_fusion.filter.self_calibration import Lessons
from rhot_fusion.schedule import Schedule
from rhot_fusion.views.coherence import HandCoherence
from rhot_fusion.views.epipolar import EpipolarModel
from rhot_fusion.views.sightings import BoolArray, FloatArray, IndexArray, Outcome, Sightings
from rhot_fusion.views.tracks import Tracks

GATE = 16.0
"""Squared innovation of a coordinate, in variances, beyond which an observation is refused: 4 sigma."""
_BACKS = 6.25
"""The same up to which an observation does not only move the marker but backs it: 2.5 sigma."""
SLACK_PX = 1.0
"""Added to the noise in the gate: models of noise and motion are never as good as their figures."""
_SMALLEST_NOISE_PX = 0.06
_BLUR = 2.0
"""Of the variance that an error of time between two views means along the motion, this much counts for each view: more
than half of it, for the error stays the same over several frames."""
_LATE_S = 0.002
"""An observation this much before the newest one is still taken as simultaneous."""
_HISTORY_S = 0.06
"""Frames that come later than this after a newer one of another camera are used for nothing."""
_RESTING_PX_S = 60.0
"""A marker that moves faster through the picture is never twice at the same place to the last digit."""
_FAR_PX = 6.0
"""An observation this far from where it was expected may be another marker's."""


class FilterTracker:
    """The `filter` method; see `Tracker`.

    Attributes:
        gates: what each camera's newest frame said of the tracked markers, by camera.
    """

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        markers: Mapping[str, MarkerConfig],
        hand: HandFile,
        periods_s: Sequence[float],
        config: FusionConfig,
        counts: Counter[str],
        record: bool = False,
    ) -> None:
        """Build from the rig's parts; `record` keeps what `smoothed` needs.

        Of counts it takes `measured`, `refused`, `late_frames`, `gated` and `behind_cameras`.
        """
        self._counts = counts
        self._config = config
        self._R = [camera.R_camera_rig for camera in cameras]
        self._t = [camera.t_camera_rig for camera in cameras]
        self._eyes = [Eye.of(camera) for camera in cameras]
        self._focal_px = float(np.mean([camera.K[0, 0] for camera in cameras]))
        count = len(markers)
        self._presence = Presence(len(cameras), count)
        self._hands = HandCoherence(markers, hand.length_m)
        self._bank = MotionBank(self._hands.company, PathRecord(count) if record else None)
        hands = {side: HandModel.from_file(hand, side) for side in {marker.hand for marker in markers.values()}}
        self._caps = CapDirections(cameras, markers, hands)
        self._schedule = Schedule(list(periods_s))
        self._tracks = Tracks(len(cameras), count)
        self._acquisition = Acquisition(cameras, count, self._hands)
        self.epipolar = EpipolarModel(cameras, config.epipolar_limit_px)
        self._lessons = Lessons(len(cameras), count, self._focal_px)
        # By camera and marker: the place in its newest frame.
        self._raw: list[dict[int, list[float]]] = [{} for _ in cameras]
        self._doubt: FloatArray = np.zeros((len(cameras), count))
        self._showing = Showing(self._bank, self._presence, self._hands, self._caps, self._schedule, counts)
        self.gates: dict[int, Gates] = {}
        self._history: deque[tuple[Sightings, tuple[FloatArray, ...]]] = deque(maxlen=16)

    @property
    def bank(self) -> MotionBank:
        """The filters, to look at."""
        return self._bank

    @property
    def presence(self) -> Presence:
        """Which markers are known, to look at."""
        return self._presence

    @property
    def focal_px(self) -> float:
        """Pixels of a normalised unit."""
        return self._focal_px

    def agreed(self, marker: int) -> int:
        """Return how many times in a row two views have agreed on where a marker is that is not tracked."""
        return self._acquisition.agreed(marker)

    def configure(self, config: FusionConfig) -> None:
        """Change the settings."""
        self._config = config
        self.epipolar.set_limit(config.epipolar_limit_px)

    def learn(self, hand: HandPose) -> None:
        """Take the directions of a hand's fingers."""
        self._caps.learn(hand)

    def smoothed(self) -> list[SmoothedPath]:
        """Return the path of each marker since the last `clear` as later observations show it; none if not recorded."""
        return [] if self._bank.record is None else self._bank.record.smooth()

    def clear(self) -> None:
        """Forget all markers; what was learnt of the cameras stays."""
        self._presence.clear()
        self._bank.clear()
        self._schedule.clear()
        self._tracks.clear()
        self._acquisition.clear()
        self._caps.clear()
        self._showing.clear()
        self.gates.clear()
        for raw in self._raw:
            raw.clear()
        self._doubt[:] = 0.0
        self._lessons.clear()
        self._history.clear()

    def advance(self, sightings: Sightings) -> Outcome | None:
        """Take one frame; return the markers at its moment, or None when another frame of the same moment is due."""
        self._schedule.arrived(sightings.camera, sightings.t_s)
        if self._schedule.newest > sightings.t_s + _LATE_S:
            self._replay(sightings)
            return None
        self._take(sightings)
        moment_s = self._schedule.newest_moment()
        return None if moment_s is None else self._showing.outcome(moment_s, self._config)

    def _replay(self, late: Sightings) -> None:
        """Put a frame that comes after a newer one where it belongs and take the newer ones again."""
        if self._schedule.newest - late.t_s > _HISTORY_S:
            self._counts["too_late"] += 1
            return
        self._counts["late_frames"] += 1
        newer: list[Sightings] = []
        while self._history and self._history[-1][0].t_s > late.t_s:
            sightings, before = self._history.pop()
            newer.append(sightings)
            self._bank.restore(before)
        self._take(late)
        for sightings in reversed(newer):
            self._take(sightings, again=True)

    def _take(self, sightings: Sightings, *, again: bool = False) -> None:
        """Let one frame move the markers."""
        self._history.append((sightings, self._bank.save()))
        camera, index, times = sightings.camera, sightings.index, sightings.times_s
        presence, xy = self._presence, sightings.xy
        shift, doubt = self._caps.correct(sightings, self._bank.mean, presence.tracked)
        middle = xy + shift
        held = [False] * len(index)
        if not again:
            raw = self._raw[camera]
            for row, (marker, place) in enumerate(zip(index.tolist(), xy.tolist(), strict=True)):
                held[row] = raw.get(marker) == place
                raw[marker] = place
            self._doubt[camera, index] = doubt
            self._remember(camera, index, times, middle)
        corrected = self.epipolar.correct_one(camera, middle)
        accepted, backing = presence.tracked[index], np.zeros(len(index), dtype=bool)
        known = np.flatnonzero(accepted)
        if len(known) == len(index) > 0:
            accepted, backing = self._update(camera, index, times, corrected, held, doubt)
        elif len(known):
            repeated = [held[row] for row in known.tolist()]
            accepted[known], backing[known] = self._update(
                camera, index[known], times[known], corrected[known], repeated, doubt[known]
            )
        presence.show(camera, sightings.t_s, index[accepted], index[backing])
        if not accepted.all():
            self._acquire(sightings, index[~accepted])
        if not again and camera > 0:
            self._lessons.learn(self._tracks, presence, self._schedule, self.epipolar)

    def _remember(self, camera: int, index: IndexArray, times: FloatArray, xy: FloatArray) -> None:
        later = times > self._tracks.last_t_s[camera][index]
        late = len(later) - int(np.count_nonzero(later))
        if late:
            self._counts["late_marker"] += late
            index, times, xy = index[later], times[later], xy[later]
        (*_, low_m), (*_, high_m) = self._config.volume_m
        max_rate = self._config.max_speed_m_s / max(0.5 * (low_m + high_m), 0.1)
        self._tracks.append(camera, index, times, xy, max_rate)

    def _update(
        self, camera: int, index: IndexArray, times: FloatArray, xy: FloatArray, held: list[bool], doubt: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Let observations (N, 2) of tracked markers (N,) move their filters.

        Returns:
            Which were accepted, and which of them lie near enough to what was expected to back it.

        Some capture programs repeat the last place of a marker that they lost; what was `held` (N,) like this is
        refused where the marker moves. The `doubt` (N,) is a standard deviation beyond the noise, normalised units.
        """
        bank, eye = self._bank, self._eyes[camera]
        forecast = bank.forecast(index, times)
        mean = forecast.mean.tolist()
        noise = max(self.epipolar.spread_px * 0.7071, _SMALLEST_NOISE_PX) / self._focal_px
        blur = _BLUR * self._lessons.noise.sigma_s**2
        paces = [pace(eye, state) for state in mean]
        variance = [
            (noise * noise + more * more + blur * u * u, blur * u * v, noise * noise + more * more + blur * v * v)
            for more, (u, v) in zip(doubt.tolist(), paces, strict=True)
        ]
        innovation = innovate(mean, forecast.filters, eye, xy.tolist(), variance)
        # Against the models together, with slack, each axis alone.
        spread = (forecast.weight[:, None] @ innovation.S.reshape(len(index), -1, 4))[:, 0, ::3]
        slack = (SLACK_PX / self._focal_px) ** 2
        resting, far = (_RESTING_PX_S / self._focal_px) ** 2, (_FAR_PX / self._focal_px) ** 2
        accepted, backing, doubted = [False] * len(index), [False] * len(index), []
        for row, ((x, y), (xx, yy), (u, v), repeated) in enumerate(
            zip(innovation.y.tolist(), spread.tolist(), paces, held, strict=True)
        ):
            # NaN stays NaN in the sum, and passes no gate.
            ratio = max(x * x / (xx + slack), y * y / (yy + slack)) + 0.0 * (x + y)
            accepted[row] = ratio <= GATE and not (repeated and u * u + v * v >= resting)
            backing[row] = ratio <= _BACKS
            if accepted[row] and x * x + y * y > far:
                doubted.append(row)
        taken = np.array(accepted)
        if doubted:
            taken[doubted] = ~self._belongs_elsewhere(
                camera, index[doubted], xy[doubted], innovation.y[doubted], times[doubted]
            )
        bank.update(index, taken, forecast, innovation)
        self.gates[camera] = Gates(index, times, innovation.y, spread, held, taken)
        self._counts["refused"] += len(index) - int(np.count_nonzero(taken))
        return taken, taken & backing

    def _belongs_elsewhere(
        self, camera: int, index: IndexArray, xy: FloatArray, miss: FloatArray, times: FloatArray
    ) -> BoolArray:
        """Tell which observations (N, 2) lie nearer to where another marker is expected than to their own."""
        local = self._expected(float(times.max())) @ self._R[camera].T + self._t[camera]
        away = xy[:, None] - local[None, :, :2] / np.maximum(local[None, :, 2:], 0.1)
        distance2 = np.where(self._presence.tracked, (away * away).sum(axis=2), np.inf)
        distance2[np.arange(len(index)), index] = np.inf
        nearer: BoolArray = distance2.min(axis=1) < (miss * miss).sum(axis=1)
        return nearer

    def _expected(self, t_s: float) -> FloatArray:
        """Return where tracked markers (M, 3) are expected, metres; the place of others means nothing."""
        bank = self._bank
        elapsed = np.where(self._presence.tracked, np.maximum(t_s - bank.t_s, 0.0), 0.0)
        expected: FloatArray = bank.mean[:, :3] + bank.mean[:, 3:] * ahead_s(elapsed)[:, None]
        return expected

    def _acquire(self, sightings: Sightings, index: IndexArray) -> None:
        """Find markers (N,) that are not known, or not where they were expected, by two views that agree repeatedly."""
        known, tracked = self._expected(sightings.t_s), self._presence.tracked
        found = self._acquisition.propose(
            index, self._tracks, self._doubt, self._schedule, self.epipolar, self._config, known, tracked, self._counts
        )
        if found is None:
            return
        self._bank.start(found.index, found.position, found.covariance, found.t_s)
        for marker in found.index.tolist():
            self._showing.found(marker, elsewhere=bool(tracked[marker]))
        self._presence.find(found.index, found.views, sightings.t_s)
        self._history.clear()
