"""Prior of the joint angles: the rest pose, and how the joints move together.

The angles are modelled as normally distributed about a relaxed hand. Their covariance is a sum of independent causes,
each with its own standard deviation: the whole hand closes or spreads, neighbours bend together, a finger bends by
itself, a hinge does something of its own. From that one matrix follow all soft rules of the hand: the last hinge goes
with the middle one, a knuckle with its hinges, a finger with its neighbours the more the nearer they are. In time the
angles are an Ornstein–Uhlenbeck process with that distribution: left alone they drift back to rest, and what moves them
moves neighbours too.

The shares are round numbers of the order of those in the literature (Rijpkema & Girard 1991 for DIP ≈ ⅔ PIP; Santello
et al. 1998 for the common closing); they are not fitted to recordings.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray

COUNT: Final = 20
"""Angles of a hand, finger by finger, in the order of `rhot.anatomy.hand`: flexion, abduction, middle hinge, last
hinge."""
MEAN_DEG: Final = ((20.0, 10.0, 15.0), (20.0, 2.0, 30.0), (20.0, 0.0, 32.0), (20.0, -2.0, 32.0), (20.0, -6.0, 30.0))
"""How a hand at ease stands. Its thumb does not lie aside but opposite to the long fingers, as in grasping with the
palm: a cylinder of 1.75 inches (44 mm) fits between (Taylor & Schwarz, "The anatomy and mechanics of the human hand",
Artificial Limbs 2(2), 1955, after Bunnell). Its first joint therefore stands as in `CLOSED_DEG`, which leaves 41 mm
between thumb and index finger, flesh to flesh."""
CLOSED_DEG: Final = ((20.0, 10.0, 21.0), *(((61.0, 0.0, 60.0),) * 4))
"""How fingers stand that hold something: functional positions of Hume et al., "Functional range of motion of the joints
of the hand", J. Hand Surg. 15A, 1990 (fingers 61°, 60° and 39°; thumb 21° and 18° beyond its first joint)."""
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
