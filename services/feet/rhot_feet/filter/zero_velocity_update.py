"""The zero-velocity update (ZUPT) of a foot: while its sensor stands, its velocity is measured to be zero.

For each sample, the detector (`rhot_feet.imu.zero_velocity_detector`) reports whether the sensor stands, and the
standard deviation of its velocity; this module updates a filter with it. A foot that rolls from heel to toes does not
stand, but it rotates about its contact with the floor, which also determines its velocity. After a longer stand the
measured angular rate is the gyroscope's bias (zero-angular-rate update).

A foot that moves evenly, such as one that is lifted by hand, looks to the detector like one that stands. So an update
that contradicts the filter is refused at first; one that goes on being refused shows that the filter is wrong.
"""

from __future__ import annotations

from typing import Final, TypeVar

from rhot.arrays import FloatArray
from rhot_feet.filter.model import FootModel
from rhot_feet.imu.zero_velocity_detector import SAMPLE_S, ZeroVelocity

State = TypeVar("State")

_GATE_NIS: Final = 25.0
"""Squared normalised innovation (3 degrees of freedom) above which an update is refused: 5 standard deviations."""
_REFUSES_S: Final = 0.06
"""For so long updates of a foot that is not seen are refused. On recorded feet 0.06 s do what 0.1 s do. With a false
acceleration to 3.6 m/s in the middle of each walk, the error is 55 to 59 mm (never refusing), 62 to 64 mm (0.06 s) and
97 to 135 mm (0.1 s)."""


def zero_velocity_update(
    model: FootModel[State],
    state: State,
    measured: ZeroVelocity,
    angular_rate: FloatArray,
    duration_s: float,
    refused_s: float,
    *,
    seen: bool,
) -> tuple[State, float]:
    """Return the state after the zero-velocity update of a sample, and for how long updates have been refused now.

    Args:
        model: the filter.
        state: before the update; returned unchanged while the sensor moves, and where the update is refused.
        measured: result of the detector.
        angular_rate: (3,) rad/s, sensor frame.
        duration_s: time since the previous sample, seconds; the weight of a sample is proportional to it.
        refused_s: for how long updates have been refused before, seconds.
        seen: whether cameras see the foot: then what contradicts the filter is always refused.
    """
    if measured.speed_sigma is None:
        return state, refused_s
    sigma = measured.speed_sigma * (SAMPLE_S / duration_s) ** 0.5
    rolling = measured.rolls_m * angular_rate if measured.rolls_m else None
    gate_nis = _GATE_NIS if seen or refused_s < _REFUSES_S else None
    updated = model.zero_velocity_update(state, sigma, gate_nis, rolling)
    if updated is state:
        return state, refused_s + duration_s
    if measured.rate is not None:
        updated = model.zero_rate_update(updated, measured.rate, duration_s)
    return updated, 0.0
