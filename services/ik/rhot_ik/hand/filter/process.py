"""Process model of the hand: the state of the estimate, and its prediction over time.

State: the wrist's pose T_rig_wrist = (R, p), its angular and linear velocity, the angles q of `rhot.anatomy.hand`, and
what is particular of this person: where the patch really sits and how long the fingers are. Errors are R·exp(δθ),
p + δp, ω + δω, v + δv, q + δq, c + δc, in this order (`ROTATION` … `PERSON`); P is their covariance.

The wrist turns and moves on, disturbed by random accelerations, its speed fading; the angles are an Ornstein–Uhlenbeck
process: what moves one finger moves its neighbours too, and left alone the hand relaxes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.rotations import orthonormal, rotation_from_vector

# Prior of the joint angles: the rest pose, and how the joints move together.
#
# The angles are modelled as normally distributed about a relaxed hand. Their covariance is a sum of independent
# causes, each with its own standard deviation: the whole hand closes or spreads, neighbours bend together, a finger
# bends by itself, a hinge does something of its own. From that one matrix follow all soft rules of the hand: the last
# hinge goes with the middle one, a knuckle with its hinges, a finger with its neighbours the more the nearer they
# are. In time the angles are an Ornstein–Uhlenbeck process with that distribution: left alone they drift back to
# rest, and what moves them moves neighbours too.
#
# The shares are round numbers of the order of those in the literature (Rijpkema & Girard 1991 for DIP ≈ ⅔ PIP; Santello
# et al. 1998 for the common closing); they are not fitted to recordings.

COUNT: Final = 20
"""Angles of a hand, finger by finger, in the order of `rhot.anatomy.hand`: flexion, abduction, middle hinge, last
hinge."""
MEAN_DEG: Final = ((20.0, 10.0, 15.0), (20.0, 2.0, 30.0), (20.0, 0.0, 32.0), (20.0, -2.0, 32.0), (20.0, -6.0, 30.0))
"""How a hand at ease stands. Its thumb does not lie aside but opposite to the long fingers, as in grasping with the
palm: a cylinder of 1.75 inches (44 mm) fits between (Taylor & Schwarz, "The anatomy and mechanics of the human hand",
Artificial Limbs 2(2), 1955, after Bunnell). Its first joint therefore stands as when it holds one, which leaves 41 mm
between thumb and index finger, flesh to flesh."""
CLOSED_DEG: Final = ((10.0, 11.0, 34.0), *(((61.0, 0.0, 60.0),) * 4))
"""How fingers stand that hold something: the four functional positions of Hume et al., "Functional range of motion of
the joints of the hand", J. Hand Surg. 15A, 1990 (61°, 60° and 39°); the thumb as in 744 recorded grasps of three people
(FPHA), mean over them, within 12°, 12° and 7°."""
CLOSING_DEG: Final = ((8.0, 6.0, 8.0), *(((16.0, 0.0, 24.0),) * 4))
"""All fingers close together."""
NEIGHBOURS_DEG: Final = (16.0, 0.0, 22.0)
"""A long finger bends, its neighbours with it by `_SHARE_OF_NEIGHBOUR` for each step away."""
_SHARE_OF_NEIGHBOUR: Final = 0.7
OWN_BEND_DEG: Final = ((8.0, 0.0, 12.0), *(((12.0, 0.0, 14.0),) * 4))
"""A finger bends by itself, knuckle and hinges together."""
OWN_DEG: Final = ((16.0, 16.0, 14.0), (10.0, 4.0, 8.0), (10.0, 2.0, 8.0), (10.0, 4.0, 8.0), (10.0, 5.0, 8.0))
"""One angle by itself."""
SPREAD_DEG: Final = (0.0, 4.0, 1.0, -3.0, -6.0)
"""Abduction when the hand spreads."""
LAST_HINGE_DEG: Final = (8.0, 4.0, 4.0, 4.0, 4.0)
"""How freely the last hinge departs from its share of the middle one."""


def rest_angles(model: HandModel) -> FloatArray:
    """Return the mean of the angles of a hand at ease, (20,) radians."""
    return _angles(model, MEAN_DEG)


def closed_angles(model: HandModel) -> FloatArray:
    """Return the mean of the angles of fingers that hold something, (20,) radians."""
    return _angles(model, CLOSED_DEG)


def hidden_angles(model: HandModel) -> FloatArray:
    """Return the mean of the angles of fingers that nobody sees, (20,) radians.

    Each may have met what it closes round anywhere on its way from rest to closed, so its mean is half of the way.
    """
    return 0.5 * (rest_angles(model) + closed_angles(model))


def _angles(model: HandModel, mean_deg: tuple[tuple[float, ...], ...]) -> FloatArray:
    mean = np.empty((len(FINGERS), 4))
    mean[:, :3] = np.radians(mean_deg)
    mean[:, 3] = model.coupling * mean[:, 2]
    return model.clamp(mean).reshape(COUNT)


def angle_covariance(model: HandModel) -> FloatArray:
    """Return the covariance of the angles about their mean, (20, 20) square radians, positive definite."""
    causes: list[FloatArray] = []

    def cause(shares_deg: FloatArray) -> None:
        effect = np.zeros((len(FINGERS), 4))
        effect[:, :3] = np.radians(shares_deg)
        effect[:, 3] = model.coupling * effect[:, 2]
        causes.append(effect.reshape(COUNT))

    cause(np.array(CLOSING_DEG))
    cause(np.array(SPREAD_DEG)[:, None] * np.array([0.0, 1.0, 0.0]))
    long_fingers = np.arange(1, len(FINGERS))
    near = _SHARE_OF_NEIGHBOUR ** np.abs(long_fingers[:, None] - long_fingers)
    for column in np.linalg.cholesky(near).T:
        for kind in np.eye(3) * np.array(NEIGHBOURS_DEG):
            if kind.any():
                cause(np.vstack([np.zeros((1, 3)), column[:, None] * kind]))
    for place in range(len(FINGERS)):
        only = (np.arange(len(FINGERS)) == place)[:, None]
        cause(only * np.array(OWN_BEND_DEG))
        for kind in np.eye(3):
            cause(only * np.array(OWN_DEG) * kind)
    together = np.array(causes)
    covariance: FloatArray = together.T @ together
    last = np.arange(3, COUNT, 4)
    covariance[last, last] += np.radians(LAST_HINGE_DEG) ** 2
    return covariance


_WRIST_ACCELERATION: Final = 6.0
"""Random acceleration of the wrist, m/s² per √Hz. Hands in the recordings reach 5 to 20 m/s² for some 0.1 s (`rhot
evaluate motion`); fusion has smoothed the points already, so the wrist is to follow them.
"""
_SPEED_FADES_S: Final = 0.2
"""An unseen wrist stops in this time: voluntary movements are bells of about half a second."""
_ANGLES_S: Final = 2.0
"""Time constant with which an unseen finger comes to be anywhere that fingers are: people hold a thing, or a posture,
for some seconds.
"""
_CLOSES_S: Final = 0.8
"""The same of one that closes round a known object, in about half a second: in front of cameras that see a hand's back,
fingers vanish under it because they close.
"""
_PERSON_S: Final = 60.0
"""In this time what was learned of a person fades: somebody may have changed places or repainted."""
ERROR_LASTS_S: Final = 0.25
"""Errors of the points last about so long (fusion's own memory, a posture in which the paint that is seen lies off its
middle), so that only one sample in this time tells something new of a person.
"""
_BASE_SHIFT_M: Final = (0.005, 0.004, 0.0092)
"""How far the patch sits from where the model has it, standard deviations across, above and along the hand. A hand's
back is 11 to 18 mm above the wrist's joint; people paint by eye, 8 mm along the hand; and palms of hands of one
length differ by 4.5 mm.
"""
_FINGER_SHARE: Final = 0.05
"""How much longer or shorter than the model's a finger is up to its marker: 2 to 3 mm of 80 mm for the length of the
paint, and 3 to 4 % for three bones in a row, each 5 to 8 % by itself in people whose hands have one length
(Buryanov & Kotiuk 2010, tables 1 to 3: standard deviations of each bone).
"""

ROTATION: Final = slice(0, 3)
POSITION: Final = slice(3, 6)
ANGULAR_VELOCITY: Final = slice(6, 9)
VELOCITY: Final = slice(9, 12)
ANGLES: Final = slice(12, 12 + COUNT)
MOTION: Final = slice(0, 32)
"""All of the above: what changes from sample to sample."""
BASE_SHIFT: Final = slice(32, 35)
"""Of the base marker from where the model has it, metres, wrist frame."""
PATCH_TILT: Final = slice(35, 38)
"""Rotation vector of the patch against the wrist, radians, wrist frame."""
LONGER: Final = slice(38, 43)
"""By which share each finger, up to its marker, is longer than the model's."""
PERSON: Final = slice(32, 43)
SIZE: Final = 43
_OF_SPEEDS, _SPEEDS, _ANGLES, _PERSON = (
    slice(first * SIZE + column, last * SIZE, SIZE + 1)
    for first, last, column in ((0, 6, 6), (6, 12, 6), (12, 32, 12), (32, 43, 32))
)
"""Where a flat (43, 43) matrix has what speeds do to the pose, and the diagonals of speeds, angles and person."""


