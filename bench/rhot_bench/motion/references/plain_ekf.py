"""The causal reference: one extended Kalman filter per marker, forty lines, nothing else.

State: position and velocity; constant velocity with white acceleration alike in all directions; every view counts at
its own row's time, however late it comes within its frame; a wide gate. It starts at the triangulation of the first
two views from two cameras that lie within a frame period of each other.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_bench.motion.references.spline_reference import SplineViews, triangulated
from rhot_tools.measures.points import MEASURED, ONE_VIEW, PREDICTED, Estimates

# Acceleration, pixels and gate were set before the tracker was measured, and stay.
_ACCELERATION: Final = 2.0
"""Root of the spectral density of white acceleration, m/s² per √Hz."""
_PIXEL_PX: Final = 0.3
"""Standard deviation of a view, pixels."""
_VELOCITY_M_S: Final = 1.0
"""Standard deviation of each component at the start; hands in the recordings reach 1 to 2 m/s."""
_HOLD_S: Final = 0.25
"""How long a marker is told of after its last view, and followed by one camera alone."""
_NEAREST_M = 0.1
"""No camera sees a marker that is nearer; it stands before the lens then."""


class _Marker:
    def __init__(self) -> None:
        self.t_s = 0.0
        self.x: FloatArray | None = None
        self.P = np.zeros((6, 6))
        self.last: dict[int, tuple[float, FloatArray]] = {}
        self.refused: dict[int, int] = {}

    def predict(self, t_s: float) -> tuple[FloatArray, FloatArray]:
        """Return state and covariance at a time; views may come a little out of order, so dt may be negative."""
        assert self.x is not None
        dt = t_s - self.t_s
        F = np.eye(6)
        F[:3, 3:] = dt * np.eye(3)
        q, size = _ACCELERATION**2, abs(dt)
        Q = np.kron(np.array([[size**3 / 3.0, dt * size / 2.0], [dt * size / 2.0, size]]), np.eye(3)) * q
        return F @ self.x, F @ self.P @ F.T + Q

    def update(self, camera: int, t_s: float, xy: FloatArray, views: SplineViews) -> None:
        """Take one view."""
        others = [seen_s for other, (seen_s, _) in self.last.items() if other != camera]
        if self.x is not None and t_s - max(others, default=-np.inf) > _HOLD_S:
            # A single view tells nothing of depth, in which white acceleration spreads by decimetres within `_HOLD_S`.
            self.x, self.last, self.refused = None, {}, {}
        if self.x is None:
            self.last[camera] = (t_s, xy)
            self._start(views)
            return
        x, P = self.predict(t_s)
        R, t = views.P[camera, :, :3], views.P[camera, :, 3]
        X = R @ x[:3] + t
        H = np.zeros((2, 6))
        H[:, :3] = (R[:2] - np.outer(X[:2] / X[2], R[2])) / X[2]
        innovation = xy - X[:2] / X[2]
        S = H @ P @ H.T + np.eye(2) * (_PIXEL_PX / views.focal_px[camera]) ** 2
        gain = np.linalg.solve(S, H @ P).T
        # Ten sigma; a marker starts again after five refused views in a row.
        if X[2] < _NEAREST_M or innovation @ np.linalg.solve(S, innovation) > 100.0:
            self.refused[camera] = self.refused.get(camera, 0) + 1
            if self.refused[camera] > 4:
                self.x, self.last, self.refused = None, {camera: (t_s, xy)}, {}
            return
        self.x, self.t_s = x + gain @ innovation, t_s
        # Joseph's form: with depth a thousand times less sure than pixels, P − K·H·P does not stay positive.
        kept = np.eye(6) - gain @ H
        noise = (_PIXEL_PX / views.focal_px[camera]) ** 2
        self.P = kept @ P @ kept.T + noise * gain @ gain.T
        self.last[camera], self.refused[camera] = (t_s, xy), 0

    def _start(self, views: SplineViews) -> None:
        newest = max(t_s for t_s, _ in self.last.values())
        fresh = {c: v for c, v in self.last.items() if newest - v[0] <= 1.01 * views.period_s[c]}
        if len(fresh) < 2:
            return
        xy = np.full((1, len(views.P), 2), np.nan)
        for camera, (_, seen) in fresh.items():
            xy[0, camera] = seen
        position = triangulated(xy, views.P)[0]
        apart_s = max(newest - t_s for t_s, _ in fresh.values())
        camera = next(iter(fresh))
        depth = float(views.P[camera, 2, :3] @ position + views.P[camera, 2, 3])
        if not _NEAREST_M < depth < 3.0:
            return
        # Views out of step by a time triangulate to a point that is wrong by speed times this, and far more in depth.
        wrong_m = _VELOCITY_M_S * apart_s * depth / _baseline(views, list(fresh)) + 0.005
        self.x, self.t_s = np.concatenate([position, np.zeros(3)]), newest
        self.P = np.diag([wrong_m**2] * 3 + [_VELOCITY_M_S**2] * 3)


def _baseline(views: SplineViews, cameras: list[int]) -> float:
    centres = np.array([-views.P[c, :, :3].T @ views.P[c, :, 3] for c in cameras])
    return float(np.linalg.norm(centres[0] - centres[-1]))


def plain_ekf(views: SplineViews, frames: int, markers: int) -> Estimates:
    """Return what the filter tells after each marker frame, at the median time of that frame's views.

    Args:
        views: in order of arrival.
        frames: number of marker frames.
        markers: number of markers.
    """
    filters = [_Marker() for _ in range(markers)]
    origin = int(views.t_ns.min()) if len(views.t_ns) else 0
    rows = []
    for frame in range(frames):
        mine = range(*np.searchsorted(views.frame, [frame, frame + 1]))
        if not mine:
            continue
        for row in mine:
            t_s = (int(views.t_ns[row]) - origin) * 1e-9
            filters[views.marker[row]].update(int(views.camera[row]), t_s, views.xy[row], views)
        t_ns = int(np.median(views.t_ns[mine.start : mine.stop]))
        t_s = (t_ns - origin) * 1e-9
        for number, one in enumerate(filters):
            ages = sorted(t_s - seen_s for seen_s, _ in one.last.values())
            if one.x is None or not ages or ages[0] > _HOLD_S:
                continue
            recent = sum(age <= 1.5 * float(views.period_s.max()) for age in ages)
            x, P = one.predict(t_s)
            rows.append((t_ns, number, x[:3], P[:3, :3], (PREDICTED, ONE_VIEW, MEASURED)[min(recent, 2)]))
    t, marker, position, covariance, state = zip(*rows, strict=True) if rows else ((), (), (), (), ())
    return Estimates(
        np.array(t, dtype=np.int64),
        np.array(marker, dtype=np.int64),
        np.array(position, dtype=np.float64).reshape(-1, 3),
        np.array(covariance, dtype=np.float64).reshape(-1, 3, 3),
        np.array(state, dtype=np.int64),
    )
