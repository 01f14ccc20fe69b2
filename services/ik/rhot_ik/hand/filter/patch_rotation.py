"""The wrist's rotation from the four corners of the patch on the back of the hand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.covariances import symmetric_inverse
from rhot.geometry.rotations import cross_matrix, nearest_rotation, rotation_from_vector

_MOST_STEPS: Final = 4
MAX_ERROR_M: Final = 0.006
"""Corners further than this (root mean square) from any pose of the patch are no such patch."""
FAR_M: Final = 0.004
"""Corners further than this (root mean square) from the expected ones: the expected rotation is no place to start."""
CLOSE_RAD: Final = 0.05
"""Steps end when the last one was no longer than this; what is left is its square."""
OBLONG_M: Final = 0.003
"""Sides that differ by less may be the other way round: twice what two measures by a ruler are off."""
CORNER_ORDERS: Final = np.array([[(first + way * k) % 4 for k in range(4)] for way in (1, -1) for first in range(4)])
"""The eight ways to go round a rectangle, (8, 4)."""
_AGREEMENT: Final = np.eye(4)[CORNER_ORDERS].swapaxes(1, 2).reshape(8, 16)
"""Sums the products of corners found (rows) and of the outline (columns) that belong together in each order."""


@dataclass(frozen=True, slots=True)
class FittedPatch:
    """How a patch lies, as its corners say.

    Attributes:
        rotation: (3, 3) patch to rig.
        covariance: (3, 3) of its error δθ, that of R·exp(δθ).
        corners: (4, 3) about their centre, metres, rig frame, in the outline's order.
        off: (4, 3) of them from where the rotation has them.
        weight: (3, 3) inverse of a corner's covariance.
        longer_m: by how much the outline is longer across than along; 0 for a patch that is nearly square.
    """

    rotation: FloatArray
    covariance: FloatArray
    corners: FloatArray
    off: FloatArray
    weight: FloatArray
    longer_m: float

    @property
    def misfit(self) -> float:
        """Squared distance of the corners from that pose, over their variance."""
        return float(((self.off @ self.weight) * self.off).sum())

    @property
    def quarter_turn(self) -> float:
        """By how much that would grow if the patch lay a quarter turn off; below 0, it lies so. 0 if nearly square."""
        # For sides a, b of a patch A, B: (a − B)² + (b − A)² − (a − A)² − (b − B)² = 2·(a − b)·(A − B).
        return 2.0 * _longer_m(self.corners) * self.longer_m * float(np.trace(self.weight)) / 3.0


class PatchRotation:
    """Turns the four corners of one patch into a rotation.

    Args:
        outline: (4, 3) metres: corners about the patch's centre, wrist frame.
    """

    def __init__(self, outline: FloatArray) -> None:
        self._outline = outline
        # d(R·exp(δθ)·o) = −R·[o]×·δθ, so Jᵀ·W·J and Jᵀ·W·r are fixed linear maps of Rᵀ·W·R and of its product with r.
        J = -cross_matrix(outline)
        self._squares = np.einsum("kia,kjb->abij", J, J).reshape(9, 9)
        self._arms = J.swapaxes(1, 2).swapaxes(0, 1).reshape(3, 12)
        self._size = float((outline * outline).sum())
        longer_m = _longer_m(outline)
        self._longer_m = longer_m if abs(longer_m) > OBLONG_M else 0.0

    def patch_orientations(self, corners: FloatArray) -> list[FloatArray]:
        """Return the rotations (3, 3), wrist to rig, of the ways to lay the patch on its corners (4, 3), metres.

        Those of a rectangle's eight that fit within `MAX_ERROR_M`: two, or four where it is nearly a square, and as
        many that show its other face.
        """
        centred = corners - corners.sum(axis=0) / 4.0
        fitting = []
        for order in CORNER_ORDERS:
            found = centred[order]
            R = nearest_rotation(found.T @ self._outline)
            off = found - self._outline @ R.T
            if np.vdot(off, off) < 4.0 * MAX_ERROR_M**2:
                fitting.append(R)
        return fitting

    def fit(self, corners: FloatArray, expected: FloatArray, covariance: FloatArray) -> FittedPatch | None:
        """Return how the patch lies, or None if these are no corners of it.

        Of the eight ways to go round a rectangle, the one nearest to `expected` is taken; if the corners do not fit
        that, because `expected` is some 45° or more off, the nearest of those a quarter turn from it. Gauss–Newton,
        from `expected` when that is near, else from the unweighted fit.

        Args:
            corners: (4, 3) metres, rig frame, cyclic order from an unknown one.
            expected: (3, 3) wrist to rig.
            covariance: (3, 3) square metres: of a corner about the patch's centre, rig frame.
        """
        centred = corners - corners.sum(axis=0) / 4.0
        # Σ |found − R·o|² is least where Σ found·(R·o) is greatest.
        agree = _AGREEMENT @ (centred @ expected @ self._outline.T).reshape(16)
        best = int(agree.argmax())
        if not math.isfinite(agree[best]):
            return None
        fitted = self._fit_in_order(centred, best, float(agree[best]), expected, covariance)
        if fitted is None:
            other = int(agree[1 - best % 2 :: 2].argmax()) * 2 + 1 - best % 2
            fitted = self._fit_in_order(centred, other, float(agree[other]), expected, covariance)
        return fitted

    def _fit_in_order(
        self, centred: FloatArray, order: int, agree: float, expected: FloatArray, covariance: FloatArray
    ) -> FittedPatch | None:
        """Do the same for one of `CORNER_ORDERS`, whose agreement with the expected corners is given."""
        found = centred[CORNER_ORDERS[order]]
        missed = float(np.vdot(centred, centred)) + self._size - 2.0 * agree
        R = nearest_rotation(found.T @ self._outline) if missed > 4.0 * FAR_M**2 else expected
        weight = symmetric_inverse(covariance)
        for _ in range(_MOST_STEPS):
            local = R.T @ weight @ R
            information = (self._squares @ local.reshape(9)).reshape(3, 3)
            error = symmetric_inverse(information)
            step = error @ (self._arms @ ((found @ R - self._outline) @ local).reshape(12))
            R = R @ rotation_from_vector(step)
            if step @ step < CLOSE_RAD**2:
                break
        off = found - self._outline @ R.T
        if np.vdot(off, off) > 4.0 * MAX_ERROR_M**2:
            return None
        return FittedPatch(R, error, found, off, weight, self._longer_m)


def _longer_m(corners: FloatArray) -> float:
    """Return by how much a patch with corners (4, 3), in the outline's order, is longer across than along, metres."""
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.sqrt((sides * sides).sum(axis=1))
    return float(lengths[0] - lengths[1] + lengths[2] - lengths[3]) / 2.0
