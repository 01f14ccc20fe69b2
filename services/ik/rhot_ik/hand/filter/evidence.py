"""What one sample says of a hand: points and corners with the covariance of their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import shortest_rotation
from rhot_ik.hand.filter.patch_rotation import PatchRotation
from rhot_ik.hand.filter.settings import HandSettings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class HandObservation:
    """The markers of one hand at one moment, rig frame, metres.

    Attributes:
        t_ns: rig clock.
        base: (3,) centre of the base marker, or not seen.
        base_measured: whether it was seen at this moment rather than bridged.
        corners: (4, 3) of its patch, or not seen.
        tips: (5, 3); NaN rows = not seen.
        tips_measured: (5,) whether each was seen at this moment, by one camera at least.
        base_covariance: (3, 3) of the base marker; a millimetre or so when not given.
        tip_covariances: (5, 3, 3) those of the tips.
        across: (3,) unit direction of the wrist's +X axis, where two points of the wrist tell it.
    """

    t_ns: int
    base: FloatArray | None
    base_measured: bool
    corners: FloatArray | None
    tips: FloatArray
    tips_measured: BoolArray
    base_covariance: FloatArray | None = None
    tip_covariances: FloatArray | None = None
    across: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one sample says, rig frame, metres.

    Attributes:
        base: (3,) centre of the base marker; NaN = not seen.
        base_covariance: (3, 3).
        rotation: (3, 3) patch to rig, as its corners say; none where they were not seen.
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
        settings: numbers of the estimate.
    """

    def __init__(self, outline: FloatArray | None, settings: HandSettings) -> None:
        self.outline = outline
        self._patch = None if outline is None else PatchRotation(outline)
        self._point = settings.sigma_m**2 / 3.0 * _UNIT
        self._points = np.tile(self._point, (5, 1, 1))
        self._floor = settings.model_m**2 * _UNIT
        self._corner_factor, self._corner_floor = settings.corner_factor, settings.corner_m**2 * _UNIT
        self._across = np.diag([1e-3, settings.across_rad**-2, settings.across_rad**-2])

    def assess(self, seen: HandObservation, expected: FloatArray | None) -> Evidence:
        """Return the evidence of a sample; corners count when the patch's rotation (3, 3) is about `expected`."""
        base_covariance = self._point if seen.base_covariance is None else seen.base_covariance
        tip_covariances = self._points if seen.tip_covariances is None else seen.tip_covariances
        turned = None
        if expected is not None and seen.corners is not None and self._patch is not None and seen.base_measured:
            covariance = self._corner_factor * base_covariance + self._corner_floor
            turned = self._patch.fit(seen.corners, expected, covariance)
        elif expected is not None and seen.across is not None:
            # Two points tell nothing of the turn about the line through them.
            turned = shortest_rotation(expected[:, 0], seen.across) @ expected, self._across
        rotation, information = (None, _UNIT) if turned is None else turned
        return Evidence(
            base=_NOWHERE if seen.base is None else seen.base,
            base_covariance=base_covariance + self._floor,
            rotation=rotation,
            rotation_information=information,
            tips=seen.tips,
            tip_covariances=tip_covariances + self._floor,
        )


_UNIT: Final = np.eye(3)
_NOWHERE: Final = np.full(3, np.nan)
