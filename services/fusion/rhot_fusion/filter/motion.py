"""How the markers of one hand move together.

Each marker has constant velocity driven by white acceleration (Bar-Shalom, Li and Kirubarajan, "Estimation with
Applications to Tracking and Navigation", 2001, section 6.2.2). The accelerations of the markers of a hand are
correlated, for they share the hand's translation and rotation. With r the place about the middle of the hand's markers,

    cov(a_i, a_j) = s² (common² I + turning² [r_i]× [r_j]×ᵀ + own² δ_ij I),

so that what one marker does tells of the others, seen or hidden. The scale s is not known and changes: a still hand is
averaged over many frames, a fast one is followed at once. It is one of a few values, weighed by how well each foretells
the observations, and forgotten within `switch_s`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rhot_fusion.filter.settings import MotionSettings

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]

_EYE: FloatArray = np.eye(3)


def acceleration_covariance(place: FloatArray, settings: MotionSettings) -> FloatArray:
    """Return the covariance (3 M, 3 M) of the accelerations of markers at places (M, 3), metres, for s = 1."""
    count = len(place)
    arm = arms(place, settings)
    # [a]× [b]×ᵀ = (a·b) I − b aᵀ
    turning2 = settings.turning**2
    C = np.einsum("ja,ib->iajb", arm, arm) * -turning2
    shared = turning2 * (arm @ arm.T) + settings.common**2
    shared[np.diag_indices(count)] += settings.own**2
    C += shared[:, None, :, None] * _EYE[:, None, :]
    covariance: FloatArray = C.reshape(3 * count, 3 * count)
    return covariance


def arms(place: FloatArray, settings: MotionSettings) -> FloatArray:
    """Return the places (M, 3) about their middle, none longer than `longest_arm_m`."""
    arm: FloatArray = place - place.mean(axis=0)
    length = np.sqrt((arm * arm).sum(axis=1))
    arm *= np.minimum(1.0, settings.longest_arm_m / np.maximum(length, 1e-9))[:, None]
    return arm
