"""The depth stage: position of a foot with an occluded marker, from its blob in the depth image.

While marker and blob are both visible, the mean and variance of the offset from the blob's centroid to the marker are
estimated in the foot's frame; the variance becomes the covariance of later positions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Final, Literal

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.hull import Region
from rhot.geometry.rotations import cross_matrix
from rhot.types import Side
from rhot_feet.depth.plane import COARSE_PX, FINE_PX, FloorPlane, PixelRays, PointGrid, find_floor
from rhot_feet.depth.segmentation import (
    RADIUS_M,
    BlobSeed,
    FootBlob,
    SurfaceShape,
    SurfaceView,
    find_blobs,
    sample_shape,
)
from rhot_feet.frames import DepthFrame
from rhot_feet.prediction import GATE_SIGMAS, OTHER_FOOT, FootPrediction, innovation_distance, predicted_region

_AREA_RATIO: Final = (0.4, 2.0)
"""Accepted range of the visible surface relative to the usual one."""
_MOST_CUT: Final = 0.5
"""Largest share of the outline at the image border."""
_LEAST_VISIBLE: Final = 0.2
"""Smallest visible share of the foot's surface."""

# The model of a foot's blob: averaged while its marker is seen, used later to check blobs and find the marker.

BlobRefusal = Literal["hidden", "size", "cut", "unsettled", "other", "motion"]


@dataclass(frozen=True, slots=True)
class Neighbour:
    """Another foot in the same image.

    Attributes:
        position: (3,) of its marker, metres, camera frame.
        share: visible share of its usual surface.
    """

    position: FloatArray
    share: float

    def excludes(self, position: FloatArray, share: float) -> bool:
        """Return whether a blob at a position (3,), with this share of a foot's surface, belongs to this foot."""
        distance = float(np.linalg.norm(position - self.position))
        # Closer blobs are the same foot; so are those up to 15 cm apart whose surfaces together are below 1.4 of
        # the usual surface of one foot.
        return distance < (0.15 if self.share + share < 1.4 else 0.08)


@dataclass(frozen=True, slots=True)
class BlobModel:
    """The offset from a blob's centroid to the marker, and the usual surface of a foot.

    Attributes:
        mean: (3,) metres, foot frame, or camera frame while the foot's orientation is unknown.
        variance: (3,) about the mean.
        area: usual `FootBlob.area` of the whole foot.
        count: number of observations.
        shape: the foot's surface, in the frame of `mean`.
        in_foot: whether this is the foot's frame.
    """

    mean: FloatArray
    variance: FloatArray
    area: float
    count: int
    shape: SurfaceShape
    in_foot: bool

    def serves(self, foot: FootPrediction) -> bool:
        """Return whether the model's frame is available in a prediction."""
        return self.in_foot == (foot.R_camera_foot is not None)

    def share(self, blob: FootBlob) -> float:
        """Return the ratio of a blob's surface to the expected visible surface."""
        return blob.area / (max(blob.in_sight, _LEAST_VISIBLE) * self.area)

    def check(
        self, foot: FootPrediction, blob: FootBlob, others: Sequence[Neighbour], up: FloatArray
    ) -> FloatArray | BlobRefusal:
        """Return the covariance (3, 3) of a blob's position, m², camera frame, or why it is rejected.

        Args:
            foot: the filter's prediction.
            blob: the blob.
            others: other feet in the same image.
            up: (3,) unit vector against gravity, camera frame.
        """
        ratio = self.share(blob)
        wrong: dict[BlobRefusal, bool] = {
            "hidden": blob.in_sight < _LEAST_VISIBLE,
            "other": any(other.excludes(blob.position, ratio) for other in others),
            "size": not _AREA_RATIO[0] <= ratio <= _AREA_RATIO[1],
            "cut": blob.cut > _MOST_CUT,
            "unsettled": not blob.settled,
        }
        reason = next((reason for reason, holds in wrong.items() if holds), None)
        if reason is not None:
            return reason
        covariance = self._covariance(foot, blob, ratio, up)
        return "motion" if innovation_distance(blob.position, covariance, foot) > GATE_SIGMAS else covariance

    def _covariance(self, foot: FootPrediction, blob: FootBlob, ratio: float, up: FloatArray) -> FloatArray:
        R = axes(foot)
        # A blob that shows less of the foot than usual has its centre elsewhere.
        # Growth of the noise per e-fold of that ratio, and with the hidden share.
        doubt = 1.0 + 1.5 * abs(float(np.log(ratio))) + 1.0 * (1.0 - blob.in_sight)
        variance = (self.variance + 0.004**2) * doubt**2
        # Part of an error of the predicted height that remains in the result, because the blob is cut off at
        # the predicted height.
        level_variance = 0.4**2 * float(up @ foot.covariance @ up)
        covariance: FloatArray = R @ np.diag(variance) @ R.T + level_variance * np.outer(up, up)
        if foot.orientation_covariance is not None:
            seen = blob.compared
            arm = cross_matrix(blob.position - np.average(blob.points[seen], axis=0, weights=blob.weights[seen]))
            covariance += arm @ foot.orientation_covariance @ arm.T
        return covariance


