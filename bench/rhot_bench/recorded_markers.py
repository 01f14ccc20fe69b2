"""Recorded detections of one marker by a depth camera, with motion capture beside them (`d435_qualisys`).

Columns of a test: `t` seconds, `det` 1 = new detection, both solutions of the square's pose (`t0x…`, `r0x…` Rodrigues,
`err0`; the same with 1), metres, camera frame, and the truth (`gt…`, `gr…`, `gt_ok` 1 = there is one).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.errors import ConfigError
from rhot.rotations import rotation_from_vector, vector_from_rotation
from rhot_feet.marker_pose import SquareView, pose_covariance, square_corners
from rhot_feet.orientation_track import OrientationCandidate, OrientationTrack

FloatArray = NDArray[np.float64]

SIDE_M: Final = 0.050
FOCAL_PX: Final = 609.0
CORNER_SIGMA_PX: Final = 0.7
"""These corners were not refined: their poses scatter about the truth as with 0.7 px."""
ERROR_SIGMA_PX: Final = 0.12
"""Of a solution's reprojection error as the files state it."""
_PLACE_NOISE: Final = 0.6
"""Of places against what `CORNER_SIGMA_PX` says; their rare large errors are left to the gate."""
_ACCELERATION: Final = 1.0
"""Root of the spectral density of the acceleration, m/s^1.5."""
_GATE: Final = 1.5
"""Standard deviations."""
_GAP_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class MarkerTest:
    """New detections of one test for which there is a truth or not, in order.

    Attributes:
        t_s: (N,).
        R: (N, 2, 3, 3) both solutions, marker to camera.
        t_m: (N, 2, 3) their places, metres.
        error_px: (N, 2) reprojection errors.
        R_true: (N, 3, 3), NaN where there is none.
        t_true_m: (N, 3), NaN where there is none.
    """

    t_s: FloatArray
    R: FloatArray
    t_m: FloatArray
    error_px: FloatArray
    R_true: FloatArray
    t_true_m: FloatArray

    @property
    def known(self) -> NDArray[np.bool_]:
        """(N,) whether there is a truth."""
        known: NDArray[np.bool_] = np.isfinite(self.t_true_m[:, 0])
        return known

    def first(self, count: int) -> MarkerTest:
        """Return the first detections alone."""
        return MarkerTest(
            self.t_s[:count],
            self.R[:count],
            self.t_m[:count],
            self.error_px[:count],
            self.R_true[:count],
            self.t_true_m[:count],
        )


def read_marker_test(file: Path) -> MarkerTest:
    """Read a test.

    Raises:
        ConfigError: unreadable, or columns are missing; names the file.
    """
    try:
        table = np.genfromtxt(file, delimiter=",", names=True)
        table = table[table["det"] == 1]
        error_px = np.stack([table["err0"], table["err1"]], axis=1)
        t_m = np.stack([_vectors(table, "t0"), _vectors(table, "t1")], axis=1)
        R = np.stack([_rotations(_vectors(table, "r0")), _rotations(_vectors(table, "r1"))], axis=1)
        known = table["gt_ok"] == 1
        t_true_m = np.where(known[:, None], _vectors(table, "gt"), np.nan)
        R_true = np.full((len(table), 3, 3), np.nan)
        R_true[known] = _rotations(_vectors(table, "gr")[known])
    except (OSError, ValueError, IndexError) as error:
        raise ConfigError(f"{file}: not a table of marker detections: {error}") from error
    return MarkerTest(np.asarray(table["t"], dtype=np.float64), R, t_m, error_px, R_true, t_true_m)


def _vectors(table: NDArray[np.void], name: str) -> FloatArray:
    return np.stack([table[f"{name}{axis}"] for axis in "xyz"], axis=1).astype(np.float64)


def _rotations(vectors: FloatArray) -> FloatArray:
    return np.stack([rotation_from_vector(vector) for vector in vectors]) if len(vectors) else np.empty((0, 3, 3))


def turns_deg(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the angles (N,), degrees, between rotations (N, 3, 3)."""
    return np.array(
        [np.degrees(np.linalg.norm(vector_from_rotation(a @ b.T))) for a, b in zip(first, second, strict=True)]
    )


def choose_solutions(test: MarkerTest) -> NDArray[np.intp]:
    """Return which solution (N,) of each detection the orientation track believes, each from its past alone."""
    track = OrientationTrack()
    chosen = np.zeros(len(test.t_s), dtype=np.intp)
    costs = (test.error_px / ERROR_SIGMA_PX) ** 2
    for number, t_s in enumerate(test.t_s.tolist()):
        covariances = _covariances(test, number)
        chosen[number] = track.feed(
            t_s,
            [
                OrientationCandidate(test.R[number, which], covariances[which, :3, :3], float(costs[number, which]))
                for which in (0, 1)
            ],
        )
    return chosen


def filter_places(test: MarkerTest, scale: float = 1.0) -> FloatArray:
    """Return filtered places (N, 3), metres, each from its past alone.

    A constant-velocity Kalman filter; a detection's covariance is that of its corners, and one that lies outside of the
    gate counts for as little as it takes to come inside.

    Args:
        test: detections.
        scale: true over stated distance; a marker printed too small is read too far away.
    """
    places = np.empty((len(test.t_s), 3))
    state, P, before_s = np.zeros(6), np.eye(6), -np.inf
    for number, t_s in enumerate(test.t_s.tolist()):
        measured = scale * test.t_m[number, 0]
        noise = _PLACE_NOISE**2 * _covariances(test, number)[0, 3:, 3:]
        dt = t_s - before_s
        before_s = t_s
        if dt > _GAP_S:
            state, P = np.concatenate([measured, np.zeros(3)]), np.diag([0.0, 0.0, 0.0, 0.25, 0.25, 0.25])
            P[:3, :3] = noise
        else:
            F = np.eye(6)
            F[:3, 3:] = dt * np.eye(3)
            Q = np.kron(np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]), _ACCELERATION**2 * np.eye(3))
            state, P = F @ state, F @ P @ F.T + Q
            innovation = measured - state[:3]
            S = P[:3, :3] + noise
            distance = float(np.sqrt(innovation @ np.linalg.solve(S, innovation)))
            S += noise * max(0.0, (distance / _GATE) ** 2 - 1.0)
            gain = P[:, :3] @ np.linalg.inv(S)
            state = state + gain @ innovation
            P = P - gain @ P[:3, :]
        places[number] = state[:3]
    return places


def _covariances(test: MarkerTest, number: int) -> FloatArray:
    """Return the covariances (2, 6, 6) of both solutions of a detection."""
    t = test.t_m[number]
    view = SquareView(np.zeros((4, 2)), CORNER_SIGMA_PX / FOCAL_PX, square_corners(SIDE_M), test.R[number], t, 0.0)
    return pose_covariance(view)
