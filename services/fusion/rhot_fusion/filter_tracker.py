"""Fusion by asynchronous filtering: each camera's frame moves the markers when it comes, each marker at its own time.

No frame waits for another camera's, nothing is interpolated and no pair is needed: an observation is a plane's worth of
information about a marker's path at one moment (`motion_bank`). Pairs matter only where a marker is not known yet or
has gone where it was not expected; see `acquisition`.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence

import numpy as np

from rhot.camera import CameraModel
from rhot.hand import HandModel
from rhot.messages import HandPose
from rhot.rig import FusionConfig, HandFile, MarkerConfig
from rhot_fusion.acquisition import Acquisition
from rhot_fusion.cap_directions import CapDirections
from rhot_fusion.coherence import HandCoherence
from rhot_fusion.epipolar import EpipolarModel
from rhot_fusion.gates import Gates
from rhot_fusion.motion_bank import MotionBank, innovate
from rhot_fusion.path_smoothing import PathRecord, SmoothedPath
from rhot_fusion.presence import Presence
from rhot_fusion.schedule import Schedule
from rhot_fusion.showing import Showing, ahead_s
from rhot_fusion.sightings import BoolArray, FloatArray, IndexArray, Outcome, Sightings
from rhot_fusion.timing_noise import TimingNoise
from rhot_fusion.tracks import LONGEST_GAP, ROWS_SHARE, Tracks

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
_FIRST_NOISE_PX = 0.3
_LONGEST_PAIR_S, _LONGEST_PAIR = 0.15, 2.5
"""Moments further apart than this, or this many periods, tell nothing of timing."""
_EAGER, _LESSON_EVERY = 300, 8
"""After so many moments the cameras are known well enough to look only at two in a row of every eight."""
_LATE_S = 0.002
"""An observation this much before the newest one is still taken as simultaneous."""
_HISTORY_S = 0.06
"""Frames that come later than this after a newer one of another camera are used for nothing."""
_RESTING_PX_S = 60.0
"""A marker that moves faster through the picture is never twice at the same place to the last digit."""
_EYE: FloatArray = np.eye(2)
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
        self._across = [np.ascontiguousarray(camera.R_camera_rig[:2].T) for camera in cameras]
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
        self._noise = TimingNoise(_FIRST_NOISE_PX / self._focal_px)
        self._pair = (np.full((len(cameras) - 1, count, 2), np.nan), np.full((count, 2), np.nan))
        self._looked_s = self._learnt_s = -np.inf
        self._lessons = 0
        self._raw: FloatArray = np.full((len(cameras), count, 2), np.nan)
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
        self._raw[:] = np.nan
        self._doubt[:] = 0.0
        self._looked_s = self._learnt_s = -np.inf
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
        rows = slice(None) if len(index) == len(presence.tracked) else index
        held = np.zeros(len(index), dtype=bool)
        if not again:
            raw = self._raw[camera]
            held = (xy[:, 0] == raw[rows, 0]) & (xy[:, 1] == raw[rows, 1])
            raw[rows] = xy
            self._doubt[camera, rows] = doubt
            self._remember(camera, index, times, middle)
        corrected = self.epipolar.correct_one(camera, middle)
        accepted, backing = presence.tracked[index], np.zeros(len(index), dtype=bool)
        known = np.flatnonzero(accepted)
        if len(known) == len(index) > 0:
            accepted, backing = self._update(camera, index, times, corrected, held, doubt)
        elif len(known):
            accepted[known], backing[known] = self._update(
                camera, index[known], times[known], corrected[known], held[known], doubt[known]
            )
        presence.show(camera, sightings.t_s, index[accepted], index[backing])
        if not accepted.all():
            self._acquire(sightings, index[~accepted])
        if not again and camera > 0:
            self._learn()

    def _remember(self, camera: int, index: IndexArray, times: FloatArray, xy: FloatArray) -> None:
        later = times > self._tracks.last_t_s[camera][index]
        if not later.all():
            self._counts["late_marker"] += int(np.count_nonzero(~later))
            index, times, xy = index[later], times[later], xy[later]
        (*_, low_m), (*_, high_m) = self._config.volume_m
        max_rate = self._config.max_speed_m_s / max(0.5 * (low_m + high_m), 0.1)
        self._tracks.append(camera, index, times, xy, max_rate)

    def _update(
        self, camera: int, index: IndexArray, times: FloatArray, xy: FloatArray, held: BoolArray, doubt: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Let observations (N, 2) of tracked markers (N,) move their filters.

        Returns:
            Which were accepted, and which of them lie near enough to what was expected to back it.

        Some capture programs repeat the last place of a marker that they lost; what was `held` (N,) like this is
        refused where the marker moves. The `doubt` (N,) is a standard deviation beyond the noise, normalised units.
        """
        bank = self._bank
        forecast = bank.forecast(index, times)
        noise = max(self.epipolar.spread_px * 0.7071, _SMALLEST_NOISE_PX) / self._focal_px
        w = forecast.mean[:, 3:] @ self._across[camera] / np.maximum(forecast.mean[:, 2:3], 0.1)
        smear = (_BLUR**0.5 * self._noise.sigma_s) * w
        variance = (noise * noise + doubt * doubt)[:, None, None] * _EYE + smear[:, :, None] * smear[:, None]
        innovation = innovate(forecast, self._R[camera], self._t[camera], xy, variance)
        # Against the models together, with slack, each axis alone.
        y = innovation.y
        spread = (forecast.weight[:, None] @ innovation.S.reshape(len(index), -1, 4))[:, 0, ::3]
        size = y * y
        ratio = np.maximum.reduce(size / (spread + (SLACK_PX / self._focal_px) ** 2), axis=1)
        accepted: BoolArray = ratio <= GATE
        if held.any():
            accepted &= ~held | ((w * w).sum(axis=1) < (_RESTING_PX_S / self._focal_px) ** 2)
        if 2.0 * size.max() > (_FAR_PX / self._focal_px) ** 2:
            far = accepted & (size[:, 0] + size[:, 1] > (_FAR_PX / self._focal_px) ** 2)
            accepted[far] = ~self._belongs_elsewhere(camera, index[far], xy[far], y[far], times[far])
        bank.update(index, accepted, forecast, innovation)
        self.gates[camera] = Gates(index, times, y, spread, held, accepted)
        self._counts["refused"] += len(index) - int(np.count_nonzero(accepted))
        return accepted, accepted & (ratio <= _BACKS)

    def _belongs_elsewhere(
        self, camera: int, index: IndexArray, xy: FloatArray, miss: FloatArray, times: FloatArray
    ) -> BoolArray:
        """Tell which observations (N, 2) lie nearer to where another marker is expected than to their own."""
        if not len(index):
            return np.zeros(0, dtype=bool)
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
        self._showing.gliding[found.index] = tracked[found.index]
        self._presence.find(found.index, found.views, sightings.t_s)
        self._history.clear()

    def _learn(self) -> None:
        """Let the views of one moment teach what the cameras have turned by and how noisy they are."""
        moment_s, period_s = self._schedule.common_moment(), self._schedule.longest_period_s
        # Once a period is enough, however many cameras there are.
        if moment_s <= self._looked_s + 0.5 * period_s or not np.isfinite(moment_s):
            return
        self._looked_s = moment_s
        self._lessons += 1
        if self._lessons > _EAGER and self._lessons % _LESSON_EVERY > 1:
            return
        shot = self._tracks.at(moment_s, ROWS_SHARE * period_s, LONGEST_GAP * period_s)
        ok = shot.valid & self._presence.fresh & self._presence.tracked
        if ok[0].any() and ok[1:].any():
            self.epipolar.learn(shot.xy, ok, moment_s - self._learnt_s)
        elapsed = moment_s - self._learnt_s
        self._learnt_s = moment_s
        offset, place = shot.xy[1:] - shot.xy[0], shot.xy[0]
        before_offset, before_place = self._pair
        self._pair = (offset, place)
        if elapsed < min(_LONGEST_PAIR_S, _LONGEST_PAIR * period_s):
            jump, way = offset - before_offset, (place - before_place) / elapsed
            chosen = ok[0] & ok[1:] & np.isfinite(jump[:, :, 0])
            jump *= jump
            way *= way
            speed2 = np.broadcast_to(way[:, 0] + way[:, 1], chosen.shape)
            self._noise.learn(0.5 * (jump[:, :, 0] + jump[:, :, 1])[chosen], speed2[chosen])
