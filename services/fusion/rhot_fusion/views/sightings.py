"""The marker views of one camera frame, as arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.messages import PointState
from rhot.rig import FusionConfig
from rhot_fusion.views.epipolar import EpipolarModel
from rhot_fusion.views.vectors import Vector

CountArray = NDArray[np.int64]
Upper = tuple[float, float, float, float, float, float]
"""xx, xy, xz, yy, yz and zz of a covariance."""
NOWHERE: Vector = (math.nan, math.nan, math.nan)
NOTHING: Upper = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The position of a marker that is absent, and its covariance."""


@dataclass(frozen=True, slots=True)
class Sightings:
    """The markers in one frame.

    Attributes:
        camera: index of the camera.
        t_s: time of the frame: the median of its markers' times, seconds since the stream's start.
        index: (N,) markers, ascending.
        times_s: (N,) when each was seen.
        xy: (N, 2) normalised image coordinates, finite.
        area_px: (N,) visible painted area, square pixels.
        border: (N, 3) of the nearest border of the picture: how far it is, and the way out (2,), normalised; none where
            no marker is near to it.
    """

    camera: int
    t_s: float
    index: IndexArray
    times_s: FloatArray
    xy: FloatArray
    area_px: FloatArray
    border: FloatArray | None = None

    def at(self, xy: FloatArray) -> Sightings:
        """Return the same markers at other normalised coordinates (N, 2)."""
        return Sightings(self.camera, self.t_s, self.index, self.times_s, xy, self.area_px, self.border)

    def chosen(self, rows: BoolArray | IndexArray) -> Sightings:
        """Return some of the markers: by (N,) booleans or by their rows."""
        border = None if self.border is None else self.border[rows]
        parts = self.index[rows], self.times_s[rows], self.xy[rows], self.area_px[rows]
        return Sightings(self.camera, self.t_s, *parts, border)


def nearest_border(u: float, v: float, width: int, height: int) -> tuple[float, float, float]:
    """Return how far the nearest border of a picture is from a pixel, pixels, and the way out over it (2,)."""
    return min((u + 0.5, -1.0, 0.0), (width - 0.5 - u, 1.0, 0.0), (v + 0.5, 0.0, -1.0), (height - 0.5 - v, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class Outcome:
    """The markers at one moment, in plain numbers.

    Attributes:
        t_s: the moment, seconds since the stream's start.
        position: (M,) metres, rig frame; NaN = absent.
        sigma_m: (M,) standard deviation of the position.
        views: (M,) cameras behind it.
        measured: (M,) backed by views of this moment that agree.
        seen: (C, M) which cameras see the marker at this moment.
        covariance: (M,) of the position, square metres; none where the method tells none.
        state: (M,) of each marker; none where `measured` tells all.
    """

    t_s: float
    position: Sequence[Vector]
    sigma_m: list[float]
    views: list[int]
    measured: list[bool]
    seen: list[list[bool]]
    covariance: Sequence[Upper] | None = None
    state: list[PointState] | None = None


class Tracker(Protocol):
    """From sightings to points: the part of fusion in which its methods differ.

    Attributes:
        epipolar: what was learnt of the cameras since they were calibrated.
    """

    epipolar: EpipolarModel

    def configure(self, config: FusionConfig) -> None:
        """Change the settings, within the same method."""
        ...

    def advance(self, sightings: Sightings) -> Outcome | None:
        """Take one frame in order of arrival; return the markers at the moment that it made possible, if any."""
        ...

    def clear(self) -> None:
        """Forget all markers; what was learnt of the cameras stays."""
        ...
