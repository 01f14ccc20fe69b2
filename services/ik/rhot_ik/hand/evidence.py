"""What one sample says of a hand: points and corners with the covariance of their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import shortest_rotation
from rhot_ik.hand.patch import PatchRotation
from rhot_ik.hand.sight import Sight

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SIGMA_M: Final = 0.0015
"""Standard deviation of a point that states none (root of the sum of the three variances)."""
BASE_SIGMA_M: Final = 0.0007
"""What the marker on the back of a real hand departs from the model, standard deviation per axis."""
TIP_SIGMA_M: Final = 0.003
"""The same of a painted fingertip: what the cameras see of it wanders with the finger's bend."""
PREDICTED_SIGMA_M: Final = 0.006
"""Further error of a marker that fusion bridged."""
CORNER_SIGMA_M: Final = 0.003
"""Of a corner about the centre of its patch (root of the sum of the three variances)."""

ACROSS_RAD: Final = 0.05
"""Of the direction across the wrist."""


@dataclass(frozen=True, slots=True)
class HandObservation:
    """The markers of one hand at one moment, rig frame, metres.

    Attributes:
        t_ns: rig clock.
        base: (3,) centre of the base marker, or not seen.
        base_measured: whether it was measured at this moment rather than bridged.
        corners: (4, 3) of its patch, or not seen.
        tips: (5, 3); NaN rows = not seen.
        tips_measured: (5,) whether each was measured at this moment.
        base_sigma: standard deviation of the base marker (root of the sum of the three variances).
        tips_sigma: (5,) those of the tips; 1.5 mm each when not given.
        across: (3,) unit direction of the wrist's +X axis, where two points of the wrist tell it.
    """

    t_ns: int
    base: FloatArray | None
    base_measured: bool
    corners: FloatArray | None
    tips: FloatArray
    tips_measured: BoolArray
    base_sigma: float = 0.0015
    tips_sigma: FloatArray | None = None
    across: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one sample says, rig frame, metres.

    Attributes:
        base: (3,) centre of the base marker; NaN = not seen.
        base_covariance: (3, 3).
        rotation: (3, 3) wrist to rig, as the corners of the patch say; none where they were not seen.
        rotation_information: (3, 3) inverse covariance of its error δθ.
        tips: (5, 3) fingertip markers; NaN rows = not seen.
        tip_covariances: (5, 3, 3).
    """

    base: FloatArray
    base_covariance: FloatArray
    rotation: FloatArray | None
    rotation_information: FloatArray
    tips: FloatArray
    tip_covariances: FloatArray


class EvidenceModel:
    """Knows how far each kind of point can be trusted.

    Args:
        outline: (4, 3) metres: corners of the base patch about its centre, wrist frame; none for a round marker.
        sight: where the cameras are.
    """

    def __init__(self, outline: FloatArray | None, sight: Sight) -> None:
        self.outline = outline
        self.sight = sight
        self._patch = None if outline is None else PatchRotation(outline)

    def of(self, seen: HandObservation, expected: FloatArray | None) -> Evidence:
        """Return the evidence of a sample; corners count when the rotation (3, 3) is about known as `expected`."""
        base = _NOWHERE if seen.base is None else seen.base
        if seen.base is not None:
            middle = seen.base
        else:
            visible = np.isfinite(seen.tips).all(axis=1)
            middle = seen.tips[visible].mean(axis=0) if visible.any() else np.zeros(3)
        shape = self.sight.shape(middle)
        turned = None
        if expected is not None and seen.corners is not None and self._patch is not None and seen.base_measured:
            covariance = CORNER_SIGMA_M**2 * shape + BASE_SIGMA_M**2 * _UNIT
            turned = self._patch.fit(seen.corners, expected, covariance)
        elif expected is not None and seen.across is not None:
            turned = shortest_rotation(expected[:, 0], seen.across) @ expected, _ACROSS_INFORMATION
        rotation, information = (None, _UNIT) if turned is None else turned
        floors = TIP_SIGMA_M**2 + np.where(seen.tips_measured, 0.0, PREDICTED_SIGMA_M**2)
        sigma = _SIGMAS if seen.tips_sigma is None else seen.tips_sigma
        base_floor = BASE_SIGMA_M**2 + (0.0 if seen.base_measured else PREDICTED_SIGMA_M**2)
        return Evidence(
            base=base,
            base_covariance=seen.base_sigma**2 * shape + base_floor * _UNIT,
            rotation=rotation,
            rotation_information=information,
            tips=seen.tips,
            tip_covariances=(sigma * sigma)[:, None, None] * shape + floors[:, None, None] * _UNIT,
        )


_UNIT: Final = np.eye(3)
_ACROSS_INFORMATION: Final = np.diag([1e-3, ACROSS_RAD**-2, ACROSS_RAD**-2])
"""Two points tell nothing of the turn about the line through them."""
_NOWHERE: Final = np.full(3, np.nan)
_SIGMAS: Final = np.full(5, SIGMA_M)
