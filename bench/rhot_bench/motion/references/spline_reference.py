"""The offline reference: a cubic spline per camera and marker through the row times, and triangulation.

Nothing but interpolation: no model of motion, noise or the hand. It sees past and future and is what `--smooth` has to
beat on the same tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from rhot.arrays import FloatArray, IntArray
from rhot.messages import MarkerFrame
from rhot.rig import Rig
from rhot.rig.cameras import camera_model
from rhot_tools.measures.points import MEASURED, Estimates

# The markers of many frames as arrays: one row per camera, marker and frame, lenses undone.


@dataclass(frozen=True, slots=True)
class SplineViews:
    """N observations of markers, in the order in which their frames came.

    Attributes:
        frame: (N,) number of the marker frame in the list.
        camera: (N,) index in `cameras`.
        marker: (N,) index in the list of marker names.
        t_ns: (N,) mid-exposure of the marker's own row.
        xy: (N, 2) normalised image coordinates, lens undone with the calibration that the rig states.
        P: (C, 3, 4) maps rig coordinates to camera coordinates, per camera.
        focal_px: (C,) mean focal length, pixels.
        period_s: (C,) median distance of a camera's frames.
    """

    frame: IntArray
    camera: IntArray
    marker: IntArray
    t_ns: IntArray
    xy: FloatArray
    P: FloatArray
    focal_px: FloatArray
    period_s: FloatArray


def views_of(frames: Sequence[MarkerFrame], rig: Rig) -> SplineViews:
    """Return all observations of marker frames as the rig's own calibration reads them."""
    models = [camera_model(camera) for camera in rig.cameras.values()]
    index = {name: number for number, name in enumerate(rig.cameras)}
    markers = {name: number for number, name in enumerate(rig.config.markers)}
    rows = [
        (number, index[frame.camera], markers[name], marker.t_ns or frame.t_ns, marker.u, marker.v)
        for number, frame in enumerate(frames)
        for name, marker in frame.markers.items()
    ]
    table = np.array([row[:4] for row in rows], dtype=np.int64).reshape(-1, 4)
    uv = np.array([row[4:] for row in rows], dtype=np.float64).reshape(-1, 2)
    xy = np.empty_like(uv)
    for number, model in enumerate(models):
        mine = table[:, 1] == number
        xy[mine] = model.undistort(uv[mine])
    times = [np.array([frame.t_ns for frame in frames if frame.camera == name]) for name in rig.cameras]
    return SplineViews(
        table[:, 0],
        table[:, 1],
        table[:, 2],
        table[:, 3],
        xy,
        np.stack([np.column_stack([model.R_camera_rig, model.t_camera_rig]) for model in models]),
        np.array([0.5 * (model.K[0, 0] + model.K[1, 1]) for model in models]),
        np.array([float(np.median(np.diff(t))) * 1e-9 if len(t) > 1 else 0.0 for t in times]),
    )


def triangulated(xy: FloatArray, P: FloatArray) -> FloatArray:
    """Return points (N, 3), metres, rig frame, nearest to their rays in normalised image coordinates.

    Each view gives two rows (P1 − x·P3)·X = 0 and (P2 − y·P3)·X = 0, weighted by one over the depth of the round before
    (Hartley and Sturm 1997, iterative linear least squares).

    Args:
        xy: (N, C, 2) views; NaN = not seen by that camera. Points with fewer than two views are NaN.
        P: (C, 3, 4) rig to camera.
    """
    seen = np.isfinite(xy[..., 0])
    enough = seen.sum(axis=1) >= 2
    found = np.full((len(xy), 3), np.nan)
    if not enough.any():
        return found
    rows = P[None, :, :2] - np.where(seen[..., None], xy, 0.0)[..., None] * P[None, :, 2:]
    rows = (rows * seen[..., None, None])[enough]
    depth = np.ones((len(rows), len(P)))
    X = np.empty((len(rows), 3))
    for _ in range(3):
        A = (rows / depth[..., None, None]).reshape(len(rows), -1, 4)
        normal = np.swapaxes(A[..., :3], 1, 2) @ A[..., :3]
        X = np.linalg.solve(normal, -np.swapaxes(A[..., :3], 1, 2) @ A[..., 3:])[..., 0]
        depth = np.maximum(np.einsum("cj,nj->nc", P[:, 2, :3], X) + P[:, 2, 3], 0.05)
    found[enough] = X
    return found


_SHORTEST: Final = 4
"""A cubic needs four points; shorter tracks are left out."""


_GAP_PERIODS: Final = 4.5
"""Frame periods between two views of one camera over which its spline is still read; chosen so that three frames lost
in a row (once in 125 at the worst loss of the family, 20 %) do not break it."""


def spline_reference(views: SplineViews, markers: int) -> Estimates:
    """Return the points at every row time of every camera at which another camera's spline can be read."""
    origin = int(views.t_ns.min()) if len(views.t_ns) else 0
    parts: list[tuple[IntArray, IntArray, FloatArray]] = []
    for marker in range(markers):
        of_marker = np.flatnonzero(views.marker == marker)
        if not len(of_marker):
            continue
        t_ns = views.t_ns[of_marker]
        t_s = (t_ns - origin) * 1e-9
        xy = np.full((len(of_marker), len(views.P), 2), np.nan)
        for camera in range(len(views.P)):
            own = views.camera[of_marker] == camera
            xy[own, camera] = views.xy[of_marker[own]]
            if own.sum() >= _SHORTEST:
                longest_s = _GAP_PERIODS * views.period_s[camera]
                xy[~own, camera] = _read(t_s[own], views.xy[of_marker[own]], t_s[~own], longest_s)
        found = triangulated(xy, views.P)
        there = np.isfinite(found[:, 0])
        parts.append((t_ns[there], np.full(int(there.sum()), marker), found[there]))
    if not parts:
        return _estimates(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)))
    t_all, marker_all, position = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(t_all, kind="stable")
    return _estimates(t_all[order], marker_all[order], position[order])


def _estimates(t_ns: IntArray, marker: IntArray, position: FloatArray) -> Estimates:
    count = len(t_ns)
    return Estimates(t_ns, marker, position, np.full((count, 3, 3), np.nan), np.full(count, MEASURED))


def _read(t_s: FloatArray, xy: FloatArray, wanted_s: FloatArray, longest_s: float) -> FloatArray:
    """Return the spline (M, 2) through xy (N, 2) at times (M,); NaN outside and where views are too far apart."""
    read = np.full((len(wanted_s), 2), np.nan)
    # A gap breaks the track: through a longer one a cubic swings far out, on either side of it too.
    breaks = np.flatnonzero(np.diff(t_s) > longest_s) + 1
    for part in np.split(np.arange(len(t_s)), breaks):
        if len(part) < _SHORTEST:
            continue
        inside = (wanted_s >= t_s[part[0]]) & (wanted_s <= t_s[part[-1]])
        read[inside] = CubicSpline(t_s[part], xy[part])(wanted_s[inside])
    return read
