"""What the views of one moment teach: what the cameras have turned by, and how noisy and how well timed they are."""

from __future__ import annotations

import numpy as np

from rhot_fusion.filter.presence import Presence
from rhot_fusion.filter.timing_noise import TimingNoise
from rhot_fusion.schedule import Schedule
from rhot_fusion.views.epipolar import EpipolarModel
from rhot_fusion.views.sightings import FloatArray
from rhot_fusion.views.tracks import LONGEST_GAP, ROWS_SHARE, Tracks

_FIRST_NOISE_PX = 0.3
_LONGEST_PAIR_S, _LONGEST_PAIR = 0.15, 2.5
"""Moments further apart than this, or this many periods, tell nothing of timing."""
_EAGER, _LESSON_EVERY = 300, 8
"""After so many moments the cameras are known well enough to look only at two in a row of every eight."""


class Lessons:
    """Reads the tracks at moments that all cameras have seen.

    Attributes:
        noise: of the views and of their times.
    """

    def __init__(self, cameras: int, markers: int, focal_px: float) -> None:
        self.noise = TimingNoise(_FIRST_NOISE_PX / focal_px)
        # Of the moment before: (C - 1, M, 2) views less those of the first camera, and (M, 2) those.
        self._pair: tuple[FloatArray, FloatArray] = (
            np.full((cameras - 1, markers, 2), np.nan),
            np.full((markers, 2), np.nan),
        )
        self._count = 0
        self.clear()

    def clear(self) -> None:
        """Begin a new stream; what was learnt stays."""
        self._looked_s = self._learnt_s = -np.inf

    def learn(self, tracks: Tracks, presence: Presence, schedule: Schedule, epipolar: EpipolarModel) -> None:
        """Let the views of the latest common moment teach, unless they have already."""
        moment_s, period_s = schedule.common_moment(), schedule.longest_period_s
        # Once a period is enough, however many cameras there are.
        if moment_s <= self._looked_s + 0.5 * period_s or not np.isfinite(moment_s):
            return
        self._looked_s = moment_s
        self._count += 1
        if self._count > _EAGER and self._count % _LESSON_EVERY > 1:
            return
        shot = tracks.at(moment_s, ROWS_SHARE * period_s, LONGEST_GAP * period_s)
        ok = shot.valid & presence.fresh & presence.tracked
        if ok[0].any() and ok[1:].any():
            epipolar.learn(shot.xy, ok, moment_s - self._learnt_s)
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
            self.noise.learn(0.5 * (jump[:, :, 0] + jump[:, :, 1])[chosen], speed2[chosen])
