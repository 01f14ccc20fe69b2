"""State of a hand's markers, the views in one frame, and the innovations of an update."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.geometry.camera import CameraModel

SHARED = 6
"""Number of shared components of a state: linear and angular acceleration of the hand."""
ROUND: FloatArray = np.array([1.0, 0.0, 1.0])
"""xx, xy and yy of an isotropic unit covariance in the image."""


@dataclass(frozen=True, slots=True)
class Views:
    """One frame's observations of N markers.

    Attributes:
        camera: the camera.
        index: (N,) markers, ascending.
        delta_s: (N,) time of each after the frame's.
        xy: (N, 2) normalised image coordinates.
        variance: (N, 3) xx, xy and yy of their covariances.
        slack: (N,) additional standard deviation used by the gate only, normalised units.
        certain: (N,) squared Mahalanobis distance beyond which the marker's covariance is inflated instead of the
            observation's; None = never.
    """

    camera: CameraModel
    index: IndexArray
    delta_s: FloatArray
    xy: FloatArray
    variance: FloatArray
    slack: FloatArray
    certain: FloatArray | None = None

    def chosen(self, chosen: BoolArray) -> Views:
        """Return some (N,) of the views."""
        return Views(
            self.camera,
            self.index[chosen],
            self.delta_s[chosen],
            self.xy[chosen],
            self.variance[chosen],
            self.slack[chosen],
            None if self.certain is None else self.certain[chosen],
        )


@dataclass(frozen=True, slots=True)
class State:
    """State estimate of a hand's M markers. Its arrays are never changed in place.

    Attributes:
        t_s: time, seconds.
        x: (6 M + 6,) positions, metres, marker by marker; velocities, m/s; linear acceleration of the hand, m/s²;
            angular acceleration, rad/s².
        P: (6 M + 6, 6 M + 6) covariance.
        weight: (K,) of the acceleration scales.
        alive: (M,) whether a marker is tracked; rows of the others are zero.
    """

    t_s: float
    x: FloatArray
    P: FloatArray
    weight: FloatArray
    alive: BoolArray

    @property
    def spread_m2(self) -> FloatArray:
        """(M,) traces of the covariances of the positions, square metres."""
        spread: FloatArray = self.P.diagonal()[: 3 * len(self.alive)].reshape(-1, 3).sum(axis=1)
        return spread

    @property
    def mean(self) -> FloatArray:
        """(2, 3 M) positions and velocities."""
        mean: FloatArray = self.x[:-SHARED].reshape(2, -1)
        return mean

    @property
    def covariance(self) -> FloatArray:
        """(6 M, 6 M) of positions and velocities."""
        covariance: FloatArray = self.P[:-SHARED, :-SHARED]
        return covariance


@dataclass(frozen=True, slots=True)
class Innovation:
    """Innovations of a frame's N views.

    Attributes:
        y: (N, 2) innovation, normalised units.
        S: (N, 3) xx, xy and yy of its covariance.
        nis: (N,) its squared Mahalanobis distance.
        accepted: (N,) whether it passed the gate.
        evidence: (K,) log-likelihood of each scale, up to a constant.
    """

    y: FloatArray
    S: FloatArray
    nis: FloatArray
    accepted: BoolArray
    evidence: FloatArray


@dataclass(frozen=True, slots=True)
class FilterStep:
    """One filter step, as needed for smoothing.

    Attributes:
        dt_s: time since the previous step.
        transition: (6 M + 6, 6 M + 6) state transition over that time.
        before: predicted state, process noise included.
        after: updated state.
    """

    dt_s: float
    transition: FloatArray
    before: State
    after: State


def pace_squares(camera: CameraModel, velocity: FloatArray, depths: FloatArray) -> FloatArray:
    """Return xx, xy and yy (N, 3) of the squared image velocities of markers, normalised units² per second².

    Multiplied by the variance of the time stamps, this is the covariance of the views caused by time-stamp errors.

    Args:
        camera: the camera.
        velocity: (N, 3) metres per second, rig frame.
        depths: (N,) metres.
    """
    pace = velocity @ camera.R_camera_rig[:2].T / depths[:, None]
    squares: FloatArray = pace[:, (0, 0, 1)] * pace[:, (0, 1, 1)]
    return squares
