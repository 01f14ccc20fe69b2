"""Blending a reappearing finger into the output: no joint jumps, and visible fingers are not delayed.

When a hidden finger is seen again, its published pose and the new estimate differ by the error of the prediction, and
its first points have the largest errors. For a short time, until both agree, the published pose therefore approaches
the estimate in bounded steps, as does that of a hidden finger; the estimate itself is not affected. While the finger is
seen, its own motion is added to these steps: otherwise the output would lag behind a moving finger.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot_ik.hand.filter.kinematics import HandKinematics

_STEP_M: Final = 0.0058
"""Largest step of a tip's marker, relative to the palm, between two samples; other joints move up to a third further.
A step beyond the true motion was to stay below 10 mm (`rhot evaluate motion`).
"""
_FIRST_M: Final = 0.003
"""The step is also limited to this plus a fifth of what remains, so that the blend starts and ends smoothly."""
_FASTEST_M_S: Final = 1.6
"""A faster motion of a tip relative to the palm is a correction, not motion: 20 rad/s of a finger 80 mm long."""


def with_own_motion(
    kinematics: HandKinematics,
    shown: FloatArray,
    moved: FloatArray,
    led: BoolArray,
    dt_s: float,
) -> FloatArray:
    """Return the last published angles (5, 4), radians, plus the motion of the fingers that are being blended.

    Args:
        kinematics: of the hand.
        shown: (5, 4) radians, last published angles.
        moved: (5, 4) radians, change of the estimate since then.
        led: (5,) fingers that are being blended and whose motion is added.
        dt_s: time since then, seconds.
    """
    own = led & (np.abs(moved).sum(axis=1) * kinematics.reaches <= _FASTEST_M_S * dt_s)
    return np.where(own[:, None], shown + moved, shown)


def blended(
    kinematics: HandKinematics,
    estimated: FloatArray,
    shown: FloatArray,
    left_s: FloatArray,
    dt_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the angles (5, 4) to publish, radians, and the remaining duration of each finger's blend (5,), seconds.

    Args:
        kinematics: of the hand.
        estimated: (5, 4) radians, current estimate.
        shown: (5, 4) radians, last published angles.
        left_s: (5,) remaining duration of each finger's blend, seconds; 0 = none.
        dt_s: time since then, seconds.
    """
    change = estimated - shown
    # Upper bound of the tips' motion; most samples end here, without forward kinematics.
    least_m = _STEP_M + _FASTEST_M_S * dt_s
    if not left_s.any() and (np.abs(change).sum(axis=1) * kinematics.reaches).max() <= least_m:
        return estimated, left_s
    begin, share = kinematics.marker_points(shown.reshape(-1)), np.ones(5)
    way = kinematics.marker_points(estimated.reshape(-1)) - begin
    gap_m = np.sqrt((way * way).sum(-1))
    led: BoolArray = (left_s > 0.0) | (gap_m > least_m)
    if not led.any():
        return estimated, left_s
    # Sample interval for which the next three values hold: two cameras at 30 frames per second. They are scaled
    # up in proportion to longer intervals, so that the duration of a blend stays the same.
    steps = max(1.0, dt_s / (1.0 / 60.0))
    # Added to the limit, per second: a closing hand moves a tip by 0.05 m on the palm in about half a second.
    most_m = steps * np.minimum(_STEP_M, _FIRST_M + 0.2 * gap_m) + 0.05 * dt_s
    for _ in range(2):
        # The path is nonlinear in the angles: steps that are still too long are shortened once more.
        none_m = 1e-9
        shorter = np.minimum(1.0, most_m / np.maximum(np.sqrt((way * way).sum(-1)), none_m))
        if not (led & (shorter < 1.0)).any():
            break
        share *= shorter
        way = kinematics.marker_points((shown + share[:, None] * change).reshape(-1)) - begin
    angles = np.where(led[:, None], shown + share[:, None] * change, estimated)
    # A blend continues until the finger arrives, even after its shortest duration.
    none_s = 1e-9
    left = np.where(share < 1.0, np.maximum(left_s - dt_s, none_s), left_s - dt_s)
    return angles, np.where(led, np.maximum(left, 0.0), 0.0)