@dataclass(frozen=True, slots=True)
class HandState:
    """The hand at one moment.

    Attributes:
        R: (3, 3) wrist to rig.
        p: (3,) wrist, metres, rig frame.
        angular_velocity: (3,) rad/s, wrist frame.
        velocity: (3,) m/s, rig frame.
        angles: (20,) radians.
        person: (11,) base shift, patch tilt and lengths of the fingers.
        P: (43, 43) covariance of the errors.
        dt_s: how far the last prediction reached.
        keeps: (20,) what share of each angle's distance from its mean it kept; none before the first prediction.
        mean_residual_m: mean distance of the seen tips from where this state has them, as far as they are known; 0 when
            none was seen.
        prior_covariance: (43, 43) covariance before the last sample, with the room that the sample gave it.
    """

    R: FloatArray
    p: FloatArray
    angular_velocity: FloatArray
    velocity: FloatArray
    angles: FloatArray
    person: FloatArray
    P: FloatArray
    dt_s: float = 0.0
    keeps: FloatArray | None = None
    mean_residual_m: float = 0.0
    prior_covariance: FloatArray | None = None

    @property
    def longer(self) -> FloatArray:
        """(5,) by which share each finger is longer than the model's."""
        return self.person[6:]

    @property
    def personal_parameters(self) -> tuple[FloatArray, FloatArray]:
        """Return the person-specific parameters (11,) and their covariance (11, 11); they outlive a lost hand."""
        return self.person, self.P[PERSON, PERSON]


