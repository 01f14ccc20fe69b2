"""The depth stage: where a foot is while its marker is hidden, from its blob in the depth image.

While marker and blob are both seen, the offset from the blob's centroid to the marker is learnt in the foot's frame,
together with how much it varies; that variation is what the depth stage can promise later.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rhot.camera import CameraModel
from rhot.messages import Side
from rhot.transforms import cross_matrix
from rhot_feet.depth_blob import RADIUS_M, BlobSeed, FootBlob, find_blobs
from rhot_feet.depth_floor import FloorPlane, find_floor
from rhot_feet.depth_points import COARSE_PX, FINE_PX, PixelRays
from rhot_feet.depth_shape import FootShape, shape_of
from rhot_feet.expectation import GATE_SIGMAS, FootExpectation, expected_region, innovation_distance
from rhot_feet.frames import DepthFrame
from rhot_feet.region import Region

FloatArray = NDArray[np.float64]

DepthRefusal = Literal["unknown", "hidden", "size", "cut", "unsettled", "motion"]

_FORGETTING: Final = 0.03
_FIRST_SIGMA_M: Final = 0.02
"""Per axis, of an offset that was seen once."""
_LEAST_SIGMA_M: Final = 0.004
_AREA_RATIO: Final = (0.4, 2.0)
"""A blob that shows less or more of its usual surface than this is half hidden, or more than a foot."""
_AREA_SIGMA: Final = 1.5
_HIDDEN_SIGMA: Final = 1.0
"""By how much more a place is in doubt when hardly anything of the foot is in sight."""
_MAX_CUT: Final = 0.5
_LEAST_IN_SIGHT: Final = 0.2
"""Share of the foot's surface; of less the rest cannot be told."""
_WHOLE_SHARE: Final = 0.95
"""A sighting of nearly the most surface ever seen renews a foot's shape."""
_LEVEL_SHARE: Final = 0.4
"""Part of an error of the expected height that remains in the found one: the blob is cut off in relation to it."""
_FLOOR_NS: Final = 60_000_000
"""The floor is measured this often; in between the head's pose tells where it is."""
_REACH_M: Final = RADIUS_M + 0.06
_UPRIGHT: Final = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True, slots=True)
class FootDepth:
    """A foot in one depth image, believed.

    Attributes:
        t_ns: time of the picture, rig clock.
        place: (3,) where its marker has to be, metres, camera frame.
        covariance: (3, 3) of the place.
        points: number of depth points behind it.
    """

    t_ns: int
    place: FloatArray
    covariance: FloatArray
    points: int


@dataclass(frozen=True, slots=True)
class DepthSightings:
    """What the depth stage made of one picture.

    Attributes:
        feet: foot to where it is.
        refused: foot to the reason why its blob was not believed.
        floor: the floor, where it is in sight.
    """

    feet: dict[Side, FootDepth]
    refused: dict[Side, DepthRefusal]
    floor: FloorPlane | None


@dataclass(frozen=True, slots=True)
class _Offset:
    """From a blob's centroid to the marker.

    Attributes:
        mean: (3,) metres, foot frame, or camera frame while the foot's orientation is unknown.
        variance: (3,) about the mean.
        area: usual `FootBlob.area` of the whole foot.
        count: sightings.
        shape: the foot's surface, in the frame of `mean`.
        in_foot: that is the foot's frame.
    """

    mean: FloatArray
    variance: FloatArray
    area: float
    count: int
    shape: FootShape
    in_foot: bool

    def with_sighting(self, offset: FloatArray, area: float, shape: FootShape) -> _Offset:
        share = max(1.0 / (self.count + 1), _FORGETTING)
        difference = offset - self.mean
        variance = (1.0 - share) * (self.variance + share * difference**2)
        usual = self.area + share * (area - self.area)
        # The shape is what was seen most of.
        shape = shape if shape.area > _WHOLE_SHARE * self.shape.area else self.shape
        return _Offset(self.mean + share * difference, variance, usual, self.count + 1, shape, self.in_foot)