def update_blob_model(
    foot: FootPrediction, blob: FootBlob, grid: PointGrid, camera: CameraModel, known: BlobModel | None
) -> BlobModel | None:
    """Return the model after one more observation of marker and blob; unchanged if too little of the foot is visible.

    Args:
        foot: pose of the marker.
        blob: its blob in the same image.
        grid: the points of that image.
        camera: the camera's model.
        known: the former model, in the same axes; None at first.
    """
    if blob.cut > _MOST_CUT or blob.in_sight < _LEAST_VISIBLE:
        return known
    R = axes(foot)
    offset = R.T @ (foot.position - blob.centroid)
    area = blob.area / blob.in_sight
    view = SurfaceView(grid, camera, foot.position, R)
    shape = sample_shape((blob.points - foot.position) @ R, blob.weights, blob.whole_area, view)
    if known is None:
        # Standard deviation of an offset seen once, and its lower bound, per
        # axis.
        return BlobModel(offset, np.full(3, 0.02**2), area, 1, shape, foot.R_camera_foot is not None)
    # Smallest weight of a new image in the averages.
    share = max(1.0 / (known.count + 1), 0.03)
    difference = offset - known.mean
    now = BlobModel(
        known.mean + share * difference,
        (1.0 - share) * (known.variance + share * difference**2),
        known.area + share * (area - known.area),
        known.count + 1,
        known.shape,
        known.in_foot,
    )
    # The shape is what was seen most of. Another one has its centroid and its surface elsewhere.
    # The shape is updated by a blob with at least this share of the largest surface seen.
    if shape.area > 0.95 * known.shape.area:
        moved = known.shape.mean - shape.mean
        return replace(now, mean=now.mean + moved, area=now.area * shape.area / known.shape.area, shape=shape)
    return now


def axes(foot: FootPrediction) -> FloatArray:
    """Return the frame (3, 3) in which a foot's model is kept: its own, or the camera's while it is not known."""
    return np.eye(3) if foot.R_camera_foot is None else foot.R_camera_foot


DepthRefusal = Literal["unknown", "vague"] | BlobRefusal

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
            T_rig_camera: (4, 4) if the head's pose is known; the floor is then measured every 60 ms only.
        """
        if frame.depth_mm is None:
            self._floor, self._floor_t_ns = None, None
        elif frame.t_ns != self._floor_t_ns:
            known = self._measured_floor
            # Interval at which the floor is measured; in between it is transformed by the head's pose.
            if known is not None and T_rig_camera is not None and 0 < frame.t_ns - known.t_ns < 60_000_000:
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
    # Largest standard deviation of a prediction, in any direction, with which a blob is assigned to a foot while
    # the other foot's position is unknown.
    return float(np.linalg.eigvalsh(foot.covariance)[-1]) > 0.06**2


def _joint_region(feet: list[FootPrediction], camera: CameraModel) -> Region | None:
    regions = [region for foot in feet if (region := predicted_region(foot, _REACH_M, camera)) is not None]
    return reduce(Region.joined, regions) if regions else None
