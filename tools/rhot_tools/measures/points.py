"""Points against the truth: errors, jitter, swapped and false points, speed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import BoolArray, FloatArray, IntArray
from rhot.geometry.covariances import stated_covariance
from rhot.messages import Point, PointSet
from rhot_sim.world.world import World

# Estimated marker positions as plain arrays, whoever made them: fusion, a smoother or a reference.

STATES: Final = ("measured", "one_view", "predicted")
MEASURED, ONE_VIEW, PREDICTED = range(3)


@dataclass(frozen=True, slots=True)
class Estimates:
    """N estimates of marker positions, in the order in which they were published.

    Attributes:
        t_ns: (N,) the instant that each refers to.
        marker: (N,) index in the list of marker names.
        position: (N, 3) metres, rig frame.
        covariance: (N, 3, 3) m², as stated; NaN where none is stated.
        state: (N,) index in `STATES`.
    """

    t_ns: IntArray
    marker: IntArray
    position: FloatArray
    covariance: FloatArray
    state: IntArray

    def of(self, rows: NDArray[np.bool_] | IntArray) -> Estimates:
        """Return some of the rows."""
        return Estimates(
            self.t_ns[rows], self.marker[rows], self.position[rows], self.covariance[rows], self.state[rows]
        )


def estimates_of(sets: Iterable[PointSet], names: Sequence[str]) -> Estimates:
    """Return the points of published sets; names that are not in `names` are left out."""
    index = {name: number for number, name in enumerate(names)}
    rows = [
        (points.t_ns, index[name], point.position, covariance_of(point), STATES.index(point.state))
        for points in sets
        for name, point in points.points.items()
        if name in index
    ]
    if not rows:
        return Estimates(
            np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, np.int64)
        )
    t_ns, marker, position, covariance, state = zip(*rows, strict=True)
    return Estimates(
        np.array(t_ns, dtype=np.int64),
        np.array(marker, dtype=np.int64),
        np.array(position, dtype=np.float64),
        np.array(covariance, dtype=np.float64),
        np.array(state, dtype=np.int64),
    )


def covariance_of(point: Point) -> FloatArray:
    """Return the stated covariance (3, 3), m², of a point; see `rhot.geometry.covariances.stated_covariance`."""
    return np.array(stated_covariance(point.covariance, point.sigma)).reshape(3, 3)


FALSE_M: Final = 0.020
"""A measured point with no true marker this near is a false one."""
SWAP_M: Final = 0.010
"""A point is swapped when it is nearer to another marker than to its own, and further than this from its own; the same
as in score.py of the rendered pictures."""
_SPEED_STEP_S: Final = 0.005


@dataclass(frozen=True, slots=True)
class PointTrack:
    """Points of N sets and M markers beside the truth.

    Attributes:
        names: (M) markers.
        t_s: (N,) seconds since the world's start.
        positions: (N, M, 3) metres, rig frame; NaN = not published.
        measured: (N, M).
        true: (N, M, 3) metres: centre of the painted volume at the same moment.
        speeds: (N, M) of the truth, metres per second.
    """

    names: tuple[str, ...]
    t_s: FloatArray
    positions: FloatArray
    measured: BoolArray
    true: FloatArray
    speeds: FloatArray

    def after(self, t_s: float) -> PointTrack:
        """Return the part from a time on."""
        rows = self.t_s >= t_s
        return PointTrack(
            self.names, self.t_s[rows], self.positions[rows], self.measured[rows], self.true[rows], self.speeds[rows]
        )

    @property
    def errors_m(self) -> FloatArray:
        """(N, M) distance of measured points from the truth; NaN where nothing was measured."""
        distance: FloatArray = np.linalg.norm(self.positions - self.true, axis=2)
        return np.where(self.measured, distance, np.nan)


def point_track(sets: Sequence[PointSet], world: World, start_t_ns: int) -> PointTrack:
    """Return point sets beside the truth at their own times."""
    names = tuple(world.markers)
    t_s = np.array([(points.t_ns - start_t_ns) / 1e9 for points in sets])
    positions = np.full((len(sets), len(names), 3), np.nan)
    measured = np.zeros((len(sets), len(names)), dtype=np.bool_)
    for row, points in enumerate(sets):
        for column, name in enumerate(names):
            point = points.points.get(name)
            if point is not None:
                positions[row, column] = point.position
                measured[row, column] = point.state == "measured"
    true, later = (_marker_positions(world, names, t_s + shift) for shift in (0.0, _SPEED_STEP_S))
    speeds = np.linalg.norm(later - true, axis=2) / _SPEED_STEP_S
    return PointTrack(names, t_s, positions, measured, true, speeds)


def _marker_positions(world: World, names: Sequence[str], t_s: FloatArray) -> FloatArray:
    markers = world.sample(t_s).markers
    return np.stack([markers[name] for name in names], axis=1) if names else np.empty((len(t_s), 0, 3))


def true_path(world: World, names: Sequence[str], from_s: float, to_s: float, step_s: float) -> tuple[FloatArray, ...]:
    """Return times (T,) and marker positions (T, M, 3) of the truth, evenly spaced."""
    t_s = np.arange(from_s, to_s, step_s)
    return t_s, _marker_positions(world, names, t_s)


def jitter_m(track: PointTrack) -> tuple[FloatArray, FloatArray]:
    """Return per marker (M,) the standard deviation of measured points about their mean, for a world that is still.

    First sideways (root mean square of the two axes across the line of sight from the rig's origin), then in depth
    (along it); NaN for markers measured fewer than ten times.
    """
    sideways, depth = np.full(len(track.names), np.nan), np.full(len(track.names), np.nan)
    for column in range(len(track.names)):
        positions = track.positions[track.measured[:, column], column]
        if len(positions) < 10:
            continue
        sideways[column], depth[column] = scatter_m(positions)
    return sideways, depth


def scatter_m(positions: FloatArray) -> tuple[float, float]:
    """Return the standard deviations of positions (N, 3) about their mean, sideways and in depth; see `jitter_m`."""
    mean = positions.mean(axis=0)
    off = positions - mean
    sight = mean / np.linalg.norm(mean)
    along = off @ sight
    across = off - along[:, None] * sight
    return float(np.sqrt(0.5 * (across**2).sum(axis=1).mean())), float(along.std())


def false_points(track: PointTrack) -> int:
    """Return how many measured points have no true marker within `FALSE_M`."""
    return int((track.measured & (_distances(track).min(axis=2) > FALSE_M)).sum())


def is_swapped(own_m: FloatArray, nearest_other_m: FloatArray) -> BoolArray:
    """Return which points lie at another marker, from their distances to their own and to the nearest other one."""
    swapped: BoolArray = (nearest_other_m < own_m) & (own_m > SWAP_M)
    return swapped


def identity_swaps(track: PointTrack, hands: Sequence[str] | None = None) -> int:
    """Return how many times a marker was measured at another marker's position; a stretch of sets counts once.

    Args:
        track: points beside the truth.
        hands: the hand of each of its markers; then only markers of another hand count.
    """
    distances = _distances(track)
    own = np.einsum("nmm->nm", distances)
    mine = np.eye(len(track.names), dtype=np.bool_) if hands is None else np.equal.outer(hands, hands)
    other = np.where(mine, np.inf, distances)
    swapped = track.measured & is_swapped(own, other.min(axis=2))
    before = np.vstack([np.zeros((1, len(track.names)), dtype=np.bool_), swapped[:-1]])
    return int((swapped & ~before).sum())


def _distances(track: PointTrack) -> FloatArray:
    """Return (N, M, M): from each point to each true marker; infinite where there is no point."""
    apart = np.linalg.norm(track.positions[:, :, None] - track.true[:, None], axis=3)
    return np.where(np.isfinite(apart), apart, np.inf)
