"""What is shown of the filters' markers: at one moment, no faster than is believable, hidden ones with their hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from rhot.camera import CameraModel
from rhot.rig import FusionConfig
from rhot_fusion.cap_directions import CapDirections
from rhot_fusion.coherence import HandCoherence
from rhot_fusion.motion_bank import MotionBank
from rhot_fusion.presence import Presence
from rhot_fusion.schedule import Schedule
from rhot_fusion.sightings import FloatArray, Outcome

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


def ahead_s(elapsed_s: FloatArray) -> FloatArray:
    """Return for how long a marker is carried on at its last speed when it was last seen `elapsed_s` ago."""
    path: FloatArray = -_DAMPING_S * np.expm1(elapsed_s * (-1.0 / _DAMPING_S))
    return path


class Showing:
    """Makes outcomes of the filters' states."""

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        bank: MotionBank,
        presence: Presence,
        hands: HandCoherence,
        caps: CapDirections,
        schedule: Schedule,
        counts: Counter[str],
    ) -> None:
        self._R: FloatArray = np.stack([camera.R_camera_rig for camera in cameras])
        self._t: FloatArray = np.stack([camera.t_camera_rig for camera in cameras])
        self._bank, self._presence, self._hands = bank, presence, hands
        self._caps, self._schedule, self._counts = caps, schedule, counts
        count = len(bank.mean)
        self._shown: FloatArray = np.full((count, 3), np.nan)
        self._shown_s = -np.inf
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
        reach = presence.reach(t_s, self._schedule)
        views = (presence.fresh & reach).sum(axis=0)
        low, high = config.volume_m
        place = bank.mean[:, :3]
        tracked &= ((place >= low) & (place <= high)).all(axis=1)
        measured = tracked & ((presence.sure & reach).sum(axis=0) >= 2)
        presence.backed_s[measured] = t_s
        self._counts["measured"] += int(np.count_nonzero(measured))
        if not measured.all():
            tracked &= t_s - presence.backed_s <= config.hold_s
            self._coast(t_s)
        ahead = np.where(tracked, t_s - bank.t_s, 0.0)
        position = place + bank.mean[:, 3:] * (ahead_s(ahead) + config.predict_s)[:, None]
        spread = np.einsum("mii->mi", bank.cov)
        variance = spread[:, :3].sum(axis=1) + ahead * ahead * spread[:, 3:].sum(axis=1)
        shape_sigma = self._caps.sigmas()
        position[~tracked] = np.nan
        self._glide(position, t_s, config)
        sigma = np.sqrt(variance + shape_sigma**2)
        local = position @ self._R.swapaxes(1, 2) + self._t[:, None]
        xy = np.where(presence.fresh[:, :, None], local[:, :, :2] / local[:, :, 2:], np.nan)
        return Outcome(t_s + config.predict_s, position, sigma, np.where(tracked, views, 0), measured, xy, shape_sigma)

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

    def _glide(self, position: FloatArray, t_s: float, config: FusionConfig) -> None:
        """Let no marker be shown to move faster than is believable, such as when it is found again elsewhere."""
        step = position - self._shown
        longest = config.max_speed_m_s * min(t_s - self._shown_s, self._schedule.longest_period_s)
        # Depth that is known badly is no reason to jump.
        depth_sigma = np.sqrt(self._bank.cov[:, 2, 2])
        deepest = longest * np.minimum(np.maximum(_QUIET_DEPTH_M / (depth_sigma + 1e-6), _SLOWEST_GLIDE), 1.0)
        # NaN, of markers that were not shown before, compares as false and stays.
        depth = np.maximum(np.minimum(step[:, 2], deepest), -deepest)
        held = depth != step[:, 2]
        held &= np.isfinite(depth)
        if held.any():
            step[held, 2] = depth[held]
            position[held] = self._shown[held] + step[held]
        length = np.sqrt((step * step).sum(axis=1))
        # What was found again elsewhere, or is only predicted, has no haste.
        unsure = self.gliding | (self._presence.seen_s < t_s - _COAST_S)
        allowed = np.where(unsure, _UNSURE_GLIDE * longest, longest)
        fast = length > allowed
        self.gliding &= fast
        if fast.any():
            position[fast] = self._shown[fast] + step[fast] * (allowed[fast] / length[fast])[:, None]
        self._shown, self._shown_s = position.copy(), t_s
