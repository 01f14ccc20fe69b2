"""Which part of a recording shows the hand flat and which the fingers straight, and what a live one asks for when."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.errors import CalibrationError
from rhot_calibration.hand.samples.samples import HandSamples

FLAT_S: Final = 0.5
"""A hand has to be flat for this long to be found flat."""
FLAT_STILL_M: Final = 0.004
"""Largest standard deviation of a flat hand's reach."""
FEWEST_FLAT: Final = 8
_SAME_REACH_M: Final = 0.0025
"""Per finger: reaches within this of the greatest belong to the flat hand."""
_SMOOTH_S: Final = 0.8
STRAIGHT_SHARE: Final = 0.8
"""Of the samples of a stretch, so many show straight fingers if it is a stretch of straight fingers."""
_FEWEST_FINGERS: Final = 3


@dataclass(frozen=True, slots=True)
class Window:
    """A stretch of a recording, seconds from its first sample."""

    start_s: float
    end_s: float

    def holds(self, seconds: FloatArray) -> BoolArray:
        """Return which of the times (N,) lie in it."""
        inside: BoolArray = np.asarray((seconds >= self.start_s) & (seconds <= self.end_s))
        return inside


@dataclass(frozen=True, slots=True)
class Phases:
    """When a recording shows what, as somebody says; None = to be found."""

    flat: Window | None = None
    knuckles: Window | None = None


FIND_PHASES: Final = Phases()
_PROMPTS: Final = (
    (0.0, 4.0, "get ready: back of the hand to the cameras, fingers straight, a little spread"),
    (4.0, 7.0, "hold the hand flat and still"),
    (7.0, 9.0, "get ready: bend at the knuckles only, fingers kept straight"),
    (9.0, 19.0, "knuckles: straight fingers down as far as they go and up again, three times"),
    (19.0, 21.0, "get ready: bend everything"),
    (21.0, 27.0, "bend the fingers freely, fist and open"),
)
"""Seconds from and to, and what to do meanwhile."""
LIVE_PHASES: Final = Phases(flat=Window(4.3, 7.0), knuckles=Window(9.0, 19.5))
LIVE_S: Final = _PROMPTS[-1][1]


def prompt_at(passed_s: float) -> tuple[float, str]:
    """Return how long it lasts still, seconds, and what to do, so many seconds after the start."""
    _, end_s, doing = next(one for one in reversed(_PROMPTS) if passed_s >= one[0])
    return end_s - passed_s, doing


def reaches(samples: HandSamples) -> FloatArray:
    """Return the distances (N, 5), metres, of fingertips from the base marker; NaN = not seen."""
    found: FloatArray = np.linalg.norm(samples.tips - samples.base[:, None], axis=2)
    return found


def find_flat(samples: HandSamples, steady: bool = True) -> Window:
    """Return the half second in which the four fingers together reach furthest and are still, widened while they do.

    Args:
        samples: the markers.
        steady: whether a flat hand has to be still; otherwise the least restless of the far reaches serves.

    Raises:
        CalibrationError: there is none.
    """
    seconds = samples.seconds
    sums = reaches(samples)[:, 1:].sum(axis=1)
    usable = np.flatnonzero(np.isfinite(sums))
    t, reach = seconds[usable], sums[usable]
    last: list[int] = np.searchsorted(t, t + FLAT_S).tolist()
    best, place = -np.inf, -1
    most_restless = 4.0 * FLAT_STILL_M if steady else np.inf
    for a, b in enumerate(last):
        if b >= len(t) or b - a < FEWEST_FLAT:
            continue
        window = reach[a:b]
        middle = float(np.median(window))
        spread = 1.4826 * float(np.median(np.abs(window - middle)))
        if spread <= most_restless and middle - 2.0 * spread > best:
            best, place = middle - 2.0 * spread, a
    if place < 0:
        raise CalibrationError(
            f"the hand was never seen flat and still for {FLAT_S:g} s with all four fingertips; start the recording "
            "with 3 s of the flat hand, fingers straight and a little spread, or say when that was: --flat START-END"
        )
    level = float(np.median(reach[place : last[place]])) - 4.0 * _SAME_REACH_M
    low, high = place, last[place] - 1
    ahead = np.array([np.median(reach[max(k - 3, 0) : k + 4]) for k in range(len(reach))]) >= level
    while low > 0 and ahead[low - 1]:
        low -= 1
    while high + 1 < len(t) and ahead[high + 1]:
        high += 1
    return Window(float(t[low]), float(t[high]))


def straight_stretch(seconds: FloatArray, deficit: FloatArray, limit_m: float, flat: Window) -> Window:
    """Return the longest stretch in which the fingers' tips stay on their spheres, or the flat one if none is longer.

    Args:
        seconds: (N,) times.
        deficit: (N, 4) metres by which the four fingers fall short of being straight; NaN = not seen.
        limit_m: so much is still straight.
        flat: where they are straight for sure.
    """
    seen = np.isfinite(deficit)
    with np.errstate(invalid="ignore"):
        off = (np.abs(deficit) > limit_m).sum(axis=1)
    good = (off == 0) & (seen.sum(axis=1) >= _FEWEST_FINGERS)
    judged = np.flatnonzero(seen.sum(axis=1) >= _FEWEST_FINGERS)
    t, ok = seconds[judged], good[judged].astype(np.float64)
    total = np.concatenate([[0.0], np.cumsum(ok)])
    low, high = np.searchsorted(t, t - _SMOOTH_S / 2.0), np.searchsorted(t, t + _SMOOTH_S / 2.0, side="right")
    straight = (total[high] - total[low]) / np.maximum(high - low, 1) >= STRAIGHT_SHARE
    best = flat
    start: float | None = None
    for k, one in enumerate(straight):
        if one and start is None:
            start = float(t[k])
        if start is not None and (not one or k == len(straight) - 1):
            if float(t[k]) - start > best.end_s - best.start_s:
                best = Window(start, float(t[k]))
            start = None
    return best
