"""The zero-velocity update (ZUPT) of a foot: while its sensor stands, its velocity is measured to be zero.

For each sample, the detector (`rhot_feet.imu.zero_velocity_detector`) reports whether the sensor stands, and the
standard deviation of its velocity; this module updates a filter with it. A foot that rolls from heel to toes does not
stand, but it rotates about its contact with the floor, which also determines its velocity. After a longer stand the
measured angular rate is the gyroscope's bias (zero-angular-rate update).
"""

from __future__ import annotations

from typing import TypeVar

from rhot.arrays import FloatArray
from rhot_feet.filter.model import FootModel
from rhot_feet.imu.zero_velocity_detector import SAMPLE_S, ZeroVelocity

State = TypeVar("State")


def zero_velocity_update(
    model: FootModel[State],
    state: State,
    measured: ZeroVelocity,
    angular_rate: FloatArray,
    duration_s: float,
    *,
    gated: bool,
) -> State:
    """Return the state after the zero-velocity update of a sample; unchanged while the sensor moves.

    Args:
        model: the filter.
        state: before the update.
        measured: result of the detector.
        angular_rate: (3,) rad/s, sensor frame.
        duration_s: time since the previous sample, seconds; the weight of a sample is proportional to it.
        gated: whether to reject an update that contradicts the filter.
    """
    if measured.speed_sigma is None:
        return state
    sigma = measured.speed_sigma * (SAMPLE_S / duration_s) ** 0.5
    rolling = measured.rolls_m * angular_rate if measured.rolls_m else None
    # Squared normalised innovation (3 degrees of freedom) above which an update is refused while the foot is
    # seen. A foot that is not seen is always updated: then the filter is wrong, not the detector.
    state = model.zero_velocity_update(state, sigma, 25.0 if gated else None, rolling)
    if measured.rate is not None:
        state = model.zero_rate_update(state, measured.rate, duration_s)
    return state
