"""The zero-velocity update (ZUPT) of a foot: while its sensor stands, its velocity is measured to be zero.

The detector (`rhot_feet.imu.zero_velocity_detector`) says with each sample whether the sensor stands and how surely;
here a filter of any kind is corrected by it. A foot that rolls from heel to toes in the middle of a step does not
stand, but it turns about where it touches the floor, which tells its velocity as well. After a longer stand the angular
rate is known to be the gyroscope's bias (zero-angular-rate update).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeVar

from rhot.arrays import FloatArray
from rhot_feet.filter.model import FootModel
from rhot_feet.imu.zero_velocity_detector import ZeroVelocity

State = TypeVar("State")


@dataclass(frozen=True, slots=True)
class ZeroVelocityUpdateSettings:
    """How zero velocity enters the filter; values chosen on the dev trials of PyShoe (`rhot evaluate steps`).

    Attributes:
        sample_s: spacing of the samples that `ZeroVelocity.speed_sigma` is meant for, seconds.
        gate_nis: squared normalised innovation (3 degrees of freedom) above which an update is refused while the foot
            is seen. A foot that is not seen is always updated: then the filter is wrong, not the detector.
        seen_ns: so long after an observation a foot counts as seen.
    """

    sample_s: float = 0.005
    gate_nis: float = 25.0
    seen_ns: int = 300_000_000


ZUPT: Final = ZeroVelocityUpdateSettings()


def zero_velocity_update(
    model: FootModel[State],
    state: State,
    measured: ZeroVelocity,
    angular_rate: FloatArray,
    duration_s: float,
    *,
    gated: bool,
) -> State:
    """Return the state after what a sample says about standing still; as it is while the sensor moves.

    Args:
        model: the filter.
        state: before the update.
        measured: by the detector.
        angular_rate: (3,) rad/s, sensor frame.
        duration_s: since the sample before: samples that follow each other faster say less each.
        gated: refuse the update where it contradicts the filter.
    """
    if measured.speed_sigma is None:
        return state
    sigma = measured.speed_sigma * (ZUPT.sample_s / duration_s) ** 0.5
    rolling = measured.rolls_m * angular_rate if measured.rolls_m else None
    state = model.zero_velocity_update(state, sigma, ZUPT.gate_nis if gated else None, rolling)
    if measured.rate is not None:
        state = model.zero_rate_update(state, measured.rate, duration_s)
    return state
