"""Point sets again, with the markers where later observations show that they were."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rhot.messages import PointSet
from rhot.messages.base import wire_position
from rhot_fusion.filter.path_smoothing import SmoothedPath

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PublishedSet:
    """A point set and what went into it.

    Attributes:
        points: as published.
        t_s: its moment, seconds since the stream's start.
        shape_sigma_m: (M,) what the markers' places may be wrong by for their shapes and what hides them.
    """

    points: PointSet
    t_s: float
    shape_sigma_m: list[float]


def smoothed_points(
    published: Sequence[PublishedSet], paths: Sequence[SmoothedPath], names: Sequence[str]
) -> list[PointSet]:
    """Return the point sets with places and sigmas from the paths of the M markers; all else stays as it was."""
    if not published:
        return []
    times = np.array([one.t_s for one in published])
    read = [path.at(times) for path in paths]
    place, variance = np.stack([position for position, _ in read], axis=1), np.stack([v for _, v in read], axis=1)
    sigma = np.sqrt(variance + np.array([one.shape_sigma_m for one in published]) ** 2)
    index = {name: marker for marker, name in enumerate(names)}
    return [_moved(one.points, index, place[row], sigma[row]) for row, one in enumerate(published)]


def _moved(points: PointSet, index: dict[str, int], place: FloatArray, sigma: FloatArray) -> PointSet:
    moved = {}
    for name, point in points.points.items():
        marker = index[name]
        if not np.isfinite(place[marker, 0]):
            continue
        corners = point.corners
        if corners is not None:
            a, b, c, d = (wire_position(np.array(corner) - point.position + place[marker]) for corner in corners)
            corners = (a, b, c, d)
        moved[name] = point.model_copy(
            update={"position": wire_position(place[marker]), "sigma": float(sigma[marker]), "corners": corners}
        )
    return points.model_copy(update={"points": moved})
