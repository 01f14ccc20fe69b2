"""State of a hand's markers, the views in one frame, and the innovations of an update."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.geometry.camera import CameraModel

SHARED = 6
"""Numbers of a state beside the markers': linear and angular acceleration of the hand."""
ROUND: FloatArray = np.array([1.0, 0.0, 1.0])
"""xx, xy and yy of a covariance of 1 in every direction of a picture."""


@dataclass(frozen=True, slots=True)
class Views:
    """What one frame says of N markers.

    Attributes:
        camera: that took it.
        index: (N,) markers, ascending.
        delta_s: (N,) time of each after the frame's.
        xy: (N, 2) normalised image coordinates.
        variance: (N, 3) xx, xy and yy of their covariances.
        slack: (N,) standard deviation beyond that which the gate allows for, normalised units.
        certain: (N,) squared Mahalanobis distance beyond which not the view is doubted, but the marker is less certain
            than was stated; never when not given.
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
    """The M markers of a hand at one moment. Its arrays are never changed in place.

    Attributes:
        t_s: the moment.
        x: (6 M + 6,) positions, metres, marker by marker; their velocities, m/s; the linear acceleration of the hand,
            m/s², and its angular one, rad/s².
        P: (6 M + 6, 6 M + 6) covariance.
        weight: (K,) of the scales.
        alive: (M,) markers that are in it; the others' rows are zero.
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
    """How the N views of a frame differed from what was expected.

    Attributes:
        y: (N, 2) innovation, normalised units.
        S: (N, 3) xx, xy and yy of its covariance.
        nis: (N,) its squared Mahalanobis distance.
        accepted: (N,) whether it passed the gate.
        evidence: (K,) logarithm of the likelihood of each scale, but for a constant.
    """

    y: FloatArray
    S: FloatArray
    nis: FloatArray
    accepted: BoolArray
    evidence: FloatArray


@dataclass(frozen=True, slots=True)
class Step:
    """What a frame did, for smoothing.

    Attributes:
        dt_s: time since the step before.
        transition: (6 M + 6, 6 M + 6) of the state over that time.
        before: the state before its observations, with the noise of the way there.
        after: the state after them.
    """

    dt_s: float
    transition: FloatArray
    before: State
    after: State


def pace_squares(camera: CameraModel, velocity: FloatArray, depths: FloatArray) -> FloatArray:
    """Return xx, xy and yy (N, 3) of the pace of markers in a camera's picture, normalised units² per second².

    Times the variance of time stamps, it is what errors of these do to views.

    Args:
        camera: that sees them.
        velocity: (N, 3) metres per second, rig frame.
        depths: (N,) metres.
    """
    pace = velocity @ camera.R_camera_rig[:2].T / depths[:, None]
    squares: FloatArray = pace[:, (0, 0, 1)] * pace[:, (0, 1, 1)]
    return squares
