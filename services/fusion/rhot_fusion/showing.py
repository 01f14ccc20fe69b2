"""What is shown of the filters' markers: at one moment, no faster than is believable, hidden ones with their hand."""

from __future__ import annotations

from collections import Counter

import numpy as np

from rhot.rig import FusionConfig
from rhot_fusion.cap_directions import CapDirections
from rhot_fusion.coherence import HandCoherence
from rhot_fusion.motion_bank import MotionBank
from rhot_fusion.presence import Presence
from rhot_fusion.schedule import Schedule
from rhot_fusion.sightings import BoolArray, FloatArray, Outcome

_QUIET_DEPTH_M = 0.004
"""Standard deviation in depth up to which a marker is shown as fast as it moves."""
_UNSURE_GLIDE = 0.3
"""Share of the fastest believable speed that a marker is shown to have when it is predicted or was found elsewhere."""
_SLOWEST_GLIDE = 0.08
"""Share of the fastest believable speed that a marker may be shown to have in depth when that is known badly."""
_COAST_S = 0.03
"""A marker that no camera has seen for this long moves with its hand."""
_COAST_M_S = 0.8
"""How much a marker that is carried along may move about its hand, metres per second, one standard deviation."""
_DAMPING_S = 0.1
"""Speeds of markers that are not seen fade within this."""
_FEWEST_SIBLINGS = 2
# A product with ones costs a third of what `sum` does.
_OF_PLACE: FloatArray = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
_OF_SPEED: FloatArray = 1.0 - _OF_PLACE
_ALL: FloatArray = np.ones(3)


def ahead_s(elapsed_s: FloatArray) -> FloatArray:
    """Return for how long a marker is carried on at its last speed when it was last seen `elapsed_s` ago."""
    path: FloatArray = -_DAMPING_S * np.expm1(elapsed_s * (-1.0 / _DAMPING_S))
    return path


class Showing:
    """Makes outcomes of the filters' states."""

    def __init__(
        self,
        bank: MotionBank,
        presence: Presence,
        hands: HandCoherence,
        caps: CapDirections,
        schedule: Schedule,
        counts: Counter[str],
    ) -> None:
        self._bank, self._presence, self._hands = bank, presence, hands
        self._caps, self._schedule, self._counts = caps, schedule, counts
        count = len(bank.mean)
        self._shown: FloatArray = np.full((count, 3), np.nan)
        self._shown_s = -np.inf
        self._volume_m: object = None
        self._volume: FloatArray = np.zeros((2, 3))
        self.gliding = np.zeros(count, dtype=bool)

    def clear(self) -> None:
        """Forget what was shown."""
        self._shown[:] = np.nan
        self._shown_s = -np.inf
        self.gliding[:] = False

    def outcome(self, t_s: float, config: FusionConfig) -> Outcome:
        """Return the markers at a moment, or as much later as they are to be predicted."""
        bank, presence = self._bank, self._presence
        tracked = presence.tracked
        views, sure = presence.backing(t_s, self._schedule)
        if config.volume_m != self._volume_m:
            self._volume_m, self._volume = config.volume_m, np.array(config.volume_m)
        place = bank.mean[:, :3]
        if not ((place >= self._volume[0]) & (place <= self._volume[1])).all():
            tracked &= ((place >= self._volume[0]) & (place <= self._volume[1])).all(axis=1)
        measured = tracked & (sure >= 2)
        presence.backed_s[measured] = t_s
        count = int(np.count_nonzero(measured))
        self._counts["measured"] += count
        if count < len(measured):
            tracked &= t_s - presence.backed_s <= config.hold_s
            self._coast(t_s)
        ahead = np.where(tracked, t_s - bank.t_s, 0.0)
        position = bank.mean[:, 3:] * (ahead_s(ahead) + config.predict_s)[:, None]
        position += bank.mean[:, :3]
        variance = bank.variances @ _OF_PLACE + ahead * ahead * (bank.variances @ _OF_SPEED)
        shape_sigma = self._caps.sigmas()
        if not tracked.all():
            position[~tracked] = np.nan
            views = np.where(tracked, views, 0)
        self._glide(position, measured, t_s, config)
        # On its way to where it is seen a marker is not where it is seen.
        measured &= ~self.gliding
        sigma = np.sqrt(variance + shape_sigma * shape_sigma)
        return Outcome(t_s + config.predict_s, position, sigma, views, measured, presence.fresh.copy(), shape_sigma)

    def _coast(self, t_s: float) -> None:
        """Carry markers that no camera sees along with the others of their hand."""
        bank, tracked, seen_s = self._bank, self._presence.tracked, self._presence.seen_s
        for marker in np.flatnonzero(tracked & (t_s - seen_s > _COAST_S)).tolist():
            others = self._hands.siblings[marker]
            others = others[tracked[others] & (t_s - seen_s[others] <= _COAST_S)]
            dt = t_s - float(bank.t_s[marker])
            if dt <= 0.0:
                continue
            if len(others) >= _FEWEST_SIBLINGS:
                velocity = np.median(bank.mean[others, 3:], axis=0)
            else:
                velocity = bank.mean[marker, 3:] * np.exp(-dt / _DAMPING_S)
            age = t_s - float(seen_s[marker])
            spread = _COAST_M_S * np.sqrt(max(age**2 - (age - dt) ** 2, 0.0))
            bank.carry(marker, velocity * dt, velocity, spread, t_s)

    def _glide(self, position: FloatArray, measured: BoolArray, t_s: float, config: FusionConfig) -> None:
        """Let no marker be shown to move faster than is believable, such as when it is found again elsewhere."""
        step = position - self._shown
        longest = config.max_speed_m_s * min(t_s - self._shown_s, self._schedule.longest_period_s)
        # Depth that is known badly is no reason to jump.
        quiet = _QUIET_DEPTH_M / (np.sqrt(self._bank.variances[:, 2]) + 1e-6)
        deepest = longest * np.minimum(np.maximum(quiet, _SLOWEST_GLIDE), 1.0)
        # NaN, of markers that were not shown before, compares as false and stays.
        held = np.abs(step[:, 2]) > deepest
        if held.any():
            step[held, 2] = np.copysign(deepest, step[:, 2])[held]
            position[held] = self._shown[held] + step[held]
        length = np.sqrt((step * step) @ _ALL)
        # What was found again elsewhere, or is only predicted, has no haste.
        unsure = self.gliding | ~measured
        allowed = np.where(unsure, _UNSURE_GLIDE * longest, longest)
        fast = length > allowed
        self.gliding = unsure & fast
        if fast.any():
            position[fast] = self._shown[fast] + step[fast] * (allowed[fast] / length[fast])[:, None]
        self._shown, self._shown_s = position, t_s