class HandProcess:
    """Starts and predicts `HandState`s of one hand; stateless after construction.

    Args:
        model: the hand.
        known: (6,) of which markers, five tips and base, a calibration has measured where they sit.
    """

    def __init__(self, model: HandModel, known: BoolArray) -> None:
        self._rest, self._closed, self._unseen = rest_angles(model), closed_angles(model), hidden_angles(model)
        self._stationary = angle_covariance(model)
        # Where `rhot calibrate hand` has measured them, 1 mm, 0.02 rad and 0.5 %, as its quality states them.
        shift = np.where(known[5], 0.001, _BASE_SHIFT_M)
        # By how much the skin under the patch is tilted against the palm, each axis.
        tilt = np.full(3, 0.02 if known[5] else 0.09)
        lengths = np.where(known[:5], 0.005, _FINGER_SHARE)
        self._person = np.diag(np.concatenate([shift, tilt, lengths]) ** 2)
        self._noise = self._process_noise()
        self._unmoved = np.eye(SIZE)

    def start(
        self,
        R: FloatArray,
        p: FloatArray,
        angles: FloatArray | None = None,
        person: tuple[FloatArray, FloatArray] | None = None,
        hidden: BoolArray | None = None,
    ) -> HandState:
        """Return a state of which only the given is known: a turn to 30°, a place to 5 cm, angles as at rest.

        Fingers that are `hidden` (5,) start as such fingers usually stand.
        """
        P = np.zeros((SIZE, SIZE))
        P[ROTATION, ROTATION] = np.eye(3) * np.radians(30.0) ** 2
        P[POSITION, POSITION] = np.eye(3) * 0.05**2
        P[ANGULAR_VELOCITY, ANGULAR_VELOCITY] = np.eye(3) * 2.0**2
        P[VELOCITY, VELOCITY] = np.eye(3) * 0.5**2
        P[ANGLES, ANGLES] = self._stationary
        known, P[PERSON, PERSON] = (np.zeros(PERSON.stop - PERSON.start), self._person) if person is None else person
        q = self._expected(hidden, self._unseen) if angles is None else angles
        return HandState(R, p, np.zeros(3), np.zeros(3), q, known, P)

    def predict(self, state: HandState, dt_s: float, hidden: BoolArray | None = None, holds: bool = False) -> HandState:
        """Return the state `dt_s` later.

        Args:
            state: of before.
            dt_s: seconds.
            hidden: (5,) fingers that nobody sees: they go on closing, those that are seen relax.
            holds: whether it is known what they may close round, so that they go on until they meet it.
        """
        if dt_s <= 0.0:
            return state
        fades, path_s = self._speeds(dt_s)
        keeps = np.full(COUNT, math.exp(-dt_s / _ANGLES_S))
        if holds and hidden is not None:
            keeps[np.repeat(hidden, 4)] = math.exp(-dt_s / _CLOSES_S)
        mean = self._expected(hidden, self._closed if holds else self._unseen)
        learned = math.exp(-dt_s / _PERSON_S)
        F = self.derivative(state, dt_s, keeps)
        turn = F[ROTATION, ROTATION].T
        strengths = np.array([dt_s**3 / 3.0, dt_s**2 / 2.0, dt_s, 1.0 - learned * learned])
        P = F @ state.P @ F.T + (strengths @ self._noise).reshape(SIZE, SIZE)
        P[ANGLES, ANGLES] += self.diffused(keeps)
        return HandState(
            orthonormal(state.R @ turn),
            state.p + path_s * state.velocity,
            fades * state.angular_velocity,
            fades * state.velocity,
            mean + keeps * (state.angles - mean),
            learned * state.person,
            P,
            dt_s,
            keeps,
        )

    def diffused(self, keeps: FloatArray, times: float | FloatArray = 1.0) -> FloatArray:
        """Return the covariance (20, 20) that a prediction adds to the angles, of which it `keeps` (20,) such shares.

        Args:
            keeps: see `HandState`.
            times: (20,) factors of the standard deviations.
        """
        added = times * np.sqrt(1.0 - keeps * keeps)
        covariance: FloatArray = added[:, None] * self._stationary * added
        return covariance

    def derivative(self, state: HandState, dt_s: float, keeps: FloatArray) -> FloatArray:
        """Return F (43, 43): how an error of a state is one of the state that `predict` makes of it, `dt_s` later.

        Args:
            state: of before.
            dt_s: seconds.
            keeps: (20,) of the state that was predicted.
        """
        fades, path_s = self._speeds(dt_s)
        F = self._unmoved.copy()
        F[ROTATION, ROTATION] = rotation_from_vector(state.angular_velocity * path_s).T
        diagonal = F.reshape(-1)
        diagonal[_OF_SPEEDS], diagonal[_SPEEDS] = path_s, fades
        diagonal[_ANGLES] = keeps
        diagonal[_PERSON] = math.exp(-dt_s / _PERSON_S)
        return F

    def _speeds(self, dt_s: float) -> tuple[float, float]:
        """Return what share of a speed is left after a time, and for how long it has acted in all, seconds."""
        fades = math.exp(-dt_s / _SPEED_FADES_S)
        return fades, _SPEED_FADES_S * (1.0 - fades)

    def _expected(self, hidden: BoolArray | None, closing: FloatArray) -> FloatArray:
        """Return the angles (20,) that seen fingers tend to, and of hidden ones (5,) those of `closing` (20,)."""
        return self._rest if hidden is None else np.where(np.repeat(hidden, 4), closing, self._rest)

    def _process_noise(self) -> FloatArray:
        """Return what a prediction by t adds to P, (4, 43·43): factors of t³/3, t²/2, t and of person; angles aside."""
        noise = np.zeros((4, SIZE, SIZE))
        for value, rate, strength in (
            # Random angular acceleration, rad/s² per √Hz: 50 rad/s² for 0.1 s.
            (ROTATION, ANGULAR_VELOCITY, 15.0),
            (POSITION, VELOCITY, _WRIST_ACCELERATION),
        ):
            noise[0][value, value] = noise[1][value, rate] = noise[1][rate, value] = noise[2][rate, rate] = (
                strength** 2 * np.eye(3)
            )
        noise[3][PERSON, PERSON] = self._person
        return noise.reshape(4, -1)