@dataclass(frozen=True, slots=True)
class _MeasuredFloor:
    """The floor as one picture showed it.

    Attributes:
        t_ns: time of the picture, rig clock.
        floor: camera frame.
        T_rig_camera: (4, 4) at that time.
    """

    t_ns: int
    floor: FloorPlane
    T_rig_camera: FloatArray


class DepthTracker:
    """Follows both feet's blobs."""

    def __init__(self, depth_range_m: tuple[float, float]) -> None:
        """Prepare.

        Args:
            depth_range_m: nearest and farthest depth that is believed.
        """
        self._depth_range_m = depth_range_m
        self._offsets: dict[Side, _Offset] = {}
        self._floor: FloorPlane | None = None
        self._floor_t_ns: int | None = None
        self._measured_floor: _MeasuredFloor | None = None
        self._fine: PixelRays | None = None
        self._coarse: PixelRays | None = None

    def find_floor(
        self, frame: DepthFrame, up_camera: FloatArray | None = None, T_rig_camera: FloatArray | None = None
    ) -> FloorPlane | None:
        """Return the floor in a picture, which the marker stage wants to know too; found once a picture.

        Args:
            frame: the picture with its depth.
            up_camera: (3,) unit vector against gravity, camera frame, where the head's pose is known.
            T_rig_camera: (4, 4) likewise; the floor stays where it is and is measured only now and then.
        """
        if frame.depth_mm is None:
            self._floor, self._floor_t_ns = None, None
        elif frame.t_ns != self._floor_t_ns:
            known = self._measured_floor
            if known is not None and T_rig_camera is not None and 0 < frame.t_ns - known.t_ns < _FLOOR_NS:
                T_old_new = np.linalg.inv(known.T_rig_camera) @ T_rig_camera
                self._floor, self._floor_t_ns = known.floor.seen_from(T_old_new), frame.t_ns
                return self._floor
            if self._coarse is None or self._coarse.camera is not frame.camera:
                self._coarse = PixelRays(frame.camera, COARSE_PX)
            whole = Region(0, 0, frame.camera.width, frame.camera.height)
            grid = self._coarse.points(frame.depth_mm, whole, self._depth_range_m)
            self._floor, self._floor_t_ns = find_floor(grid, up_camera, self._floor), frame.t_ns
            self._measured_floor = None
            if self._floor is not None and T_rig_camera is not None:
                self._measured_floor = _MeasuredFloor(frame.t_ns, self._floor, T_rig_camera)
        return self._floor

    def feed(
        self,
        frame: DepthFrame,
        expected: Mapping[Side, FootExpectation],
        seen: Mapping[Side, FootExpectation],
        up_camera: FloatArray | None = None,
        *,
        learns: bool = True,
    ) -> DepthSightings:
        """Take one picture: learn from the feet that are seen, find those that are not.

        Args:
            frame: the picture with its depth.
            expected: foot to what the filter predicts, of those whose marker is hidden.
            seen: foot to its marker's place and orientation in this very picture.
            up_camera: (3,) unit vector against gravity, camera frame, where the head's pose is known.
            learns: else the feet that are seen only tell which points are theirs.
        """
        hidden = {side: foot for side, foot in expected.items() if side not in seen}
        learnt = {side: offset for side, foot in (hidden | dict(seen)).items() if (offset := self._learnt(side, foot))}
        refused: dict[Side, DepthRefusal] = {side: "unknown" for side in hidden if side not in learnt}
        hidden = {side: foot for side, foot in hidden.items() if side in learnt}
        floor = self.find_floor(frame, up_camera)
        if frame.depth_mm is None or not (hidden or seen):
            return DepthSightings({}, refused, floor)
        region = _joint_region([*hidden.values(), *(seen.values() if learns else ())], frame.camera)
        if region is None:
            return DepthSightings({}, refused | dict.fromkeys(hidden, "hidden"), floor)
        seeds: dict[Side, BlobSeed] = {}
        for side, foot in (hidden | dict(seen)).items():
            known = learnt.get(side)
            if known is None:
                seeds[side] = BlobSeed(foot.place, np.zeros(3), fixed=True)
            else:
                R = _axes(foot)
                seeds[side] = BlobSeed(foot.place, R @ known.mean, known.shape.turned(R), fixed=side in seen)
        grid = self._rays(frame.camera).points(frame.depth_mm, region, self._depth_range_m)
        up = self._up(up_camera)
        blobs = find_blobs(grid, seeds, floor, up, frame.camera)
        for side, foot in seen.items() if learns else ():
            if side in blobs:
                self._learn(side, foot, blobs[side])
        feet: dict[Side, FootDepth] = {}
        for side, foot in hidden.items():
            outcome = self._judge(frame.t_ns, side, foot, blobs.get(side), up)
            if isinstance(outcome, FootDepth):
                feet[side] = outcome
            else:
                refused[side] = outcome
        return DepthSightings(feet, refused, floor)

    def _learnt(self, side: Side, foot: FootExpectation) -> _Offset | None:
        """Return what is known of a foot in the axes in which it is expected."""
        known = self._offsets.get(side)
        return known if known is not None and known.in_foot == (foot.R_camera_foot is not None) else None

    def _learn(self, side: Side, foot: FootExpectation, blob: FootBlob) -> None:
        if blob.cut > _MAX_CUT or blob.in_sight < _LEAST_IN_SIGHT:
            return
        R = _axes(foot)
        offset = R.T @ (foot.place - blob.centroid)
        area = blob.area / blob.in_sight
        shape = shape_of((blob.points - foot.place) @ R, blob.weights, blob.area)
        known = self._learnt(side, foot)
        self._offsets[side] = (
            _Offset(offset, np.full(3, _FIRST_SIGMA_M**2), area, 1, shape, foot.R_camera_foot is not None)
            if known is None
            else known.with_sighting(offset, area, shape)
        )

    def _judge(
        self, t_ns: int, side: Side, foot: FootExpectation, blob: FootBlob | None, up: FloatArray
    ) -> FootDepth | DepthRefusal:
        if blob is None or blob.in_sight < _LEAST_IN_SIGHT:
            return "hidden"
        learnt = self._offsets[side]
        ratio = blob.area / (blob.in_sight * learnt.area)
        if not _AREA_RATIO[0] <= ratio <= _AREA_RATIO[1]:
            return "size"
        if blob.cut > _MAX_CUT:
            return "cut"
        if not blob.settled:
            return "unsettled"
        R = _axes(foot)
        # A blob that shows less of the foot than usual has its centre elsewhere.
        doubt = 1.0 + _AREA_SIGMA * abs(float(np.log(ratio))) + _HIDDEN_SIGMA * (1.0 - blob.in_sight)
        variance = (learnt.variance + _LEAST_SIGMA_M**2) * doubt**2
        level_variance = _LEVEL_SHARE**2 * float(up @ foot.covariance @ up)
        covariance = R @ np.diag(variance) @ R.T + level_variance * np.outer(up, up)
        if foot.orientation_covariance is not None:
            arm = cross_matrix(blob.place - np.average(blob.points, axis=0, weights=blob.weights))
            covariance += arm @ foot.orientation_covariance @ arm.T
        if innovation_distance(blob.place, covariance, foot) > GATE_SIGMAS:
            return "motion"
        return FootDepth(t_ns, blob.place, covariance, len(blob.points))

    def _rays(self, camera: CameraModel) -> PixelRays:
        if self._fine is None or self._fine.camera is not camera:
            self._fine = PixelRays(camera, FINE_PX)
        return self._fine

    def _up(self, up_camera: FloatArray | None) -> FloatArray:
        if up_camera is not None:
            return up_camera
        return _UPRIGHT if self._floor is None else self._floor.up


def _axes(foot: FootExpectation) -> FloatArray:
    """Return the frame (3, 3) in which a foot's offset is kept: its own, or the camera's while it is not known."""
    return np.eye(3) if foot.R_camera_foot is None else foot.R_camera_foot


def _joint_region(feet: list[FootExpectation], camera: CameraModel) -> Region | None:
    regions = [region for foot in feet if (region := expected_region(foot, _REACH_M, camera)) is not None]
    return reduce(Region.joined, regions) if regions else None
