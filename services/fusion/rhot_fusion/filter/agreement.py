"""Do the cameras still stand as they were calibrated? Watched on the epipolar residuals of all markers while they run.

A calibrated rig is believed until its views contradict it: a systematic residual beyond what `rhot doctor` allows, told
by enough views, is a bump. It is reported, and from then on the views are corrected by what was learnt (`epipolar`), as
those of a rig that was never calibrated are from the start.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel
from rhot.rig.quality import epipolar_limit_px
from rhot_fusion.schedule import Schedule
from rhot_fusion.views.epipolar import EpipolarModel
from rhot_fusion.views.sightings import Sightings
from rhot_fusion.views.tracks import LONGEST_GAP, ROWS_SHARE, Tracks

FloatArray = NDArray[np.float64]

_LEAST_VIEWS = 200.0
"""Pairs of views that a verdict needs: five seconds of a hand, looked at eight times a second; see `epipolar`."""
_CLEAR = 1.5
"""A systematic residual is a bump when it is this many times what remains without it."""
_RELEASED = 0.5
"""Share of the limit below which a bump is over."""
_EAGER_VIEWS = 300
_EVERY = 4
"""After so many moments only one of so many is looked at: what the cameras do changes slowly."""
_MOST_RATE = 4.0
"""No marker moves faster through a picture, normalised units per second."""


class CameraAgreement:
    """Watches the views of C cameras and M markers.

    Attributes:
        epipolar: what was learnt.
        bumped_px: the systematic residual of cameras that have moved since they were calibrated; 0 = they have not.
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
        self._tracks = Tracks(len(cameras), markers)
        self._looked = 0
        self._views = 0.0
        self._looked_s = -np.inf

    def clear(self) -> None:
        """Forget the views; what was learnt of the cameras stays."""
        self._tracks.clear()
        self._looked_s = -np.inf

    def correct(self, camera: int, xy: FloatArray) -> FloatArray:
        """Return views (N, 2) of a camera, normalised units, as they would be if it had not moved."""
        if self._calibrated and not self.bumped_px:
            return xy
        return self.epipolar.correct_one(camera, xy)

    def watch(self, sightings: Sightings, schedule: Schedule) -> None:
        """Take a frame's views, uncorrected, after the schedule did."""
        camera, index, times = sightings.camera, sightings.index, sightings.times_s
        later = times > self._tracks.last_t_s[camera][index]
        if later.all():
            self._tracks.append(camera, index, times, sightings.xy, _MOST_RATE)
        else:
            self._tracks.append(camera, index[later], times[later], sightings.xy[later], _MOST_RATE)
        moment_s, period_s = schedule.common_moment(), schedule.longest_period_s
        if camera == 0 or moment_s <= self._looked_s + 0.5 * period_s or not np.isfinite(moment_s):
            return
        elapsed, self._looked_s = moment_s - self._looked_s, moment_s
        self._looked += 1
        if self._looked > _EAGER_VIEWS and self._looked % _EVERY:
            return
        shot = self._tracks.at(moment_s, ROWS_SHARE * period_s, LONGEST_GAP * period_s)
        if shot.valid[0].any() and shot.valid[1:].any():
            self._views = min(self._views + float((shot.valid[0] & shot.valid[1:]).sum()), 1e6)
            self.epipolar.learn(shot.xy, shot.valid, elapsed if np.isfinite(elapsed) else 0.0)
            self._judge()

    def _judge(self) -> None:
        if not self._calibrated or self._views < _LEAST_VIEWS:
            return
        systematic, remaining = self.epipolar.correction_px, self.epipolar.spread_px
        if systematic > max(self._bump_px, _CLEAR * remaining) or (
            self.bumped_px and systematic > _RELEASED * self._bump_px
        ):
            self.bumped_px = systematic
        else:
            self.bumped_px = 0.0
