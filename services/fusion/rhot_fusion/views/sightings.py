"""Data types of the trackers: marker observations of one frame, and markers in space."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
"""Position and covariance of an absent marker."""


@dataclass(frozen=True, slots=True)
class Sightings:
    """Marker observations in one frame.

    Attributes:
        camera: index of the camera.
        t_s: time of the frame: the median of its markers' times, seconds since the stream's start.
        index: (N,) markers, ascending.
        times_s: (N,) exposure time of each marker's image row, seconds since the stream's start.
        xy: (N, 2) normalised image coordinates, finite.
        area_px: (N,) visible painted area, square pixels.
        border: (N, 3) distance of the nearest image border, normalised units, and its outward normal (2,); None if no
            marker is near the border.
        skin: (N, 2) where skin adjoins the paint, see `rhot.messages.Marker`; 0 = not known.
    """

    camera: int
    t_s: float
    index: IndexArray
    times_s: FloatArray
    xy: FloatArray
    area_px: FloatArray
    border: FloatArray | None = None
    skin: FloatArray | None = None

    def at(self, xy: FloatArray) -> Sightings:
        """Return the observations with other normalised image coordinates (N, 2)."""
        return replace(self, xy=xy)

    def chosen(self, rows: BoolArray | IndexArray) -> Sightings:
        """Return some of the observations, selected by a mask (N,) or by rows."""
        border, skin = (None if each is None else each[rows] for each in (self.border, self.skin))
        parts = self.index[rows], self.times_s[rows], self.xy[rows], self.area_px[rows]
        return Sightings(self.camera, self.t_s, *parts, border, skin)


def nearest_border(u: float, v: float, width: int, height: int) -> tuple[float, float, float]:
    """Return the distance of the nearest image border from a pixel, pixels, and its outward normal (2,)."""
    return min((u + 0.5, -1.0, 0.0), (width - 0.5 - u, 1.0, 0.0), (v + 0.5, 0.0, -1.0), (height - 0.5 - v, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class Outcome:
    """The markers in space at one time, as plain Python numbers.

    Attributes:
        t_s: the time, seconds since the stream's start.
        position: (M,) metres, rig frame; NaN = absent.
        sigma_m: (M,) standard deviation of the position, metres.
        views: (M,) number of cameras that contribute.
        measured: (M,) whether consistent views of this time support the position.
        seen: (C, M) which cameras see the marker at this time.
        covariance: (M,) of the position, square metres; None if the method has none.
        state: (M,) of each marker; None if the method has no states besides `measured`.
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
    """Computes points from observations; each method of fusion is a tracker.

    Attributes:
        epipolar: estimated epipolar residuals of the cameras.
    """

    epipolar: EpipolarModel

    def configure(self, config: FusionConfig) -> None:
        """Change the settings; the method must be the same."""
        ...

    def advance(self, sightings: Sightings) -> Outcome | None:
        """Process a frame, in order of arrival; return the markers at the next output time if it was reached."""
        ...

    def clear(self) -> None:
        """Discard all markers; the estimated epipolar residuals are kept."""
        ...
