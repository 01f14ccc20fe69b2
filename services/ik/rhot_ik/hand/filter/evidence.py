"""The measurements of one sample: points and corners with the covariance of their errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.covariances import squared_distances
from rhot.geometry.rotations import shortest_rotation
from rhot_ik.hand.filter.patch_rotation import FittedPatch, PatchRotation

_CORNER_FACTOR: Final = 16.0
"""Covariance of a patch's corner about its middle over that of the middle, before anything is known. Corners are found
half as surely as centroids (0.2 px beside 0.1, rendered G1) and come unfiltered: (2 · 2)².
"""
_CORNER_SAMPLES: Final = (2.0, 100.0)
"""The first sample counts one part in so many, so that the guess, which is one of order only, is worth a single
sample; and how many are remembered.
"""
_ACROSS_RAD: Final = 0.05
"""Error of the direction across the wrist, where two points of the wrist tell it."""


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
        tips_certain: (5,) whether each was seen well enough to take a hand up by it, which may be found the wrong way
            round by a tip that is seen badly; all when not given.
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
    tips_certain: BoolArray | None = None

    @property
    def tips_seen(self) -> BoolArray:
        """(5,) which tips are there at all, measured or bridged."""
        return np.asarray(np.isfinite(self.tips).all(axis=1))

    @property
    def measured_any(self) -> bool:
        """Whether any marker was measured at this moment."""
        base = self.base is not None and self.base_measured
        return base or bool((self.tips_seen & self.tips_measured).any())


@dataclass(frozen=True, slots=True)
class CornerNoise:
    """How much noisier the corners of a patch are than its middle, learned from how far they leave their plane.

    Four corners of a flat patch have one direction to go that no pose explains: (c0 − c1 + c2 − c3)/2 along the line of
    sight, whose variance is that of one corner.

    Attributes:
        factor: a corner's covariance over that of the middle.
        samples: how many it rests on.
    """

    factor: float
    samples: float

    def after(self, corners: FloatArray, covariance: FloatArray, most: float) -> CornerNoise:
        """Return what is known after corners (4, 3) of a middle with a covariance (3, 3)."""
        warp = _WARP @ corners
        # Along the direction in which points are known worst; the others tell more of the paint's rim than of noise.
        seen = covariance @ covariance.sum(axis=1)
        seen /= max(math.sqrt(seen @ seen), 1e-30)
        factor = float(warp @ seen) ** 2 / max(float(seen @ covariance @ seen), 1e-12)
        return CornerNoise(self.factor + (factor - self.factor) / self.samples, min(self.samples + 1.0, most))


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one sample says, rig frame, metres.

    Attributes:
        base: (3,) centre of the base marker; NaN = not seen.
        base_covariance: (3, 3).
        rotation: (3, 3) patch to rig, as its corners say; none where they were not seen.
        rotation_covariance: (3, 3) of its error δθ.
        patch: the same with what else the corners say of it; none where they were not seen.
        tips: (5, 3) fingertip markers; NaN rows = not seen.
        tip_covariances: (5, 3, 3).
        corner_noise: what is known by now of the corners' noise.
    """

    base: FloatArray
    base_covariance: FloatArray
    rotation: FloatArray | None
    rotation_covariance: FloatArray
    tips: FloatArray
    tip_covariances: FloatArray
    corner_noise: CornerNoise
    patch: FittedPatch | None = None


@dataclass(frozen=True, slots=True)
class Rows:
    """A sample as 21 rows of measurement: five tips, the base, the rotation.

    Attributes:
        seen: (7,) which of them were.
        all_seen: whether all were.
        counts: (21,) the same for each row, as 0 or 1.
        points: (6, 3) metres, rig frame: tips and base; 0 where not seen.
        rotation: (3, 3) patch to rig, or not seen.
        noise: (7, 3, 3) covariances; of what was not seen, any.
    """

    seen: BoolArray
    all_seen: bool
    counts: FloatArray
    points: FloatArray
    rotation: FloatArray | None
    noise: FloatArray


