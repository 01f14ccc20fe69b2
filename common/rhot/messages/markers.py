"""Markers in images, and as points in space."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from rhot.messages.base import (
    Count,
    Message,
    Name,
    Pixel,
    PixelPoint,
    PointState,
    Position,
    Seconds,
    SignedUnit,
    TimeNs,
    Unit,
    WireModel,
)

SquareMetres = Annotated[float, Field(ge=-1e6, le=1e6)]
Covariance = tuple[SquareMetres, SquareMetres, SquareMetres, SquareMetres, SquareMetres, SquareMetres]


class Marker(WireModel):
    """One marker in one camera's image.

    Attributes:
        u, v: sub-pixel centre, pixels, raw image.
        area: visible area, square pixels.
        score: probability that the identity is right and the centre within one pixel of the true one.
        t_ns: mid-exposure of the marker's image row, if it differs from the frame's `t_ns`.
        corners: the four corners of a rectangular patch in cyclic order, pixels.
        outline: closed outline, pixels.
        skin_side: where skin adjoins the paint, in the image: mean over a ring around the blob of the unit vectors from
            the centre, those to other than skin counting 0. Its length is 0 where none adjoins, or on all sides alike,
            and 0.32 where it does along half of the ring. Absent if the colour of the skin is not known.
    """

    u: Pixel
    v: Pixel
    area: Annotated[float, Field(ge=0.0, le=1e9)]
    score: Unit
    t_ns: TimeNs | None = None
    corners: tuple[PixelPoint, PixelPoint, PixelPoint, PixelPoint] | None = None
    outline: Annotated[tuple[PixelPoint, ...], Field(max_length=512)] | None = None
    skin_side: tuple[SignedUnit, SignedUnit] | None = None


class MarkerFrame(Message):
    """All markers detected in one frame of one camera; a marker that was not seen is absent.

    Attributes:
        camera: name of the camera in `rig.toml`.
        width, height: size of the image, pixels.
        markers: observations by marker name.
        timing: seconds of the capture service: `age`, from mid-exposure of the middle row to the start of
            detection, and `detect`, duration of the detection.
        frame: the source's frame counter; a gap means frames lost before detection.
    """

    camera: Name
    width: Annotated[int, Field(gt=0, le=65536)]
    height: Annotated[int, Field(gt=0, le=65536)]
    markers: Annotated[dict[Name, Marker], Field(max_length=256)]
    timing: Annotated[dict[Name, Seconds], Field(max_length=32)] = {}
    frame: Count = 0


class Point(WireModel):
    """One marker in space.

    Attributes:
        position: metres, in the frame of the PointSet.
        covariance: of the position, xx, xy, xz, yy, yz, zz, square metres; absent if the method estimates none.
        sigma: standard deviation of the position, metres (root of the sum of the three variances).
        views: number of cameras that see the marker.
        state: `measured` (two or more views at this time), `one_view` (on one camera's ray: uncertain along it) or
            `predicted`.
        corners: corners of a rectangular patch, metres, cyclic order.
    """

    position: Position
    sigma: Annotated[float, Field(ge=0.0, le=1e3)]
    views: Annotated[int, Field(ge=0, le=255)]
    state: PointState
    covariance: Covariance | None = None
    corners: tuple[Position, Position, Position, Position] | None = None


class PointSet(Message):
    """All marker points at one time, from fusion.

    Attributes:
        frame: frame of all positions, `rig`.
        points: by marker name; an unknown marker is absent.
    """

    frame: Name
    points: Annotated[dict[Name, Point], Field(max_length=256)]
