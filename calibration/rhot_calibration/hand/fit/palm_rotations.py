"""How the palm is turned, from the four corners of the patch on the back of the hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.rotations import nearest_rotation
from rhot_calibration.hand.samples.samples import HandSamples
from rhot_ik.hand.filter.patch_rotation import CORNER_ORDERS, MAX_ERROR_M

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
