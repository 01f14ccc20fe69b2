"""What straight fingers tell of a hand: residuals of the samples in which it is flat or bent at the knuckles only.

A straight finger's tip stays on a sphere about its knuckle, whose radius is the finger's length. One distance per
finger and sample is compared, so no sample has unknowns of its own: that would make every length drift, however many
samples there are. Each residual is in standard deviations:

    radial    |q − k| − (L − s)        q = T·Rᵀ·(tip − base) + b, the tip in the wrist frame; k knuckle, L its length
                                       to the marker, s slack of a finger that is not quite straight
    lateral   how far the tip leaves the finger's plane while the knuckle bends, about one mean abduction
    flat      flexion and abduction of the flat hand, zero on average

Without the corners of the patch the palm's rotation R is unknown, and only distances between markers of the flat hand
are compared with those of the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.rotations import nearest_rotation, rotation_from_vector
from rhot_calibration.hand.fit.parameters import (
    ABDUCTION,
    BONE_SD,
    PRIOR_SD,
    SLACK,
    SLACK_BENT,
    SLACK_M,
    TILT,
    TYPED_SD_M,
    HandParameters,
)
from rhot_calibration.hand.samples import HandSamples
from rhot_ik.hand.filter.patch_rotation import CORNER_ORDERS, MAX_ERROR_M

# How the palm is turned, from the four corners of the patch on the back of the hand.

_SMOOTHING_S: Final = 0.15
_REACH: Final = 12
_TWIST: Final = np.array([0.5, -0.5, 0.5, -0.5])
"""The corners of a plane rectangle cannot move along its normal like this: what they do so is noise."""


@dataclass(frozen=True, slots=True)
class PalmRotations:
    """How the palm is turned in N samples.

    Attributes:
        R: (N, 3, 3) patch to rig; NaN = not known.
        sigma_rad: (3,) standard deviation of a single sample's rotation about the patch's X, Y and Z axes, before
            smoothing over time.
    """

    R: FloatArray
    sigma_rad: FloatArray


def palm_rotations(samples: HandSamples, outline: FloatArray, viewpoint: FloatArray) -> PalmRotations:
    """Return the palm's rotations, lightly smoothed over time.

    Each is the least-squares rotation of the four corners (Kabsch 1976). Of the eight ways to go round a rectangle the
    one is taken whose normal points to the cameras and whose front to the fingertips. Noise of the single samples
    would shorten every average over them; smoothing over 0.15 s (a Gaussian's standard deviation) removes most of it.

    Args:
        samples: the markers.
        outline: (4, 3) metres: corners about the patch's centre, wrist frame.
        viewpoint: (3,) metres, rig frame: about where the cameras stand.
    """
    centred = samples.corners - samples.corners.mean(axis=1, keepdims=True)
    expected = _expected(samples, viewpoint)
    orders = centred[:, CORNER_ORDERS]
    gaps = ((orders - (outline @ np.swapaxes(expected, 1, 2))[:, None]) ** 2).sum(axis=(2, 3))
    known: BoolArray = np.asarray(np.isfinite(gaps).all(axis=1))
    best = np.argmin(np.where(known[:, None], gaps, 0.0), axis=1)
    found = orders[np.arange(len(samples)), best]
    R = np.full((len(samples), 3, 3), np.nan)
    R[known] = nearest_rotation(np.swapaxes(found[known], 1, 2) @ outline)
    missed = found - outline @ np.swapaxes(R, 1, 2)
    with np.errstate(invalid="ignore"):
        R[~(np.sqrt((missed**2).sum(axis=2).mean(axis=1)) <= MAX_ERROR_M)] = np.nan
    normal_miss = np.einsum("nki,ni->nk", missed, R[:, :, 1]) @ _TWIST
    seen = np.isfinite(normal_miss)
    sigma_m = 1.4826 * float(np.median(np.abs(normal_miss[seen]))) if seen.any() else np.nan
    least_corner_sigma_m = 0.0003
    sigma_m = max(sigma_m, least_corner_sigma_m)
    across, along = np.ptp(outline[:, 0]), np.ptp(outline[:, 2])
    # Depth is the noisy direction, and the patch faces the cameras: it turns most about its own two sides.
    sigma_rad = sigma_m / np.array([along, np.hypot(across, along), across])
    return PalmRotations(_smoothed(R, samples.seconds), sigma_rad)


def _expected(samples: HandSamples, viewpoint: FloatArray) -> FloatArray:
    """Return (N, 3, 3) a guess: −Z from the patch to the fingertips, +Y towards the cameras."""
    seen: BoolArray = np.asarray(np.isfinite(samples.tips[:, 1:]).all(axis=2))
    count = np.maximum(seen.sum(axis=1), 1)[:, None]
    middle = np.where(seen[..., None], samples.tips[:, 1:], 0.0).sum(axis=1) / count
    Z = np.where(seen.any(axis=1, keepdims=True), samples.base - middle, np.nan)
    Z /= np.linalg.norm(Z, axis=1, keepdims=True)
    X = np.cross(viewpoint - samples.base, Z)
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    frames: FloatArray = np.stack([X, np.cross(Z, X), Z], axis=2)
    return frames


def _smoothed(R: FloatArray, seconds: FloatArray) -> FloatArray:
    known: BoolArray = np.asarray(np.isfinite(R).all(axis=(1, 2)))
    filled = np.where(known[:, None, None], R, 0.0)
    total = np.zeros_like(filled)
    rows = np.arange(len(R))
    for shift in range(-_REACH, _REACH + 1):
        other = np.clip(rows + shift, 0, len(R) - 1)
        weight = np.exp(-0.5 * ((seconds[other] - seconds) / _SMOOTHING_S) ** 2) * (rows + shift == other)
        total += weight[:, None, None] * filled[other]
    smooth = np.full_like(R, np.nan)
    smooth[known] = nearest_rotation(total[known])
    return smooth


# The most probable hand, by least squares over few parameters, and what it leaves uncertain.

Residuals = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class HandFit:
    """The fitted hand.

    Attributes:
        x: (COUNT,) parameters.
        covariance: (COUNT, COUNT) of them, as the assumed noise has it.
    """

    x: FloatArray
    covariance: FloatArray


def fit(evidence: Residuals, parameters: HandParameters, x: FloatArray, typed_length_m: float | None) -> HandFit:
    """Return the maximum of the posterior near a start; its covariance is that of the linearised problem.

    Args:
        evidence: residuals in standard deviations at parameters (COUNT,).
        parameters: what is unknown of the hand.
        x: (COUNT,) to start from.
        typed_length_m: the hand's length as somebody measured it, where known.
    """

    def residuals(scores: FloatArray) -> FloatArray:
        trial = scores * PRIOR_SD
        shape = parameters.shape(trial)
        believed = [*scores, shape.middle_metacarpal / BONE_SD]
        if typed_length_m is not None:
            believed.append((shape.length - typed_length_m) / TYPED_SD_M)
        return np.concatenate([evidence(trial), believed])

    most_calls = 25
    found = least_squares(residuals, x / PRIOR_SD, xtol=1e-5, ftol=1e-4, max_nfev=most_calls)
    J = np.asarray(found.jac, dtype=np.float64)
    covariance = np.linalg.inv(J.T @ J) * PRIOR_SD * PRIOR_SD[:, None]
    return HandFit(np.asarray(found.x * PRIOR_SD), np.asarray(covariance))


SIGMA_FLAT_RAD: Final = np.radians([[15.0, 15.0], [6.0, 8.0], [6.0, 4.0], [6.0, 8.0], [6.0, 8.0]])
"""Mean flexion and abduction of the flat hand's fingers; the thumb lies where it likes."""
_SIGMA_MODEL_M: Final = 0.0003
"""What bending hinges and soft flesh add to a radius from moment to moment."""
_DEPTH_OVER_LATERAL: Final = 5.0
_NOISE_FACTOR: Final = 1.25
"""On the noise of points and rotations: what the linearised fit underrates, judged by simulated hands."""
_SIXTY_DEG: Final = np.radians(60.0)
SIGMA_WITHOUT_ROTATION_M: Final = 0.006
"""Of a distance between markers of a hand that is taken for flat because it reached furthest."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """Samples that show straight fingers.

    Attributes:
        rows: (N,) samples.
        flat: (N,) whether the hand is flat.
        use: (N, 5) which fingers are seen and straight.
    """

    rows: NDArray[np.intp]
    flat: BoolArray
    use: BoolArray


@dataclass(frozen=True, slots=True)
class Tips:
    """Fingertips about their knuckles under some parameters.

    Attributes:
        away: (N, 5, 3) metres: knuckle to tip marker, in the finger's rest frame.
        radius: (N, 5) metres.
        flexion: (N, 5) radians, of the straight line from knuckle to tip.
        deficit: (N, 5) metres by which the radius falls short of a straight finger's.
    """

    away: FloatArray
    radius: FloatArray
    flexion: FloatArray
    deficit: FloatArray


class PalmFrame:
    """Fingertips in the patch's frame, and how they depend on the hand.

    Args:
        parameters: what is unknown of the hand.
        samples: the markers.
        rotations: of the palm.
        viewpoint: (3,) metres, rig frame: about where the cameras stand.
    """

    def __init__(
        self, parameters: HandParameters, samples: HandSamples, rotations: PalmRotations, viewpoint: FloatArray
    ) -> None:
        self.parameters = parameters
        self.seconds = samples.seconds
        self.sigma_rotation_rad = _NOISE_FACTOR * rotations.sigma_rad
        self.local: FloatArray = (samples.tips - samples.base[:, None]) @ rotations.R
        self.known: BoolArray = np.asarray(np.isfinite(self.local).all(axis=2))
        toward = samples.base - viewpoint
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        self._sight: FloatArray = (toward[:, None] @ rotations.R)[:, 0]
        self._lateral_m = _NOISE_FACTOR * samples.sigma_m / np.sqrt(2.0 + _DEPTH_OVER_LATERAL**2)

    def tips(self, x: FloatArray, rows: NDArray[np.intp]) -> Tips:
        """Return the tips of some samples under parameters (COUNT,); NaN where not seen."""
        shape = self.parameters.shape(x)
        position = self.local[rows] @ rotation_from_vector(x[TILT]).T + shape.base
        away = np.einsum("nfi,fij->nfj", position - shape.knuckles, shape.frames)
        radius = np.linalg.norm(away, axis=2)
        flexion = np.arctan2(-away[..., 1], -away[..., 2])
        slack = SLACK_M + x[SLACK] + x[SLACK_BENT] * flexion / _SIXTY_DEG
        return Tips(away, radius, flexion, shape.straight - slack - radius)

    def covariance(self, x: FloatArray, rows: NDArray[np.intp]) -> FloatArray:
        """Return (N, 5, 5) square metres of the radii: noise of tips, and of base and rotation, which are common."""
        tips = self.tips(x, rows)
        radial = np.einsum("nfj,fij->nfi", tips.away / tips.radius[..., None], self.parameters.shape(x).frames)
        radial = np.nan_to_num(radial)
        local = np.nan_to_num(self.local[rows])
        depth = np.einsum("nfi,ni->nf", radial, self._sight[rows])
        lateral, far = self._lateral_m**2, (_DEPTH_OVER_LATERAL * self._lateral_m) ** 2
        own = lateral + (far - lateral) * depth**2 + _SIGMA_MODEL_M**2 * crowding(self.seconds[rows])
        by_rotation = np.cross(local, radial) * self.sigma_rotation_rad
        shared = lateral * radial @ np.swapaxes(radial, 1, 2) + (far - lateral) * depth[:, :, None] * depth[:, None, :]
        covariance: FloatArray = np.eye(5) * own[:, None, :] + shared + by_rotation @ np.swapaxes(by_rotation, 1, 2)
        return covariance


class StraightFingers:
    """Residuals of chosen samples, as functions of the parameters.

    Args:
        frame: fingertips in the patch's frame.
        chosen: which samples show which straight fingers.
        x: (COUNT,) parameters at which noise is judged.
    """

    def __init__(self, frame: PalmFrame, chosen: Chosen, x: FloatArray) -> None:
        self._frame, self._chosen = frame, chosen
        covariance = frame.covariance(x, chosen.rows)
        # An unseen finger becomes independent of the others and of no weight.
        both = chosen.use[:, :, None] & chosen.use[:, None, :]
        covariance = np.where(both, covariance, np.eye(5))
        self._whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        self.sigma_m: FloatArray = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        # Uncertainties stay as they are at the start: one that grew with the hand would draw it longer.
        tips = frame.tips(x, chosen.rows)
        self._sigma_lateral_m = self._lateral_sigma(tips)
        self._sigma_flat_m = SIGMA_FLAT_RAD * frame.parameters.shape(x).straight[:, None]

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return all residuals at parameters (COUNT,)."""
        chosen = self._chosen
        tips = self._frame.tips(x, chosen.rows)
        deficit = np.where(chosen.use, tips.deficit, 0.0)
        radial = (self._whiten @ deficit[..., None])[..., 0]
        return np.concatenate([radial.ravel(), self._lateral(x, tips), self._flat(tips)])

    def _lateral_sigma(self, tips: Tips) -> FloatArray:
        forward = tips.radius * np.cos(tips.flexion)
        height = tips.away[..., 1] * self._frame.sigma_rotation_rad[2]
        crowded = crowding(self._frame.seconds[self._chosen.rows])
        # Abduction of a moment about its mean.
        sigma: FloatArray = np.sqrt(((forward * np.radians(4.0)) ** 2 + _SIGMA_MODEL_M**2) * crowded + height**2)
        return sigma

    def _lateral(self, x: FloatArray, tips: Tips) -> FloatArray:
        # +Y of a finger's frame turned by the abduction takes its tip to −X on a right hand.
        sign = 1.0 if self._frame.parameters.side == "right" else -1.0
        expected = -sign * tips.radius * np.cos(tips.flexion) * np.sin(x[ABDUCTION])
        bending = ~self._chosen.flat[:, None] & self._chosen.use
        lateral = np.where(bending, (tips.away[..., 0] - expected) / self._sigma_lateral_m, 0.0)
        return np.asarray(lateral.ravel(), dtype=np.float64)

    def _flat(self, tips: Tips) -> FloatArray:
        flat = self._chosen.flat[:, None] & self._chosen.use
        count = np.maximum(flat.sum(axis=0), 1)[:, None]
        beside = np.where(flat[..., None], tips.away[..., (1, 0)], 0.0).sum(axis=0) / count
        return np.asarray((beside / self._sigma_flat_m).ravel())


class FlatDistances:
    """Residuals of a hand whose palm's rotation is unknown: distances between its markers while it is flat.

    Args:
        parameters: what is unknown of the hand.
        samples: those that show the hand flat.
    """

    def __init__(self, parameters: HandParameters, samples: HandSamples) -> None:
        self._parameters = parameters
        points = np.concatenate([samples.tips, samples.base[:, None]], axis=1)
        self._pairs = [(a, 5) for a in range(5)] + [(a, a + 1) for a in range(1, 4)]
        self._found: FloatArray = np.array(
            [np.nanmedian(np.linalg.norm(points[:, a] - points[:, b], axis=1)) for a, b in self._pairs]
        )
        # A thumb is anywhere, and so far apart as fingers are spread they do not tell their size.
        weak = [3.0 if 0 in pair else 1.0 if 5 in pair else 2.5 for pair in self._pairs]
        self._sigma: FloatArray = SIGMA_WITHOUT_ROTATION_M * np.array(weak)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the residuals at parameters (COUNT,)."""
        shape = self._parameters.shape(x)
        tips = shape.knuckles - shape.straight[:, None] * shape.frames[..., 2]
        positions = np.array([*tips, shape.base])
        modelled = np.array([np.linalg.norm(positions[a] - positions[b]) for a, b in self._pairs])
        return np.asarray(np.nan_to_num((self._found - modelled) / self._sigma), dtype=np.float64)


def crowding(seconds: FloatArray) -> float:
    """Return how many samples fall into one moment that shares what the model leaves out."""
    # Samples closer in time share what the model leaves out.
    return max(1.0, 0.3 / max(float(np.median(np.diff(seconds))), 1e-3)) if len(seconds) > 1 else 1.0
