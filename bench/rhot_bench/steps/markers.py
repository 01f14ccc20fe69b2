"""Recorded detections of one marker by a depth camera, with motion capture beside them (`d435_qualisys`).

Columns of a test: `t` seconds, `det` 1 = new detection, both solutions of the square's pose (`t0x…`, `r0x…` Rodrigues,
`err0`; the same with 1), metres, camera frame, and the truth (`gt…`, `gr…`, `gt_ok` 1 = there is one).

The solutions were made from corners in whole pixels, as OpenCV's detector finds them without refinement: the first
solution, projected and rounded, gives them back. Such corners are the centres of the outermost black pixels and so lie
inside the black square by `INSET_PX`; the square looks smaller and farther away, by 3 % at 1.2 m. The feet's own
detector refines its corners and has no such inset.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation
from rhot_feet.filter.foot_filter import FootFilter
from rhot_feet.frames import pinhole
from rhot_feet.marker.orientation_track import OrientationTrack
from rhot_feet.marker.pose import marker_poses, square_corners, view_square

SIDE_M: Final = 0.050
INSET_PX: Final = 0.42
"""Measured on photographs of other markers, between whole-pixel corners and the edges that `refine_corners` finds."""
CORNER_SIGMA_PX: Final = 0.42
"""Of whole-pixel corners, per axis."""
TILTS_DEG: Final = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 90.0)
LEAST_DETECTIONS: Final = 25
"""Fewer in a band say nothing about shares of a few per cent."""
CAMERA: Final = pinhole(
    848,
    480,
    np.array([[608.76301751, 0.0, 429.37397121], [0.0, 609.23981796, 232.71315263], [0.0, 0.0, 1.0]]),
    np.empty(0),
)
"""As `tests.json` states it."""


@dataclass(frozen=True, slots=True)
class MarkerTest:
    """New detections of one test for which there is a truth or not, in order.

    Attributes:
        t_s: (N,).
        R: (N, 2, 3, 3) both solutions, marker to camera.
        t_m: (N, 2, 3) their positions, metres.
        R_true: (N, 3, 3), NaN where there is none.
        t_true_m: (N, 3), NaN where there is none.
    """

    t_s: FloatArray
    R: FloatArray
    t_m: FloatArray
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
            self.t_s[:count], self.R[:count], self.t_m[:count], self.R_true[:count], self.t_true_m[:count]
        )


@dataclass(frozen=True, slots=True)
class FollowedMarker:
    """What the feet's own code makes of the detections, each answer from the past alone.

    Attributes:
        chosen: (N,) which of the two solutions is believed.
        clear: (N,) whether it is said to be clear.
        t_m: (N, 3) filtered positions, metres, camera frame.
    """

    chosen: NDArray[np.intp]
    clear: NDArray[np.bool_]
    t_m: FloatArray


@dataclass(frozen=True, slots=True)
class MarkerFigures:
    """How well a marker was followed, over the detections with a truth.

    Attributes:
        right: share whose believed solution is the one nearer to the true orientation.
        first_right: the same of the first solution.
        mean_m: mean distance of the filtered positions from the truth.
        first_mean_m: the same of the first solution.
        rms_m: root mean square distance of the filtered positions from the truth.
        first_rms_m: the same of the first solution.
    """

    right: float
    first_right: float
    mean_m: float
    first_mean_m: float
    rms_m: float
    first_rms_m: float


def read_marker_test(file: Path) -> MarkerTest:
    """Read a test.

    Raises:
        ConfigError: unreadable, or columns are missing; names the file.
    """
    try:
        table = np.genfromtxt(file, delimiter=",", names=True)
        table = table[table["det"] == 1]
        t_m = np.stack([_vectors(table, "t0"), _vectors(table, "t1")], axis=1)
        R = np.stack([_rotations(_vectors(table, "r0")), _rotations(_vectors(table, "r1"))], axis=1)
        known = table["gt_ok"] == 1
        t_true_m = np.where(known[:, None], _vectors(table, "gt"), np.nan)
        R_true = np.full((len(table), 3, 3), np.nan)
        R_true[known] = _rotations(_vectors(table, "gr")[known])
    except (OSError, ValueError, IndexError) as error:
        raise ConfigError(f"{file}: not a table of marker detections: {error}") from error
    return MarkerTest(np.asarray(table["t"], dtype=np.float64), R, t_m, R_true, t_true_m)


def _vectors(table: NDArray[np.void], name: str) -> FloatArray:
    return np.stack([table[f"{name}{axis}"] for axis in "xyz"], axis=1).astype(np.float64)


def _rotations(vectors: FloatArray) -> FloatArray:
    return np.stack([rotation_from_vector(vector) for vector in vectors]) if len(vectors) else np.empty((0, 3, 3))


def edge_corners(test: MarkerTest) -> FloatArray:
    """Return the corners (N, 4, 2), pixels, of the black square: the detector's whole pixels, moved out."""
    points = square_corners(SIDE_M) @ np.swapaxes(test.R[:, 0], 1, 2) + test.t_m[:, 0, None]
    return move_edges(np.rint(CAMERA.project(points.reshape(-1, 3))).reshape(-1, 4, 2), INSET_PX)


