"""What is shown of the filters' markers: at one moment, no faster than is believable, hidden ones with their hand.

Plain numbers, marker by marker: for a handful of them numpy's calls cost twice what the sums do.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from rhot.rig import FusionConfig
from rhot_fusion.filter.cap_directions import CapDirections
from rhot_fusion.filter.motion_bank import MotionBank
from rhot_fusion.filter.presence import Presence
from rhot_fusion.schedule import Schedule
from rhot_fusion.views.coherence import HandCoherence
from rhot_fusion.views.sightings import FloatArray, Outcome

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
_NOWHERE = [math.nan] * 3


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
        self._count = len(bank.mean)
        self.clear()

    def clear(self) -> None:
        """Forget what was shown."""
        self._shown = [_NOWHERE] * self._count
        self._shown_s = -math.inf
        # Markers on their way to where they are seen.
        self._gliding = [False] * self._count

    def found(self, marker: int, *, elsewhere: bool) -> None:
        """Note that a marker was found, and whether it was shown elsewhere until then."""
        self._gliding[marker] = elsewhere

    def outcome(self, t_s: float, config: FusionConfig) -> Outcome:
        """Return the markers at a moment, or as much later as they are to be predicted."""
        bank, presence = self._bank, self._presence
        views, sure = presence.backing(t_s, self._schedule)
        (left, top, near), (right, bottom, far) = config.volume_m
        for marker, (x, y, z) in enumerate(bank.mean[:, :3].tolist()):
            if not (left <= x <= right and top <= y <= bottom and near <= z <= far):
                presence.tracked[marker] = False
        measured = [here and cameras >= 2 for here, cameras in zip(presence.tracked.tolist(), sure, strict=True)]
        count = sum(measured)
        self._counts["measured"] += count
        if count == len(measured):
            presence.backed_s.fill(t_s)
        else:
            presence.backed_s[measured] = t_s
            presence.tracked &= t_s - presence.backed_s <= config.hold_s
            self._coast(t_s)
        tracked, shape_sigma = presence.tracked.tolist(), self._caps.sigmas()
        longest = config.max_speed_m_s * min(t_s - self._shown_s, self._schedule.longest_period_s)
        shown, sigmas = [_NOWHERE] * self._count, [0.0] * self._count
        for marker, (here, (x, y, z, vx, vy, vz), (sx, sy, sz, su, sv, sw), seen_s, shape) in enumerate(
            zip(tracked, bank.mean.tolist(), bank.variances.tolist(), bank.t_s.tolist(), shape_sigma, strict=True)
        ):
            if not here:
                views[marker] = 0
                self._gliding[marker] = False
                continue
            ahead = t_s - seen_s
            path = config.predict_s - _DAMPING_S * math.expm1(ahead * (-1.0 / _DAMPING_S))
            place = [x + path * vx, y + path * vy, z + path * vz]
            # What was found again elsewhere, or is only predicted, has no haste.
            unsure = self._gliding[marker] or not measured[marker]
            # Depth that is known badly is no reason to jump.
            quiet = min(max(_QUIET_DEPTH_M / (math.sqrt(sz) + 1e-6), _SLOWEST_GLIDE), 1.0)
            shown[marker], fast = _glided(
                self._shown[marker], place, _UNSURE_GLIDE * longest if unsure else longest, quiet * longest
            )
            # On its way to where it is seen a marker is not where it is seen.
            self._gliding[marker] = unsure and fast
            measured[marker] = measured[marker] and not self._gliding[marker]
            sigmas[marker] = math.sqrt(sx + sy + sz + ahead * ahead * (su + sv + sw) + shape * shape)
        self._shown, self._shown_s = shown, t_s
        return Outcome(t_s + config.predict_s, shown, sigmas, views, measured, presence.fresh.tolist(), shape_sigma)

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


def _glided(shown: list[float], place: list[float], longest_m: float, deepest_m: float) -> tuple[list[float], bool]:
    """Let no marker be shown to move faster than is believable, such as when it is found again elsewhere.

    Args:
        shown: where it was shown before, metres; NaN = it was not, and stays where it is.
        place: where it is.
        longest_m: how far it may go.
        deepest_m: how far in depth.

    Returns:
        Where to show it, and whether that is not yet where it is, but for its depth.
    """
    (x0, y0, z0), (x, y, z) = shown, place
    dx, dy, dz = x - x0, y - y0, z - z0
    # NaN compares as false.
    if abs(dz) > deepest_m:
        dz = math.copysign(deepest_m, dz)
        place = [x, y, z0 + dz]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if length > longest_m:
        share = longest_m / length
        return [x0 + share * dx, y0 + share * dy, z0 + share * dz], True
    return place, False
