"""Estimated marker positions as plain arrays, whoever made them: fusion, a smoother or a reference."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray, IntArray
from rhot.geometry.covariances import stated_covariance
from rhot.messages import Point, PointSet

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
    return np.array(stated_covariance(point)).reshape(3, 3)
