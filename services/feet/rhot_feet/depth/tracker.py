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

from rhot.geometry.camera import CameraModel
from rhot.messages import Side
from rhot_feet.depth.blob import find_blobs
from rhot_feet.depth.floor import FloorPlane, find_floor
from rhot_feet.depth.learnt import BlobRefusal, LearntFoot, Neighbour, axes, learnt_from
from rhot_feet.depth.points import COARSE_PX, FINE_PX, PixelRays
from rhot_feet.depth.search import RADIUS_M, BlobSeed
from rhot_feet.expectation import OTHER_FOOT, FootExpectation, expected_region
from rhot_feet.frames import DepthFrame
from rhot_feet.region import Region

FloatArray = NDArray[np.float64]

DepthRefusal = Literal["unknown", "vague"] | BlobRefusal

_VAGUE_M: Final = 0.06
"""A foot that is worse expected than this, in any direction, may be taken for the other one, unless it is known where
that is."""
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
        self._learnt: dict[Side, LearntFoot] = {}
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
        present = hidden | dict(seen)
        learnt = {
            side: known
            for side, foot in present.items()
            if (known := self._learnt.get(side)) is not None and known.serves(foot)
        }
        refused: dict[Side, DepthRefusal] = {side: "unknown" for side in hidden if side not in learnt}
        if len({*learnt, *seen}) < len(OTHER_FOOT):
            refused |= {side: "vague" for side, foot in hidden.items() if side in learnt and _is_vague(foot)}
        hidden = {side: foot for side, foot in hidden.items() if side not in refused}
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
                R = axes(foot)
                seeds[side] = BlobSeed(foot.place, R @ known.mean, known.shape.turned(R), fixed=side in seen)
        grid = self._rays(frame.camera).points(frame.depth_mm, region, self._depth_range_m)
        up = self._up(up_camera)
        blobs = find_blobs(grid, seeds, floor, up, frame.camera)
        for side, foot in seen.items() if learns else ():
            blob = blobs.get(side)
            now = None if blob is None else learnt_from(foot, blob, grid, frame.camera, learnt.get(side))
            if now is not None:
                self._learnt[side] = now
        feet: dict[Side, FootDepth] = {}
        neighbours = {
            side: Neighbour(blob.place, learnt[side].share(blob) if side in learnt else 1.0)
            for side, blob in blobs.items()
        }
        for side, foot in hidden.items():
            blob = blobs.get(side)
            if blob is None:
                refused[side] = "hidden"
                continue
            others = [neighbour for other, neighbour in neighbours.items() if other != side]
            outcome = learnt[side].judged(foot, blob, others, up)
            if isinstance(outcome, str):
                refused[side] = outcome
            else:
                feet[side] = FootDepth(frame.t_ns, blob.place, outcome, len(blob.points))
        return DepthSightings(feet, refused, floor)

    def _rays(self, camera: CameraModel) -> PixelRays:
        if self._fine is None or self._fine.camera is not camera:
            self._fine = PixelRays(camera, FINE_PX)
        return self._fine

    def _up(self, up_camera: FloatArray | None) -> FloatArray:
        if up_camera is not None:
            return up_camera
        return _UPRIGHT if self._floor is None else self._floor.up


def _is_vague(foot: FootExpectation) -> bool:
    return float(np.linalg.eigvalsh(foot.covariance)[-1]) > _VAGUE_M**2


def _joint_region(feet: list[FootExpectation], camera: CameraModel) -> Region | None:
    regions = [region for foot in feet if (region := expected_region(foot, _REACH_M, camera)) is not None]
    return reduce(Region.joined, regions) if regions else None
