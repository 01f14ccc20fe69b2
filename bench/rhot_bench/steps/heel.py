"""Which way a foot points, by how its heel is lifted, on recorded walks (`rhot_feet.filter.displacement`).

The axis about which the sensor turns until the heel is highest, against the way of the foot: a foot that walks points
about along the mean of the steps before and after. Its own toe-out counts as an error. The sensor's north is that of
the whole path by dead reckoning.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion, vector_from_rotation
from rhot_bench.steps.dead_reckoning import reckon
from rhot_bench.steps.walks import StepTrial

LEAST_LIFT_RAD: Final = math.radians(25.0)
_STANDS_M_S: Final = 0.25
_SMOOTHED: Final = 7
_SHORTEST: Final = 10
_SEARCHED: Final = 120
"""Of the motion capture: slower is a stand, over so many samples, if it lasts so many; the heel is highest within."""
_STEP_M: Final = 0.3
_TURN_RAD: Final = math.radians(85.0)
"""Between steps that are shorter, or turn by more, nobody knows where the foot points."""


def heel_directions(trial: StepTrial) -> FloatArray:
    """Return by how much each lifted heel is off (K,), radians, in a recording with motion capture (200 Hz)."""
    R = rotation_from_quaternion(trial.samples.orientation_xyzw)
    path, true = reckon(trial.samples), trial.position - trial.position[0]
    north = float(np.angle(np.sum((true[:, 0] + 1j * true[:, 1]) * np.conj(path[:, 0] + 1j * path[:, 1]))))
    stands = _stands(trial)
    off = []
    for before, here, after in zip(stands, stands[1:], stands[2:], strict=False):
        came, goes = (
            complex(*(trial.position[to[0]] - trial.position[start[1]])[:2])
            for start, to in ((before, here), (here, after))
        )
        turn = float(np.angle(goes * came.conjugate()))
        if min(abs(came), abs(goes)) < _STEP_M or abs(turn) > _TURN_RAD:
            continue
        middle = sum(here) // 2
        lifts = [vector_from_rotation(R[k] @ R[middle].T) for k in range(middle, min(after[0], here[1] + _SEARCHED))]
        x, y, _ = max(lifts, key=lambda lift: math.hypot(lift[0], lift[1])).tolist()
        if math.hypot(x, y) >= LEAST_LIFT_RAD:
            # The toes go down about an axis to the left.
            points = float(np.angle(came)) + 0.5 * turn + math.pi / 2.0
            off.append(float(np.angle(np.exp(1j * (math.atan2(y, x) + north - points)))))
    return np.array(off)


def _stands(trial: StepTrial) -> list[tuple[int, int]]:
    """Return the first and last sample of each stand."""
    speed = np.linalg.norm(np.gradient(trial.position, trial.t_s, axis=0), axis=1)
    still = np.convolve(speed, np.full(_SMOOTHED, 1.0 / _SMOOTHED), "same") < _STANDS_M_S
    edges = np.flatnonzero(np.diff(np.r_[False, still, False].astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2) if b - a > _SHORTEST]