def measurement_rows(evidence: Evidence) -> Rows | None:
    """Return evidence as rows of measurement; None when nothing was seen."""
    points = np.concatenate([evidence.tips, evidence.base[None]])
    seen = np.empty(7, dtype=np.bool_)
    seen[:6], seen[6] = np.isfinite(points).all(axis=1), evidence.rotation is not None
    all_seen, counts = bool(seen.all()), _ALL_ROWS
    if not all_seen:
        if not seen.any():
            return None
        points, counts = np.where(seen[:6, None], points, 0.0), np.repeat(seen, 3).astype(np.float64)
    noise = np.empty((7, 3, 3))
    noise[:5], noise[5] = evidence.tip_covariances, evidence.base_covariance
    noise[6] = evidence.rotation_covariance
    return Rows(seen, all_seen, counts, points, evidence.rotation, noise)


def mean_residual_m(rows: Rows, missed: FloatArray, known_m: float) -> float:
    """Return how far the seen tips are off on average, metres; 0 when none is seen.

    Where that is more than `known_m`, directions in which a tip is known worse than this count less: a ray does not
    tell how far along it a tip is.

    Args:
        rows: of a sample.
        missed: (5, 3) metres, what is missed of each tip.
        known_m: standard deviation.
    """
    seen = rows.seen[:5]
    count = max(1, np.count_nonzero(seen))
    off_m = float((np.sqrt((missed * missed).sum(-1)) * seen).sum() / count)
    if off_m < known_m:
        return off_m
    allowed = rows.noise[:5] / known_m**2 + _UNIT
    return float((np.sqrt(squared_distances(missed, allowed)) * seen).sum() / count)


class EvidenceModel:
    """Knows how far each kind of point can be trusted.

    Args:
        outline: (4, 3) metres: corners of the base patch about its centre, wrist frame; none for a round marker.
    """

    def __init__(self, outline: FloatArray | None) -> None:
        self.outline = outline
        self._patch = None if outline is None else PatchRotation(outline)
        # Standard deviation of a point that states no covariance, root of the sum of the three variances.
        self._point = 0.0015**2 / 3.0 * _UNIT
        self._points = np.tile(self._point, (5, 1, 1))
        # By how much any marker departs from a rigid model for reasons that come and go, each axis: skin
        # slides over knuckles by millimetres, the middle of the paint that is seen wanders with the view.
        self._floor = 0.0022**2 * _UNIT
        self._corner_noise = CornerNoise(_CORNER_FACTOR, _CORNER_SAMPLES[0])
        # At least 1 mm along each axis: the fitted corners of soft-edged paint.
        self._most_samples, self._corner_floor = _CORNER_SAMPLES[1], 0.001**2 * _UNIT
        self._across = np.diag([1e3, _ACROSS_RAD**2, _ACROSS_RAD**2])

    def patch_orientations(self, seen: HandObservation) -> list[FloatArray]:
        """Return the rotations (3, 3), wrist to rig, that the corners of a sample allow; none where it has none."""
        if seen.corners is None or self._patch is None or not seen.base_measured:
            return []
        return self._patch.patch_orientations(seen.corners)

    def assess(
        self, seen: HandObservation, expected: FloatArray | None, corner_noise: CornerNoise | None = None
    ) -> Evidence:
        """Return the evidence of a sample; corners count when the patch's rotation (3, 3) is about `expected`."""
        base_covariance = self._point if seen.base_covariance is None else seen.base_covariance
        tip_covariances = self._points if seen.tip_covariances is None else seen.tip_covariances
        patch, noise = None, corner_noise or self._corner_noise
        rotation, rotation_covariance = None, _UNIT
        if expected is not None and seen.corners is not None and self._patch is not None and seen.base_measured:
            noise = noise.after(seen.corners, base_covariance, self._most_samples)
            patch = self._patch.fit(seen.corners, expected, noise.factor * base_covariance + self._corner_floor)
        elif expected is not None and seen.across is not None:
            # Two points tell nothing of the turn about the line through them.
            rotation, rotation_covariance = shortest_rotation(expected[:, 0], seen.across) @ expected, self._across
        if patch is not None:
            rotation, rotation_covariance = patch.rotation, patch.covariance
        return Evidence(
            base=_NOWHERE if seen.base is None else seen.base,
            base_covariance=base_covariance + self._floor,
            rotation=rotation,
            rotation_covariance=rotation_covariance,
            tips=seen.tips,
            tip_covariances=tip_covariances + self._floor,
            corner_noise=noise,
            patch=patch,
        )


_UNIT: Final = np.eye(3)
_WARP: Final = np.array([0.5, -0.5, 0.5, -0.5])
"""How far four corners leave their plane."""
_ALL_ROWS: Final = np.ones(21)
_ALL_ROWS.setflags(write=False)
_NOWHERE: Final = np.full(3, np.nan)
