"""The model of a foot's blob: averaged while its marker is seen, used later to check blobs and find the marker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import cross_matrix
from rhot_feet.depth.points import PointGrid
from rhot_feet.depth.segmentation import FootBlob
from rhot_feet.depth.visibility import SurfaceShape, SurfaceView, sample_shape
from rhot_feet.prediction import GATE_SIGMAS, FootPrediction, innovation_distance

BlobRefusal = Literal["hidden", "size", "cut", "unsettled", "other", "motion"]


@dataclass(frozen=True, slots=True)
class BlobModelSettings:
    """How a foot's blob is averaged and checked; values chosen on `rhot evaluate feet --runs depth`.

    Attributes:
        forgetting: smallest weight of a new image in the averages.
        first_sigma_m, least_sigma_m: standard deviation of an offset seen once, and its lower bound, per axis.
        area_ratio: accepted range of the visible surface relative to the usual one.
        area_sigma, hidden_sigma: growth of the noise per e-fold of that ratio, and with the hidden share.
        most_cut: largest share of the outline at the image border.
        least_visible: smallest visible share of the foot's surface.
        whole_share: the shape is updated by a blob with at least this share of the largest surface seen.
        level_share: part of an error of the predicted height that remains in the result, because the blob is cut off at
            the predicted height.
        other_foot_m: smallest distance of two feet's markers; closer blobs are the same foot.
        beside_m, both_share: closer feet whose surfaces together are below `both_share` (usual surface of each: 1) are
            the same foot.
    """

    forgetting: float = 0.03
    first_sigma_m: float = 0.02
    least_sigma_m: float = 0.004
    area_ratio: tuple[float, float] = (0.4, 2.0)
    area_sigma: float = 1.5
    hidden_sigma: float = 1.0
    most_cut: float = 0.5
    least_visible: float = 0.2
    whole_share: float = 0.95
    level_share: float = 0.4
    other_foot_m: float = 0.08
    beside_m: float = 0.15
    both_share: float = 1.4


SETTINGS: Final = BlobModelSettings()


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
        return distance < (SETTINGS.beside_m if self.share + share < SETTINGS.both_share else SETTINGS.other_foot_m)


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
        return blob.area / (max(blob.in_sight, SETTINGS.least_visible) * self.area)

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
            "hidden": blob.in_sight < SETTINGS.least_visible,
            "other": any(other.excludes(blob.position, ratio) for other in others),
            "size": not SETTINGS.area_ratio[0] <= ratio <= SETTINGS.area_ratio[1],
            "cut": blob.cut > SETTINGS.most_cut,
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
        doubt = 1.0 + SETTINGS.area_sigma * abs(float(np.log(ratio))) + SETTINGS.hidden_sigma * (1.0 - blob.in_sight)
        variance = (self.variance + SETTINGS.least_sigma_m**2) * doubt**2
        level_variance = SETTINGS.level_share**2 * float(up @ foot.covariance @ up)
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
    if blob.cut > SETTINGS.most_cut or blob.in_sight < SETTINGS.least_visible:
        return known
    R = axes(foot)
    offset = R.T @ (foot.position - blob.centroid)
    area = blob.area / blob.in_sight
    view = SurfaceView(grid, camera, foot.position, R)
    shape = sample_shape((blob.points - foot.position) @ R, blob.weights, blob.whole_area, view)
    if known is None:
        return BlobModel(offset, np.full(3, SETTINGS.first_sigma_m**2), area, 1, shape, foot.R_camera_foot is not None)
    share = max(1.0 / (known.count + 1), SETTINGS.forgetting)
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
    if shape.area > SETTINGS.whole_share * known.shape.area:
        moved = known.shape.mean - shape.mean
        return replace(now, mean=now.mean + moved, area=now.area * shape.area / known.shape.area, shape=shape)
    return now


def axes(foot: FootPrediction) -> FloatArray:
    """Return the frame (3, 3) in which a foot's model is kept: its own, or the camera's while it is not known."""
    return np.eye(3) if foot.R_camera_foot is None else foot.R_camera_foot
