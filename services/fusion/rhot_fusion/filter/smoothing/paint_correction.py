"""Paint corrections of the views in a recording, recomputed from the smoothed marker positions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from statistics import fmean
from typing import TYPE_CHECKING

import numpy as np

from rhot.geometry.camera import CameraModel
from rhot_fusion.filter.paint import Paint
from rhot_fusion.filter.smoothing.smoother import Frame
from rhot_fusion.filter.state import ROUND, State, Views, pace_squares

if TYPE_CHECKING:
    from rhot_fusion.filter.acquisition import Hand

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

    hand: Hand
    cameras: Sequence[CameraModel]
    paint: Paint
    variance_of: Callable[[int], float]
    periods_s: Sequence[float]
    loose_m: float
    time_variance: float

    def __call__(self, frames: Sequence[Frame], states: Sequence[State]) -> list[Views]:
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

    def _views(self, frame: Frame, state: State, hand_depths_m: list[float]) -> Views:
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
