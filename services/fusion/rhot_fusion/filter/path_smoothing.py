"""The best path of each marker, looked back at: fixed-interval smoothing of what the filters recorded.

The forward pass keeps, for each observation of a marker, what the bank expected and what it made of it, both as the
joint estimate over its models; the backward pass is that of Rauch, Tung and Striebel ("Maximum likelihood estimates of
linear dynamic systems", AIAA Journal 3(8), 1965):

    C = P F' P⁻¹(next, expected),
    x ← x + C (x(next) − x(next, expected)),    P ← P + C (P(next) − P(next, expected)) C'.

How the models were mixed on the way is taken from what the forward pass expected: its covariance holds the noise that
the models believed in at that moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]
Estimate = tuple[FloatArray, FloatArray]
"""States (N, 6) and their covariances (N, 6, 6)."""

_CARRIED: FloatArray = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
_JITTER: FloatArray = np.diag([1e-12] * 3 + [1e-10] * 3)
"""Keeps covariances invertible: a tenth of what any camera could tell."""


@dataclass(frozen=True, slots=True)
class _Node:
    """A marker at one observation.

    Attributes:
        t_s: when.
        F: (6, 6) from the node before to this one; none where the path begins.
        expected, expected_cov: (6,), (6, 6) before the observation.
        mean, cov: (6,), (6, 6) after it.
    """

    t_s: float
    F: FloatArray | None
    expected: FloatArray
    expected_cov: FloatArray
    mean: FloatArray
    cov: FloatArray


@dataclass(frozen=True, slots=True)
class SmoothedPath:
    """One marker's path.

    Attributes:
        t_s: (N,) times of the nodes, ascending.
        mean: (N, 6) positions and velocities, metres and metres per second.
        variance: (N,) sum of the variances of the position, square metres.
        joined: (N,) whether the path comes from the node before.
    """

    t_s: FloatArray
    mean: FloatArray
    variance: FloatArray
    joined: BoolArray

    def at(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions (K, 3), metres, and variances (K,) at times (K,); NaN before the first node.

        Between two nodes of one path it is the cubic that has their places and velocities.
        """
        position, variance = np.full((len(t_s), 3), np.nan), np.full(len(t_s), np.nan)
        at = np.searchsorted(self.t_s, t_s, side="right") - 1
        known = at >= 0
        at = at[known]
        if not len(at):
            return position, variance
        after = np.minimum(at + 1, len(self.t_s) - 1)
        after = np.where(self.joined[after], after, at)
        span = self.t_s[after] - self.t_s[at]
        ahead = t_s[known] - self.t_s[at]
        between = span > 0.0
        share = np.where(between, ahead / np.where(between, span, 1.0), 0.0)[:, None]
        way = self.mean[at, 3:] * ahead[:, None]
        gap = self.mean[after, :3] - self.mean[at, :3]
        start, end = self.mean[at, 3:] * span[:, None], self.mean[after, 3:] * span[:, None]
        cubic = share * (start + share * (3.0 * gap - 2.0 * start - end + share * (start + end - 2.0 * gap)))
        position[known] = self.mean[at, :3] + np.where(between[:, None], cubic, way)
        share = share[:, 0]
        variance[known] = (1.0 - share) * self.variance[at] + share * self.variance[after]
        return position, variance


class PathRecord:
    """What the filters of M markers did, for smoothing."""

    def __init__(self, markers: int) -> None:
        self._nodes: list[list[_Node]] = [[] for _ in range(markers)]

    def begin(self, index: IndexArray, t_s: float, mean: FloatArray, cov: FloatArray) -> None:
        """Begin new paths of markers (N,) with states (N, 6) and covariances (N, 6, 6)."""
        for row, marker in enumerate(index.tolist()):
            self._nodes[marker].append(_Node(t_s, None, mean[row], cov[row], mean[row], cov[row]))

    def observed(
        self, index: IndexArray, t_s: FloatArray, dt_s: FloatArray, expected: Estimate, made: Estimate
    ) -> None:
        """Note observations of markers (N,).

        Args:
            index: of the markers.
            t_s: (N,) when.
            dt_s: (N,) since what was noted of them before.
            expected: states (N, 6) and covariances (N, 6, 6) before the observations.
            made: the same after them.
        """
        for row, marker in enumerate(index.tolist()):
            F = np.eye(6)
            F[:3, 3:] = dt_s[row] * np.eye(3)
            self._nodes[marker].append(
                _Node(float(t_s[row]), F, expected[0][row], expected[1][row], made[0][row], made[1][row])
            )

    def carried(self, marker: int, t_s: float, mean: FloatArray, cov: FloatArray) -> None:
        """Note that a marker was moved along with its hand, to a state (6,) and covariance (6, 6)."""
        mean, cov = mean.copy(), cov.copy()
        self._nodes[marker].append(_Node(t_s, _CARRIED, mean, cov, mean, cov))

    def cut(self, t_s: FloatArray) -> None:
        """Forget what came after times (M,)."""
        for nodes, last_s in zip(self._nodes, t_s.tolist(), strict=True):
            while nodes and nodes[-1].t_s > last_s:
                nodes.pop()

    def smooth(self) -> list[SmoothedPath]:
        """Return the path of each marker."""
        return [_smooth(nodes) for nodes in self._nodes]


def _smooth(nodes: list[_Node]) -> SmoothedPath:
    mean, cov = np.zeros((len(nodes), 6)), np.zeros((len(nodes), 6, 6))
    for place in range(len(nodes) - 1, -1, -1):
        node = nodes[place]
        mean[place], cov[place] = node.mean, node.cov
        if place + 1 == len(nodes) or (following := nodes[place + 1]).F is None:
            continue
        gain = np.linalg.solve(following.expected_cov + _JITTER, following.F @ node.cov).T
        mean[place] += gain @ (mean[place + 1] - following.expected)
        cov[place] += gain @ (cov[place + 1] - following.expected_cov) @ gain.T
    # A row further up may have been read before the moment that a marker was carried to.
    times = np.maximum.accumulate([node.t_s for node in nodes]) if nodes else np.zeros(0)
    variance = np.maximum(np.einsum("nii->n", cov[:, :3, :3]), 0.0)
    return SmoothedPath(times, mean, variance, np.array([node.F is not None for node in nodes], dtype=bool))
