"""What is learnt about a foot while marker and blob are both seen, and what of a blob is believed by it later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import cross_matrix
from rhot_feet.depth.points import PointGrid
from rhot_feet.depth.segmentation import FootBlob
from rhot_feet.depth.visibility import SurfaceShape, SurfaceView, sample_shape
from rhot_feet.prediction import GATE_SIGMAS, FootPrediction, innovation_distance

FloatArray = NDArray[np.float64]

BlobRefusal = Literal["hidden", "size", "cut", "unsettled", "other", "motion"]

_FORGETTING: Final = 0.03
_FIRST_SIGMA_M: Final = 0.02
"""Per axis, of an offset that was seen once."""
_LEAST_SIGMA_M: Final = 0.004
_AREA_RATIO: Final = (0.4, 2.0)
"""A blob that shows less or more of its usual surface than this is half hidden, or more than a foot."""
_AREA_SIGMA: Final = 1.5
_HIDDEN_SIGMA: Final = 1.0
"""By how much more a position is in doubt when hardly anything of the foot is in sight."""
_MAX_CUT: Final = 0.5
_LEAST_IN_SIGHT: Final = 0.2
"""Share of the foot's surface; of less the rest cannot be told."""
_WHOLE_SHARE: Final = 0.95
"""A sighting of nearly the most surface ever seen renews a foot's shape."""
_LEVEL_SHARE: Final = 0.4
"""Part of an error of the expected height that remains in the found one: the blob is cut off in relation to it."""
_OTHER_FOOT_M: Final = 0.08
"""Two feet's markers cannot be closer: it is one foot, and the other one's."""
_BESIDE_M: Final = 0.15
_BOTH_SHARE: Final = 1.4
"""Feet so close that show less surface than this together, each foot's usual one being 1, are one foot in two parts."""


@dataclass(frozen=True, slots=True)
class Neighbour:
    """Another foot in the same picture.

    Attributes:
        position: (3,) of its marker, metres, camera frame.
        share: how much of its usual surface it shows.
    """

    position: FloatArray
    share: float

    def excludes(self, position: FloatArray, share: float) -> bool:
        """Tell whether a blob at a position (3,), which shows such a share of a foot, is this foot or part of it."""
        distance = float(np.linalg.norm(position - self.position))
        return distance < (_BESIDE_M if self.share + share < _BOTH_SHARE else _OTHER_FOOT_M)


@dataclass(frozen=True, slots=True)
class BlobModel:
    """From a blob's centroid to the marker, and how much of a foot is usually seen.

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
    shape: SurfaceShape
    in_foot: bool

    def serves(self, foot: FootPrediction) -> bool:
        """Tell whether it holds in the axes in which a foot is expected."""
        return self.in_foot == (foot.R_camera_foot is not None)

    def share(self, blob: FootBlob) -> float:
        """Return how much of the surface that should be in sight a blob shows."""
        return blob.area / (max(blob.in_sight, _LEAST_IN_SIGHT) * self.area)

    def check(
        self, foot: FootPrediction, blob: FootBlob, others: Sequence[Neighbour], up: FloatArray
    ) -> FloatArray | BlobRefusal:
        """Return the covariance (3, 3) of a blob's position, m², camera frame, or why it is not believed.

        Args:
            foot: what the filter predicts.
            blob: what was found.
            others: other feet in the same picture.
            up: (3,) unit vector against gravity, camera frame.
        """
        ratio = self.share(blob)
        wrong: dict[BlobRefusal, bool] = {
            "hidden": blob.in_sight < _LEAST_IN_SIGHT,
            "other": any(other.excludes(blob.position, ratio) for other in others),
            "size": not _AREA_RATIO[0] <= ratio <= _AREA_RATIO[1],
            "cut": blob.cut > _MAX_CUT,
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
        doubt = 1.0 + _AREA_SIGMA * abs(float(np.log(ratio))) + _HIDDEN_SIGMA * (1.0 - blob.in_sight)
        variance = (self.variance + _LEAST_SIGMA_M**2) * doubt**2
        level_variance = _LEVEL_SHARE**2 * float(up @ foot.covariance @ up)
        covariance: FloatArray = R @ np.diag(variance) @ R.T + level_variance * np.outer(up, up)
        if foot.orientation_covariance is not None:
            seen = blob.compared
            arm = cross_matrix(blob.position - np.average(blob.points[seen], axis=0, weights=blob.weights[seen]))
            covariance += arm @ foot.orientation_covariance @ arm.T
        return covariance


def update_blob_model(
    foot: FootPrediction, blob: FootBlob, grid: PointGrid, camera: CameraModel, known: BlobModel | None
) -> BlobModel | None:
    """Return what is known of a foot after one more sighting of marker and blob; as before where it shows too little.

    Args:
        foot: as the marker shows it.
        blob: its blob in the same picture.
        grid: the points of that picture.
        camera: its lens.
        known: what was known before, in the same axes.
    """
    if blob.cut > _MAX_CUT or blob.in_sight < _LEAST_IN_SIGHT:
        return known
    R = axes(foot)
    offset = R.T @ (foot.position - blob.centroid)
    area = blob.area / blob.in_sight
    view = SurfaceView(grid, camera, foot.position, R)
    shape = sample_shape((blob.points - foot.position) @ R, blob.weights, blob.whole_area, view)
    if known is None:
        return BlobModel(offset, np.full(3, _FIRST_SIGMA_M**2), area, 1, shape, foot.R_camera_foot is not None)
    share = max(1.0 / (known.count + 1), _FORGETTING)
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
    if shape.area > _WHOLE_SHARE * known.shape.area:
        moved = known.shape.mean - shape.mean
        return replace(now, mean=now.mean + moved, area=now.area * shape.area / known.shape.area, shape=shape)
    return now


def axes(foot: FootPrediction) -> FloatArray:
    """Return the frame (3, 3) in which a foot is learnt: its own, or the camera's while it is not known."""
    return np.eye(3) if foot.R_camera_foot is None else foot.R_camera_foot
