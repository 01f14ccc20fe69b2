"""How observations differ from what the filters of `motion_bank` expect, to first order about their joint estimate.

With H the derivative of an observation and r its distance from what the joint estimate foretells, for a filter of
covariance P whose mean lies d beside the joint one:

    B = (P H', d H' − r),    S = H P H' + V.

An error of time σ_t between a camera's views and the others' is noise along the motion w through the picture, so

    V = σ² I + σ_t² w w'.

What is one number for each marker is computed without numpy, whose calls cost more than the sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel
from rhot_fusion.views.vectors import Vector, vector

FloatArray = NDArray[np.float64]

_NEAREST_M: Final = 1e-2
"""A marker on or behind the image plane has no useful derivative; its innovation refuses it."""
_NEAREST_PACE_M: Final = 0.1
"""Depth from which on speeds are turned into those through the picture."""


@dataclass(frozen=True, slots=True)
class Eye:
    """A camera in plain numbers: X_camera = R · X_rig + t.

    Attributes:
        right, down, ahead: the rows of R.
        t: metres.
    """

    right: Vector
    down: Vector
    ahead: Vector
    t: Vector

    @classmethod
    def of(cls, camera: CameraModel) -> Eye:
        """Return the numbers of a camera."""
        right, down, ahead = map(vector, camera.R_camera_rig)
        return cls(right, down, ahead, vector(camera.t_camera_rig))


@dataclass(frozen=True, slots=True)
class Innovation:
    """How observations of N markers differ from what K filters expect.

    Attributes:
        y: (N, 2) innovation, the filters together, normalised units.
        B: (N, K, 7, 2) covariance between state and observation; in the last row the innovation's negative.
        S: (N, K, 2, 2) innovation covariance.
        det: (N, K) its determinant.
    """

    y: FloatArray
    B: FloatArray
    S: FloatArray
    det: FloatArray

    def of(self, chosen: NDArray[np.bool_]) -> Innovation:
        """Return the same of the chosen (N,) markers."""
        return Innovation(self.y[chosen], self.B[chosen], self.S[chosen], self.det[chosen])


def pace(eye: Eye, mean: Sequence[float]) -> tuple[float, float]:
    """Return how fast a marker of state (6,) moves through the picture, normalised units per second."""
    _, _, z, u, v, w = mean
    (a, b, c), (d, e, f) = eye.right, eye.down
    depth = max(z, _NEAREST_PACE_M)
    return (a * u + b * v + c * w) / depth, (d * u + e * v + f * w) / depth


def innovate(
    mean: Sequence[Sequence[float]],
    filters: FloatArray,
    eye: Eye,
    xy: Sequence[Sequence[float]],
    variance: Sequence[tuple[float, float, float]],
) -> Innovation:
    """Compare observations with a forecast.

    Args:
        mean: (N, 6) joint estimates, metres and metres per second, rig frame.
        filters: (N, K, 7, 6) covariances of the filters and in the last row their means less the joint one.
        eye: of the camera.
        xy: (N, 2) observed normalised image coordinates.
        variance: (N, 3) of the observations: of x, of both together, of y.
    """
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22), (t0, t1, t2) = eye.right, eye.down, eye.ahead, eye.t
    rows = []
    for (x, y, z, *_), (u, v), (xx, xy_, yy) in zip(mean, xy, variance, strict=True):
        inverse = 1.0 / max(r20 * x + r21 * y + r22 * z + t2, _NEAREST_M)
        p, q = (r00 * x + r01 * y + r02 * z + t0) * inverse, (r10 * x + r11 * y + r12 * z + t1) * inverse
        a, b, c = (r00 - p * r20) * inverse, (r01 - p * r21) * inverse, (r02 - p * r22) * inverse
        d, e, f = (r10 - q * r20) * inverse, (r11 - q * r21) * inverse, (r12 - q * r22) * inverse
        rows.append((a, b, c, d, e, f, a, d, b, e, c, f, xx, xy_, xy_, yy, u - p, v - q))
    count, models = filters.shape[:2]
    numbers = np.array(rows)
    H, Ht, V, y_ = (
        numbers[:, :6].reshape(count, 1, 2, 3),
        numbers[:, 6:12].reshape(count, 3, 2),
        numbers[:, 12:16].reshape(count, 1, 2, 2),
        numbers[:, 16:],
    )
    B = (filters.reshape(count, models * 7, 6)[:, :, :3] @ Ht).reshape(count, models, 7, 2)
    B[:, :, -1] -= y_[:, None]
    S = H @ B[:, :, :3]
    S += V
    entries = S.reshape(count, models, 4)
    crossed = entries * entries[:, :, ::-1]
    return Innovation(y_, B, S, crossed[:, :, 0] - crossed[:, :, 1])
