"""Online check of the calibration, from the epipolar residuals of all markers.

The calibration is trusted until the views contradict it: a systematic residual beyond the limit of `rhot doctor`, in
enough views, means that a camera was bumped. This is reported, and from then on the views are corrected by the
estimated residual (`epipolar`), as they are from the start in a rig that was never calibrated.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.camera import CameraModel, rays_meet_ahead
from rhot.quality import epipolar_limit_px
from rhot_fusion.schedule import FrameSchedule
from rhot_fusion.views.epipolar import DEPTH, LONGEST_GAP, ROWS_SHARE, EpipolarModel, Tracks
from rhot_fusion.views.sightings import Sightings

_LEAST_VIEWS = 200.0
"""Pairs of views required for a verdict: five seconds of a hand at eight checks per second; see `epipolar`."""
_CLEAR = 1.5
"""A systematic residual counts as a bump if it is this many times the remaining residual."""
_EVERY_S = 0.125
"""Time between two checks: the camera poses change slowly."""


class CameraAgreement:
    """Checks the views of C cameras and M markers against the calibration.

    Attributes:
        epipolar: the estimated residuals.
        bumped_px: systematic residual if cameras have moved since their calibration, otherwise 0.
    """

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        markers: int,
        limit_px: float,
        calibrated: bool,
        calibrated_p95_px: float | None,
    ) -> None:
        self.epipolar = EpipolarModel(cameras, limit_px)
        self.bumped_px = 0.0
        self._calibrated = calibrated
        self._bump_px = epipolar_limit_px(calibrated_p95_px)
        self._markers = markers
        self._newest: list[deque[Sightings]] = [deque(maxlen=DEPTH) for _ in cameras]
        self._pair = cameras[0], cameras[1]
        self._exchanged = EpipolarModel([cameras[1], cameras[0], *cameras[2:]], limit_px)
        # Recent simultaneous views kept for the question whether two cameras are swapped: five seconds of
        # checks.
        self._shots: deque[tuple[FloatArray, BoolArray]] = deque(maxlen=40)
        self._looks = 0
        self._views = 0.0
        self._looked_s = -math.inf

    def clear(self) -> None:
        """Discard the views; the estimated residuals are kept."""
        for frames in self._newest:
            frames.clear()
        self._looked_s = -math.inf

    @property
    def swapped(self) -> bool:
        """Whether the views of the first two cameras fit the calibration far better when they are exchanged.

        Either their rays then meet in front of the cameras and not behind (all that tells parallel cameras apart), or
        on their epipolar lines and not beside. Their coordinates stay normalised by their own intrinsics, which for
        cameras of one kind are alike.
        """
        if not self._calibrated or self._views < _LEAST_VIEWS:
            return False
        # All shots at once: a service asks every second.
        xy = np.concatenate([xy[:, valid[0] & valid[1]] for xy, valid in self._shots], axis=1)
        if not xy.shape[1]:
            return False
        other = xy[[1, 0, *range(2, len(xy))]]
        if rays_meet_ahead(*self._pair, *xy[:2]).mean() < 0.5 < rays_meet_ahead(*self._pair, *other[:2]).mean():
            return True
        if not self.bumped_px:
            return False
        usual, exchanged = self.epipolar.residual(xy)[1], self._exchanged.residual(other)[1]
        # Two cameras count as swapped if exchanging them leaves less than this share of the residual.
        return bool(np.median(np.abs(exchanged)) < 0.5 * np.median(np.abs(usual)))

    def correct(self, camera: int, xy: FloatArray) -> FloatArray:
        """Return a camera's views (N, 2), normalised units, corrected for its movement since the calibration."""
        if self._calibrated and not self.bumped_px:
            return xy
        return self.epipolar.correct_one(camera, xy)

    def watch(self, sightings: Sightings, schedule: FrameSchedule) -> None:
        """Process a frame's uncorrected views; the schedule must already have been updated with it."""
        self._newest[sightings.camera].append(sightings)
        moment_s, period_s = schedule.common_moment(), schedule.longest_period_s
        # Number of initial checks that an uncalibrated rig makes at every frame, because its views are
        # corrected from the start.
        eager = not self._calibrated and self._looks < 300
        elapsed = moment_s - self._looked_s
        if sightings.camera == 0 or moment_s == -math.inf or elapsed <= (0.5 * period_s if eager else _EVERY_S):
            return
        self._looked_s = moment_s
        self._looks += 1
        shot = self._recent().at(moment_s, ROWS_SHARE * period_s, LONGEST_GAP * period_s)
        if shot.valid[0].any() and shot.valid[1:].any():
            self._views = min(self._views + float((shot.valid[0] & shot.valid[1:]).sum()), 1e6)
            self.epipolar.learn(shot.xy, shot.valid, elapsed if math.isfinite(elapsed) else 0.0)
            self._shots.append((shot.xy, shot.valid))
            self._judge()

    def _recent(self) -> Tracks:
        """Return the tracks of all markers through the newest frames, built on demand because few frames need them."""
        tracks = Tracks(len(self._newest), self._markers)
        for camera, frames in enumerate(self._newest):
            for seen in frames:
                later = seen.times_s > tracks.last_t_s[camera][seen.index]
                # Upper bound of a marker's image speed, normalised units per second.
                tracks.append(camera, seen.index[later], seen.times_s[later], seen.xy[later], 4.0)
        return tracks

    def _judge(self) -> None:
        if not self._calibrated or self._views < _LEAST_VIEWS:
            return
        systematic, remaining = self.epipolar.correction_px, self.epipolar.spread_px
        # Share of the limit below which a reported bump is cleared.
        if systematic > max(self._bump_px, _CLEAR * remaining) or (self.bumped_px and systematic > 0.5 * self._bump_px):
            self.bumped_px = systematic
        else:
            self.bumped_px = 0.0
