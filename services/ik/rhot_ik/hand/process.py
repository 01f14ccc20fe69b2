"""How a hand moves: the state of the filter of a whole hand, and what time does to it.

State: the wrist's pose T_rig_wrist = (R, p), how fast it turns and moves, and the angles q of `rhot.anatomy.hand`.
Errors are R·exp(δθ), p + δp, ω + δω, v + δv, q + δq, in this order (`ROTATION` … `ANGLES`); P is their covariance.

The wrist turns and moves on steadily, disturbed by random accelerations, its speed fading; the angles are the
Ornstein–Uhlenbeck process of `rhot_ik.hand.prior`. So a hidden finger goes with its neighbours and slowly back to rest,
and nothing that is seen is held back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import HandModel
from rhot.geometry.rotations import orthonormal, rotation_from_vector
from rhot_ik.hand.prior import COUNT, angle_covariance, rest_angles

FloatArray = NDArray[np.float64]

ROTATION: Final = slice(0, 3)
POSITION: Final = slice(3, 6)
TURNING: Final = slice(6, 9)
SPEED: Final = slice(9, 12)
ANGLES: Final = slice(12, 12 + COUNT)
SIZE: Final = 12 + COUNT

TURN_ACCELERATION: Final = 6.0
"""Random angular acceleration of the wrist, rad/s^1.5."""
ACCELERATION: Final = 1.5
"""Random acceleration of the wrist, m/s^1.5."""
SPEED_FADES_S: Final = 0.3
ANGLES_REST_S: Final = 1.5
"""Time constant with which the angles return to rest when nothing is seen."""


@dataclass(frozen=True, slots=True)
class HandState:
    """The hand at one moment.

    Attributes:
        R: (3, 3) wrist to rig.
        p: (3,) wrist, metres, rig frame.
        turning: (3,) rad/s, wrist frame.
        speed: (3,) m/s, rig frame.
        angles: (20,) radians.
        P: (32, 32) covariance of the errors.
        spread: share of the angles' stationary covariance that the last prediction added to P.
        missed_m: mean distance of the seen tips from where this state has them; 0 when none was seen.
    """

    R: FloatArray
    p: FloatArray
    turning: FloatArray
    speed: FloatArray
    angles: FloatArray
    P: FloatArray
    spread: float = 0.0
    missed_m: float = 0.0


class HandProcess:
    """Starts and predicts `HandState`s of one hand; stateless after construction."""

    def __init__(self, model: HandModel) -> None:
        self._rest = rest_angles(model)
        self._stationary = angle_covariance(model)
        self._noise = _process_noise(self._stationary)

    def start(self, R: FloatArray, p: FloatArray, angles: FloatArray | None = None) -> HandState:
        """Return a state of which only the given is known: a turn to 30°, a place to 5 cm, angles as at rest."""
        P = np.zeros((SIZE, SIZE))
        P[ROTATION, ROTATION] = np.eye(3) * np.radians(30.0) ** 2
        P[POSITION, POSITION] = np.eye(3) * 0.05**2
        P[TURNING, TURNING] = np.eye(3) * 2.0**2
        P[SPEED, SPEED] = np.eye(3) * 0.5**2
        P[ANGLES, ANGLES] = self._stationary
        return HandState(R, p, np.zeros(3), np.zeros(3), self._rest if angles is None else angles, P)

    def predict(self, state: HandState, dt_s: float) -> HandState:
        """Return the state `dt_s` later."""
        if dt_s <= 0.0:
            return state
        fades = math.exp(-dt_s / SPEED_FADES_S)
        path_s = SPEED_FADES_S * (1.0 - fades)
        keeps = math.exp(-dt_s / ANGLES_REST_S)
        spread = 1.0 - keeps * keeps
        turn = rotation_from_vector(state.turning * path_s)
        F = np.zeros((SIZE, SIZE))
        diagonal = F.reshape(-1)[:: SIZE + 1]
        diagonal[POSITION], diagonal[6:12], diagonal[ANGLES] = 1.0, fades, keeps
        F.reshape(-1)[TURNING.start : 6 * SIZE : SIZE + 1] = path_s
        F[ROTATION, ROTATION] = turn.T
        strengths = np.array([dt_s**3 / 3.0, dt_s**2 / 2.0, dt_s, spread])
        return HandState(
            orthonormal(state.R @ turn),
            state.p + path_s * state.speed,
            fades * state.turning,
            fades * state.speed,
            self._rest + keeps * (state.angles - self._rest),
            F @ state.P @ F.T + (strengths @ self._noise).reshape(SIZE, SIZE),
            spread,
        )


def _process_noise(stationary: FloatArray) -> FloatArray:
    """Return what a prediction by t adds to P, (4, 32·32): the factors of t³/3, t²/2, t and of the angles' spread."""
    noise = np.zeros((4, SIZE, SIZE))
    for value, rate, strength in ((ROTATION, TURNING, TURN_ACCELERATION), (POSITION, SPEED, ACCELERATION)):
        noise[0][value, value] = noise[1][value, rate] = noise[1][rate, value] = noise[2][rate, rate] = (
            strength** 2 * np.eye(3)
        )
    noise[3][ANGLES, ANGLES] = stationary
    return noise.reshape(4, -1)
