"""How the errors of a point lie in space: long in depth, short across, as its cameras see it."""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray

_CELL_M: Final = 0.025
"""Shapes are those at the middle of a cell of this size; they change by a few per cent from cell to cell."""
_MOST_CELLS: Final = 4096


class PointCovariances:
    """Covariances of points as a rig's cameras see them, up to their size.

    Args:
        viewpoints: (C, 3) metres, rig frame: the cameras' centres; fewer than two tell no shape.
    """

    def __init__(self, viewpoints: FloatArray) -> None:
        self.viewpoints = viewpoints
        self._middle = viewpoints.mean(axis=0) if len(viewpoints) else None
        self._shapes: dict[tuple[int, int, int], FloatArray] = {}

    def shape(self, at: FloatArray) -> FloatArray:
        """Return the covariance (3, 3) of a point near `at` (3,), metres, rig frame, scaled to a trace of 1.

        Each camera fixes a point across its own line of sight, the better the nearer it is: the information adds up
        as Σ (I − d·dᵀ) / r² over the cameras at distance r in direction d.
        """
        x, y, z = at.tolist()
        cell = (round(x / _CELL_M), round(y / _CELL_M), round(z / _CELL_M))
        known = self._shapes.get(cell)
        if known is None:
            if len(self._shapes) >= _MOST_CELLS:
                self._shapes.clear()
            known = self._shapes[cell] = self._shape(np.array(cell) * _CELL_M)
        return known

    def _shape(self, at: FloatArray) -> FloatArray:
        rays = at - self.viewpoints
        squared = (rays * rays).sum(-1)
        if len(rays) < 2 or squared.min() < 1e-6:
            return np.eye(3) / 3.0
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :] / squared[:, None, None]
        information = (across / squared[:, None, None]).sum(axis=0)
        # Parallel lines of covariances leave depth open: never more than 30 times longer than wide.
        information += np.eye(3) * (np.trace(information) / 2.0 / 900.0)
        covariance = np.linalg.inv(information)
        scaled: FloatArray = covariance / np.trace(covariance)
        return scaled

    def direction(self, at: FloatArray) -> FloatArray:
        """Return the unit direction (3,) in which the cameras look at a point (3,); +z where there are none."""
        if self._middle is None:
            return np.array([0.0, 0.0, 1.0])
        ray = at - self._middle
        direction: FloatArray = ray / max(float(np.sqrt(ray @ ray)), 1e-9)
        return direction
