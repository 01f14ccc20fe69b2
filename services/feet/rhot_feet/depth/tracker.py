"""The depth stage: position of a foot with an occluded marker, from its blob in the depth image.

While marker and blob are both visible, the mean and variance of the offset from the blob's centroid to the marker are
estimated in the foot's frame; the variance becomes the covariance of later positions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import reduce
from typing import Final, Literal

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.region import Region
from rhot.messages import Side
from rhot_feet.depth.blob_model import BlobModel, BlobRefusal, Neighbour, axes, update_blob_model
from rhot_feet.depth.floor import FloorPlane, find_floor
from rhot_feet.depth.points import COARSE_PX, FINE_PX, PixelRays
from rhot_feet.depth.segmentation import RADIUS_M, BlobSeed, FootBlob, find_blobs
from rhot_feet.frames import DepthFrame
from rhot_feet.prediction import OTHER_FOOT, FootPrediction, predicted_region

DepthRefusal = Literal["unknown", "vague"] | BlobRefusal

_VAGUE_M: Final = 0.06
"""Largest standard deviation of a prediction, in any direction, with which a blob is assigned to a foot while the other
foot's position is unknown."""
_FLOOR_NS: Final = 60_000_000
"""Interval at which the floor is measured; in between it is transformed by the head's pose."""
_REACH_M: Final = RADIUS_M + 0.06
_UPRIGHT: Final = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True, slots=True)
class FootDepth:
    """An accepted observation of a foot in one depth image.

    Attributes:
        t_ns: time of the picture, rig clock.
        position: (3,) of its marker, metres, camera frame.
        covariance: (3, 3) of the position.
        points: number of depth points behind it.
    """

    t_ns: int
    position: FloatArray
    covariance: FloatArray
    points: int


@dataclass(frozen=True, slots=True)
class DepthObservations:
    """The depth stage's results for one image.

    Attributes:
        feet: accepted observations by foot.
        refused: reason by foot why its blob was rejected.
        floor: the floor, if visible.
        points: by foot, the points (N, 3) of its blob, metres, camera frame, accepted or not.
    """

    feet: dict[Side, FootDepth]
    refused: dict[Side, DepthRefusal]
    floor: FloorPlane | None
    points: dict[Side, FloatArray] = field(default_factory=dict)


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
        self._models: dict[Side, BlobModel] = {}
        self._floor: FloorPlane | None = None
        self._floor_t_ns: int | None = None
        self._measured_floor: _MeasuredFloor | None = None
        self._fine: PixelRays | None = None
        self._coarse: PixelRays | None = None

    def find_floor(
        self, frame: DepthFrame, up_camera: FloatArray | None = None, T_rig_camera: FloatArray | None = None
    ) -> FloorPlane | None:
        """Return the floor in an image, computed once per image; None if it is not visible.

        Args:
            frame: the image with its depth.
            up_camera: (3,) unit vector against gravity, camera frame, if the head's pose is known.
            T_rig_camera: (4, 4) if the head's pose is known; the floor is then measured only every `_FLOOR_NS`.
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

    def detect(
        self,
        frame: DepthFrame,
        expected: Mapping[Side, FootPrediction],
        seen: Mapping[Side, FootPrediction],
        up_camera: FloatArray | None = None,
        *,
        update_models: bool = True,
    ) -> DepthObservations:
        """Process one image: update the models of feet with a visible marker, and find the other feet.

        Args:
            frame: the image with its depth.
            expected: predictions of the feet whose marker is occluded.
            seen: poses of the visible markers in this image.
            up_camera: (3,) unit vector against gravity, camera frame, if the head's pose is known.
            update_models: whether to update the models; otherwise feet with a visible marker only claim their points.
        """
        hidden = {side: foot for side, foot in expected.items() if side not in seen}
        present = hidden | dict(seen)
        models = {
            side: known
            for side, foot in present.items()
            if (known := self._models.get(side)) is not None and known.serves(foot)
        }
        refused: dict[Side, DepthRefusal] = {side: "unknown" for side in hidden if side not in models}
        if len({*models, *seen}) < len(OTHER_FOOT):
            refused |= {side: "vague" for side, foot in hidden.items() if side in models and _is_vague(foot)}
        hidden = {side: foot for side, foot in hidden.items() if side not in refused}
        floor = self.find_floor(frame, up_camera)
        if frame.depth_mm is None or not (hidden or seen):
            return DepthObservations({}, refused, floor)
        region = _joint_region([*hidden.values(), *(seen.values() if update_models else ())], frame.camera)
        if region is None:
            return DepthObservations({}, refused | dict.fromkeys(hidden, "hidden"), floor)
        grid = self._rays(frame.camera).points(frame.depth_mm, region, self._depth_range_m)
        up = self._up(up_camera)
        seeds = {
            side: _seed(foot, models.get(side), fixed=side in seen) for side, foot in (hidden | dict(seen)).items()
        }
        blobs = find_blobs(grid, seeds, floor, up, frame.camera)
        for side, foot in seen.items() if update_models else ():
            blob = blobs.get(side)
            now = None if blob is None else update_blob_model(foot, blob, grid, frame.camera, models.get(side))
            if now is not None:
                self._models[side] = now
        feet: dict[Side, FootDepth] = {}
        for side, verdict in _verdicts(hidden, blobs, models, up).items():
            if isinstance(verdict, str):
                refused[side] = verdict
            else:
                feet[side] = FootDepth(frame.t_ns, blobs[side].position, verdict, len(blobs[side].points))
        return DepthObservations(feet, refused, floor, {side: blob.points for side, blob in blobs.items()})

    def _rays(self, camera: CameraModel) -> PixelRays:
        if self._fine is None or self._fine.camera is not camera:
            self._fine = PixelRays(camera, FINE_PX)
        return self._fine

    def _up(self, up_camera: FloatArray | None) -> FloatArray:
        if up_camera is not None:
            return up_camera
        return _UPRIGHT if self._floor is None else self._floor.up


def _seed(foot: FootPrediction, known: BlobModel | None, *, fixed: bool) -> BlobSeed:
    """Return the start of the search for a foot's blob; without a model, the position is fixed."""
    if known is None:
        return BlobSeed(foot.position, np.zeros(3), fixed=True)
    R = axes(foot)
    return BlobSeed(foot.position, R @ known.mean, known.shape.rotated(R), fixed=fixed)


def _verdicts(
    hidden: Mapping[Side, FootPrediction],
    blobs: Mapping[Side, FootBlob],
    models: Mapping[Side, BlobModel],
    up: FloatArray,
) -> dict[Side, FloatArray | BlobRefusal]:
    """Return for each occluded foot the covariance (3, 3) of its blob's position, or why the blob is rejected."""
    neighbours = {
        side: Neighbour(blob.position, models[side].share(blob) if side in models else 1.0)
        for side, blob in blobs.items()
    }
    verdicts: dict[Side, FloatArray | BlobRefusal] = {}
    for side, foot in hidden.items():
        blob = blobs.get(side)
        others = [neighbour for other, neighbour in neighbours.items() if other != side]
        verdicts[side] = "hidden" if blob is None else models[side].check(foot, blob, others, up)
    return verdicts


def _is_vague(foot: FootPrediction) -> bool:
    return float(np.linalg.eigvalsh(foot.covariance)[-1]) > _VAGUE_M**2


def _joint_region(feet: list[FootPrediction], camera: CameraModel) -> Region | None:
    regions = [region for foot in feet if (region := predicted_region(foot, _REACH_M, camera)) is not None]
    return reduce(Region.joined, regions) if regions else None
