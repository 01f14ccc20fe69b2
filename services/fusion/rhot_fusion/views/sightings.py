"""Observations of one frame and markers in space, with the small algebra they need."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.markers import PaintedMarker
from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.types import PointState, Vector3
from rhot_fusion.views.epipolar import EpipolarModel

# Gate points by their distance from the other markers of the same hand.

_REACH = 1.2
"""Largest distance of a marker from the median of its hand's markers, in hand lengths: an open hand plus noise."""
_FEWEST = 3
"""Tracked markers required: of two, it is unknown which one is wrong."""


class HandCoherence:
    """Gates a marker's point by the median of the markers of its hand.

    Attributes:
        siblings: per marker, the indices of the others of its hand.
        company: (M, M) the same as a matrix: 1 = same hand, 0 = other hand or the marker itself.
    """

    def __init__(self, markers: Mapping[str, PaintedMarker], hand_length_m: float) -> None:
        sides = np.array([marker.hand for marker in markers.values()])
        self._hands: list[IndexArray] = [np.flatnonzero(sides == side) for side in np.unique(sides)]
        self._hand_of: IndexArray = np.searchsorted(np.unique(sides), sides)
        self.siblings: list[IndexArray] = [
            np.flatnonzero((sides == side) & (np.arange(len(sides)) != index)) for index, side in enumerate(sides)
        ]
        self.company: FloatArray = (sides[:, None] == sides[None]) * (1.0 - np.eye(len(sides)))
        self._reach_m = _REACH * hand_length_m

    def near(self, index: IndexArray, position: FloatArray, known: FloatArray, tracked: BoolArray) -> BoolArray:
        """Return which points (K, 3) of markers (K,) are near the median of their hand's known positions (M, 3).

        All pass where fewer than three markers (M,) of a hand are tracked. Metres, rig frame.
        """
        middles = np.full((len(self._hands), 3), np.nan)
        for hand, members in enumerate(self._hands):
            present = members[tracked[members]]
            if len(present) >= _FEWEST:
                # The lower median, because np.median would cost more than the rest of this function.
                middles[hand] = np.sort(known[present], axis=0)[(len(present) - 1) // 2]
        away = position - middles[self._hand_of[index]]
        far: BoolArray = (away * away).sum(axis=1) > self._reach_m**2
        return ~far


# Vector algebra on plain floats, for arrays too small for numpy to be faster.


def vector(values: NDArray[np.float64]) -> Vector3:
    """Return an array (3,) as a tuple."""
    x, y, z = values.tolist()
    return x, y, z


def dot(a: Vector3, b: Vector3) -> float:
    """Return a·b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def across(a: Vector3, unit: Vector3) -> Vector3:
    """Return the component of a vector perpendicular to a unit vector."""
    along = dot(a, unit)
    return a[0] - along * unit[0], a[1] - along * unit[1], a[2] - along * unit[2]


def unit(a: Vector3) -> Vector3:
    """Return the unit vector in the direction of a; shorter if a is shorter than 1e-6."""
    scale = 1.0 / max(math.sqrt(dot(a, a)), 1e-6)
    return scale * a[0], scale * a[1], scale * a[2]


def interpolated(x: float, known: Sequence[float], values: Sequence[float]) -> float:
    """Return the linear interpolation at x of values at ascending `known`, constant beyond both ends: np.interp."""
    after = bisect_right(known, x)
    if after in (0, len(known)):
        return values[max(after - 1, 0)]
    share = (x - known[after - 1]) / (known[after] - known[after - 1])
    return values[after - 1] + share * (values[after] - values[after - 1])


# Data types of the trackers: marker observations of one frame, and markers in space.

CountArray = NDArray[np.int64]
Upper = tuple[float, float, float, float, float, float]
"""xx, xy, xz, yy, yz and zz of a covariance."""
NOWHERE: Vector3 = (math.nan, math.nan, math.nan)
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
    position: Sequence[Vector3]
    sigma_m: list[float]
    views: list[int]
    measured: list[bool]
    seen: list[list[bool]]
    covariance: Sequence[Upper] | None = None
    state: list[PointState] | None = None


class TrackingLimits(Protocol):
    """What a user sets of the tracking of points; `rhot.rig.FusionConfig` is one."""

    @property
    def volume_m(self) -> tuple[Vector3, Vector3]:
        """Lowest and highest corner of the space where hands can be, rig frame."""
        ...

    @property
    def hold_s(self) -> float:
        """How long a marker that no camera sees is kept, seconds."""
        ...

    @property
    def predict_s(self) -> float:
        """How far ahead points are predicted, seconds."""
        ...

    @property
    def epipolar_limit_px(self) -> float:
        """Epipolar residual above which two cameras' views of a marker contradict each other, pixels."""
        ...


class Tracker(Protocol):
    """Computes points from observations; each method of fusion is a tracker.

    Attributes:
        epipolar: estimated epipolar residuals of the cameras.
    """

    epipolar: EpipolarModel

    def configure(self, limits: TrackingLimits) -> None:
        """Change the settings; the method must be the same."""
        ...

    def advance(self, sightings: Sightings) -> Outcome | None:
        """Process a frame, in order of arrival; return the markers at the next output time if it was reached."""
        ...

    def clear(self) -> None:
        """Discard all markers; the estimated epipolar residuals are kept."""
        ...
