"""Blending a reappearing finger into the output: no joint jumps, and visible fingers are not delayed.

When a hidden finger is seen again, its published pose and the new estimate differ by the error of the prediction, and
its first points have the largest errors. For a short time, until both agree, the published pose therefore approaches
the estimate in bounded steps, as does that of a hidden finger; the estimate itself is not affected. While the finger is
seen, its own motion is added to these steps: otherwise the output would lag behind a moving finger.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot_ik.hand.filter.kinematics import HandKinematics


@dataclass(frozen=True, slots=True)
class BlendSettings:
    """Parameters of the blend from a prediction to a measured finger.

    Attributes:
        usual_s: sample interval for which the next three values hold: two cameras at 30 frames per second. They are
            scaled up in proportion to longer intervals, so that the duration of a blend stays the same.
        step_m: largest step of a tip's marker, relative to the palm, between two samples; other joints move up to a
            third further. A step beyond the true motion was to stay below 10 mm (`rhot evaluate motion`).
        first_m, share: the step is also limited to `first_m` plus this share of the remaining distance, so that the
            blend starts and ends smoothly.
        speed_m_s: added to the limit, per second: a closing hand moves a tip by 0.05 m on the palm in about half a
            second.
        lasts_s: shortest duration of a blend: until fusion has converged on a marker that has reappeared.
        settles_s, known_m: the motion of a finger is added to the blend once the finger has been seen for this long
            with the standard deviation of its marker below `known_m` (root of the trace of its covariance); before,
            changes of the estimate are convergence, not motion. Half of the points that are known worse are over 45 mm
            off (fast hands of `rhot evaluate motion`, 30 fps, develop seeds 0 to 29).
        fastest_m_s: a faster motion of a tip relative to the palm is a correction, not motion: 20 rad/s of a finger
            80 mm long.
        well_measured_m: a marker with a larger standard deviation (as for `known_m`) counts as not yet reappeared:
            only one camera sees it.
    """

    usual_s: float = 1.0 / 60.0
    step_m: float = 0.0058
    first_m: float = 0.003
    share: float = 0.2
    speed_m_s: float = 0.05
    lasts_s: float = 0.1
    settles_s: float = 0.025
    known_m: float = 0.04
    fastest_m_s: float = 1.6
    well_measured_m: float = 0.01


def with_own_motion(
    kinematics: HandKinematics,
    shown: FloatArray,
    moved: FloatArray,
    led: BoolArray,
    dt_s: float,
    settings: BlendSettings,
) -> FloatArray:
    """Return the last published angles (5, 4), radians, plus the motion of the fingers that are being blended.

    Args:
        kinematics: of the hand.
        shown: (5, 4) radians, last published angles.
        moved: (5, 4) radians, change of the estimate since then.
        led: (5,) fingers that are being blended and whose motion is added.
        dt_s: time since then, seconds.
        settings: greatest speed of a finger.
    """
    own = led & (np.abs(moved).sum(axis=1) * kinematics.reaches <= settings.fastest_m_s * dt_s)
    return np.where(own[:, None], shown + moved, shown)


def blended(
    kinematics: HandKinematics,
    estimated: FloatArray,
    shown: FloatArray,
    left_s: FloatArray,
    dt_s: float,
    settings: BlendSettings,
) -> tuple[FloatArray, FloatArray]:
    """Return the angles (5, 4) to publish, radians, and the remaining duration of each finger's blend (5,), seconds.

    Args:
        kinematics: of the hand.
        estimated: (5, 4) radians, current estimate.
        shown: (5, 4) radians, last published angles.
        left_s: (5,) remaining duration of each finger's blend, seconds; 0 = none.
        dt_s: time since then, seconds.
        settings: of the blend.
    """
    change = estimated - shown
    # Upper bound of the tips' motion; most samples end here, without forward kinematics.
    least_m = settings.step_m + settings.fastest_m_s * dt_s
    if not left_s.any() and (np.abs(change).sum(axis=1) * kinematics.reaches).max() <= least_m:
        return estimated, left_s
    begin, share = kinematics.marker_points(shown.reshape(-1)), np.ones(5)
    way = kinematics.marker_points(estimated.reshape(-1)) - begin
    gap_m = np.sqrt((way * way).sum(-1))
    led: BoolArray = (left_s > 0.0) | (gap_m > least_m)
    if not led.any():
        return estimated, left_s
    steps = max(1.0, dt_s / settings.usual_s)
    most_m = steps * np.minimum(settings.step_m, settings.first_m + settings.share * gap_m) + settings.speed_m_s * dt_s
    for _ in range(2):
        # The path is nonlinear in the angles: steps that are still too long are shortened once more.
        shorter = np.minimum(1.0, most_m / np.maximum(np.sqrt((way * way).sum(-1)), _NONE_M))
        if not (led & (shorter < 1.0)).any():
            break
        share *= shorter
        way = kinematics.marker_points((shown + share[:, None] * change).reshape(-1)) - begin
    angles = np.where(led[:, None], shown + share[:, None] * change, estimated)
    # A blend continues until the finger arrives, even after `lasts_s`.
    left = np.where(share < 1.0, np.maximum(left_s - dt_s, _NONE_S), left_s - dt_s)
    return angles, np.where(led, np.maximum(left, 0.0), 0.0)


_NONE_M: Final = 1e-9
_NONE_S: Final = 1e-9