def move_edges(corners: FloatArray, by_px: float) -> FloatArray:
    """Return quadrilaterals (N, 4, 2) whose edges lie `by_px` farther out.

    Args:
        corners: (N, 4, 2) pixels, clockwise in the picture, as the detector orders a marker's.
        by_px: outwards.
    """
    along = np.roll(corners, -1, axis=1) - corners
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    after = np.stack([along[..., 1], -along[..., 0]], axis=2)
    before = np.roll(after, 1, axis=1)
    moved: FloatArray = corners + by_px * (before + after) / (1.0 + (before * after).sum(axis=2, keepdims=True))
    return moved


def follow_marker(test: MarkerTest) -> FollowedMarker:
    """Follow the marker as feet are followed that nothing else is known of: poses, orientation track, foot filter."""
    track, positions = OrientationTrack(), FootFilter()
    chosen, clear = np.zeros(len(test.t_s), dtype=np.intp), np.zeros(len(test.t_s), dtype=np.bool_)
    t_m = np.full((len(test.t_s), 3), np.nan)
    for number, (t_s, corners) in enumerate(zip(test.t_s.tolist(), edge_corners(test), strict=True)):
        t_ns = round(1e9 * t_s)
        view = view_square(corners, SIDE_M, CAMERA, CORNER_SIGMA_PX)
        poses = () if view is None else marker_poses(view)
        if poses:
            pose = poses[track.update(t_s, poses)]
            chosen[number] = track.nearest(test.R[number])
            clear[number] = track.is_clear(pose.t_camera_marker)
            positions.update_marker(t_ns, pose.t_camera_marker, pose.covariance[3:, 3:])
        state = positions.state(t_ns)
        if state is not None:
            t_m[number] = state.position
    return FollowedMarker(chosen, clear, t_m)


def marker_figures(test: MarkerTest, followed: FollowedMarker) -> MarkerFigures:
    """Compare with motion capture."""
    known = test.known
    turns = np.stack([_turns(test.R[known, which], test.R_true[known]) for which in (0, 1)])
    believed = np.take_along_axis(turns, followed.chosen[None, known], axis=0)[0]
    off, first_off = (
        np.linalg.norm(positions[known] - test.t_true_m[known], axis=1) for positions in (followed.t_m, test.t_m[:, 0])
    )
    return MarkerFigures(
        float((believed <= turns.min(axis=0)).mean()),
        float((turns[0] <= turns[1]).mean()),
        float(off.mean()),
        float(first_off.mean()),
        float(np.sqrt(np.mean(off**2))),
        float(np.sqrt(np.mean(first_off**2))),
    )


@dataclass(frozen=True, slots=True)
class TiltFigures:
    """How well the orientation is known within a band of tilts against the line of sight.

    Attributes:
        from_deg, to_deg: the band of true tilts.
        count: detections with a truth.
        wrong: share whose believed solution is the farther one from the truth.
        clear: share that is said to be clear.
        clear_wrong: share that is said to be clear and wrong.
    """

    from_deg: float
    to_deg: float
    count: int
    wrong: float
    clear: float
    clear_wrong: float


def tilt_figures(test: MarkerTest, followed: FollowedMarker) -> list[TiltFigures]:
    """Return the figures of every band with enough detections."""
    known = test.known
    R_true, t_true = test.R_true[known], test.t_true_m[known]
    turns = np.stack([_turns(test.R[known, which], R_true) for which in (0, 1)])
    believed = np.take_along_axis(turns, followed.chosen[None, known], axis=0)[0]
    wrong, clear = believed > turns.min(axis=0), followed.clear[known]
    cosine = -(R_true[:, :, 2] * t_true).sum(axis=1) / np.linalg.norm(t_true, axis=1)
    tilt_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    figures = []
    for low, high in pairwise(TILTS_DEG):
        band = (tilt_deg >= low) & (tilt_deg < high)
        if (count := int(band.sum())) >= LEAST_DETECTIONS:
            shares = [float(which[band].mean()) for which in (wrong, clear, wrong & clear)]
            figures.append(TiltFigures(low, high, count, *shares))
    return figures


def _turns(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the angles (N,), radians, between rotations (N, 3, 3)."""
    return np.array([np.linalg.norm(vector_from_rotation(a @ b.T)) for a, b in zip(first, second, strict=True)])
