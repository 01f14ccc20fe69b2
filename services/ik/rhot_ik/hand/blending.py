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
        usual_s: the usual time from one sample to the next, for which the three that follow hold: two cameras at 30
            frames a second. Where samples are further apart, they grow as that does: a finger is not led in for longer.
        step_m: a tip's marker goes no further than this on the palm from one sample to the next; joints beside it go
            up to a third further; a step beyond the true motion was to stay below 10 mm (`rhot evaluate motion`).
        first_m, share: nor further than this much and this share of what is left of its way, so that it sets out and
            arrives gently.
        speed_m_s: and by the way of a finger that moves at this speed on top: closing hands take about half a second
            for 0.05 m of a tip on the palm.
        lasts_s: for at least this long, until fusion has settled on a marker that is new to it.
        settles_s, known_m: a finger that has been seen for this long, its marker known to this the worst way, goes its
            own way as well; before, what the estimate does is to settle, which is no motion. Half of the points
            that are known worse are over 45 mm off (fast hands of `rhot evaluate motion`, 30 fps, develop seeds
            0 to 29).
        fastest_m_s: a tip that goes faster on the palm was found again rather than moved: 20 rad/s of a finger 80 mm
            long.
        sure_m: a marker known no better than this, the worst way, has not come back yet: one camera sees it.
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
    sure_m: float = 0.01


def carried(
    kinematics: HandKinematics,
    shown: FloatArray,
    moved: FloatArray,
    led: BoolArray,
    dt_s: float,
    settings: BlendSettings,
) -> FloatArray:
    """Return the angles (5, 4) that were shown, those of fingers that are led in moved on as they have moved since.

    Args:
        kinematics: of the hand.
        shown: (5, 4) radians: what was shown last.
        moved: (5, 4) radians: by how much the estimate has changed.
        led: (5,) fingers that are led in and go their own way as well.
        dt_s: since then.
        settings: how fast fingers are.
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
    """Return the angles (5, 4) to show, and for how long each finger is led in from now on (5,), seconds.

    Args:
        kinematics: of the hand.
        estimated: (5, 4) radians: what is known now.
        shown: (5, 4) radians: what was shown last.
        left_s: (5,) for how long each finger is still led in; 0 = it is not.
        dt_s: since then.
        settings: how fast.
    """
    change = estimated - shown
    # No tip goes further than its finger turns; most samples end here, without the tips themselves.
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
        # A share of the angles is not the same share of the way: what is too far still is shortened once more.
        shorter = np.minimum(1.0, most_m / np.maximum(np.sqrt((way * way).sum(-1)), _NONE_M))
        if not (led & (shorter < 1.0)).any():
            break
        share *= shorter
        way = kinematics.marker_points((shown + share[:, None] * change).reshape(-1)) - begin
    angles = np.where(led[:, None], shown + share[:, None] * change, estimated)
    # Who has not arrived is led on, however long it takes.
    left = np.where(share < 1.0, np.maximum(left_s - dt_s, _NONE_S), left_s - dt_s)
    return angles, np.where(led, np.maximum(left, 0.0), 0.0)


_NONE_M: Final = 1e-9
_NONE_S: Final = 1e-9
