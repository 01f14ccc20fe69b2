"""Constraint on a tip that no camera sees: it is not inside the object that the hand holds.

That such a tip is behind something is true, but tells little: told with every sample that it is behind the hand's own
flesh, the filter put fingers that a held object hid below their neighbours and believed it (`rhot evaluate motion`,
hands in a grasp with two to five hidden tips: 2 mm more). Told only where nothing of the estimated hand lies between
the tip and cameras that show the rest of it, so that the finger closes until something does, it helped one half of the
recorded hands and harmed the other (60 fps, tips hidden up to 0.5 s, 95 %: 58.9 to 54.6 and 50.5 to 48.7 mm; hidden
longer in free hands: 77.2 to 75.5 and 79.4 to 90.3; all joints, mean: 11.3 to 11.3 and 10.9 to 11.0).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rhot.anatomy.hand import MOVING, HandModel
from rhot.arrays import FloatArray
from rhot_ik.hand.contact import Shape
from rhot_ik.hand.filter.evidence import Rows
from rhot_ik.hand.filter.process import HandState

_OPEN_M: Final = 0.5
"""Standard deviation of the directions that are left open: several hands."""


class ContactOfHiddenTips:
    """Adds what is expected of hidden tips to what a sample measures; stateless.

    Args:
        model: the hand.
        contact_m: how far fingers sink into what they hold.
    """

    def __init__(self, model: HandModel, contact_m: float) -> None:
        self._contact_m = contact_m
        self._tip_m = model.radii[MOVING[:, 3]]

    def expect(self, rows: Rows, prior: HandState, markers: FloatArray, shapes: Sequence[Shape]) -> None:
        """Add to the rows what is expected of tips that they do not hold.

        Args:
            rows: of a sample; changed.
            prior: the state as it was expected.
            markers: (5, 3) metres, wrist frame, of that state.
            shapes: things that hidden fingers may have met, rig frame.
        """
        hidden = ~rows.seen[:5]
        tips = markers @ prior.R.T + prior.p
        counts = rows.counts[:15].reshape(5, 3)
        for shape in shapes:
            distance, out = shape.distance(tips)
            inside = hidden & (distance < self._tip_m)
            rows.points[:5][inside] = (tips + (self._tip_m - distance)[:, None] * out)[inside]
            rows.noise[:5][inside] = known_along(out, self._contact_m)[inside]
            counts[inside] = 1.0


def known_along(directions: FloatArray, sigma_m: float) -> FloatArray:
    """Return covariances (N, 3, 3) of points that are known along unit directions (N, 3) alone, to `sigma_m`."""
    outer = directions[:, :, None] * directions[:, None, :]
    covariances: FloatArray = _OPEN_M**2 * np.eye(3) + (sigma_m**2 - _OPEN_M**2) * outer
    return covariances
