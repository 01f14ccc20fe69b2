"""What a calibration is worth: reprojection and epipolar errors, uncertainties, and the error to expect in space."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel, epipolar_distance, meeting_points
from rhot.geometry.rotations import cross_matrix, inverse, rigid, rotation_from_vector
from rhot_calibration.cameras.bundle.adjustment import Adjusted
from rhot_calibration.cameras.bundle.lens import LENS_NAMES, LENS_SIZE, camera_matrix

DISTANCES_M: Final = (0.50, 0.75, 1.00)
"""Where the error in space is stated, along the reference camera's axis."""
MARKER_SIGMA_PX: Final = 0.1
"""Spread of a marker's centre in one picture that the stated error holds for."""
_DRAWS: Final = 60


@dataclass(frozen=True, slots=True)
class CameraFigures:
    """One camera.

    Attributes:
        pictures: that were used.
        rms_px, p95_px: of the distance between corners as seen and as projected.
        lens_sd: standard deviation of each lens parameter, in the order of `lens.LENS_NAMES`.
        position_sd_mm, rotation_sd_deg: of T_rig_camera; 0 for the reference.
    """

    pictures: int
    rms_px: float
    p95_px: float
    lens_sd: FloatArray
    position_sd_mm: float
    rotation_sd_deg: float


@dataclass(frozen=True, slots=True)
class PairFigures:
    """Two cameras.

    Attributes:
        pictures: in which both saw the board at one place.
        baseline_mm, baseline_sd_mm: distance of their optical centres and its standard deviation.
        angle_deg: between their optical axes.
        epipolar_rms_px, epipolar_p95_px: distance of a corner from its epipolar line.
    """

    pictures: int
    baseline_mm: float
    baseline_sd_mm: float
    angle_deg: float
    epipolar_rms_px: float
    epipolar_p95_px: float


@dataclass(frozen=True, slots=True)
class ExpectedError:
    """Error of a point in space at one distance, mm; see `expected_errors`.

    Attributes:
        distance_m: along the reference camera's axis.
        calibration_mm: that the calibration's own uncertainty causes: RMS of the median place in the picture.
        total_mm: the same with the noise of markers, one picture per camera.
        rim_mm: `total_mm` of the worst tenth of the picture, where few corners may have been.
    """

    distance_m: float
    calibration_mm: float
    total_mm: float
    rim_mm: float


def camera_figures(adjusted: Adjusted) -> dict[str, CameraFigures]:
    """Return the figures of every camera."""
    distance = np.linalg.norm(adjusted.bundle.residuals, axis=2)
    sd = np.sqrt(np.maximum(np.diag(adjusted.bundle.covariance), 0.0))
    seen = adjusted.observations.seen
    result = {}
    for index, name in enumerate(adjusted.cameras):
        chosen = adjusted.observations.camera == index
        values = distance[chosen][seen[chosen]]
        position, rotation = (0.0, 0.0) if index == 0 else _pose_sd(adjusted, index)
        result[name] = CameraFigures(
            pictures=int(chosen.sum()),
            rms_px=float(np.sqrt(np.mean(values**2))),
            p95_px=float(np.percentile(values, 95)),
            lens_sd=sd[index * LENS_SIZE : (index + 1) * LENS_SIZE],
            position_sd_mm=1e3 * position,
            rotation_sd_deg=float(np.degrees(rotation)),
        )
    return result


def pair_figures(adjusted: Adjusted, models: Mapping[str, CameraModel]) -> dict[tuple[str, str], PairFigures]:
    """Return the figures of every two cameras that saw the board at one place."""
    result = {}
    for first, second in combinations(adjusted.cameras, 2):
        errors, pictures = epipolar_errors(adjusted, models, first, second)
        if not pictures:
            continue
        axes = models[first].T_rig_camera[:3, 2] @ models[second].T_rig_camera[:3, 2]
        baseline = models[second].center - models[first].center
        length = float(np.linalg.norm(baseline))
        covariance = _center_covariance(adjusted, first) + _center_covariance(adjusted, second)
        if adjusted.cameras[0] not in (first, second):
            cross = _center_covariance(adjusted, first, second)
            covariance = covariance - cross - cross.T
        direction: FloatArray = baseline / max(length, 1e-9)
        result[first, second] = PairFigures(
            pictures=pictures,
            baseline_mm=1e3 * length,
            baseline_sd_mm=1e3 * float(np.sqrt(max(float(direction @ covariance @ direction), 0.0))),
            angle_deg=float(np.degrees(np.arccos(np.clip(axes, -1.0, 1.0)))),
            epipolar_rms_px=float(np.sqrt(np.mean(errors**2))),
            epipolar_p95_px=float(np.percentile(np.abs(errors), 95)),
        )
    return result


def epipolar_errors(
    adjusted: Adjusted, models: Mapping[str, CameraModel], first: str, second: str
) -> tuple[FloatArray, int]:
    """Return the signed distances of the second camera's corners from the epipolar lines of the first's.

    Returns:
        (n,) pixels of an undistorted picture with the second camera's focal length; and the number of pictures.
    """
    observations = adjusted.observations
    rows = {
        name: {
            int(place): row
            for row, (camera, place) in enumerate(zip(observations.camera, observations.place, strict=True))
            if adjusted.cameras[camera] == name
        }
        for name in (first, second)
    }
    errors = []
    for place in rows[first].keys() & rows[second].keys():
        a, b = rows[first][place], rows[second][place]
        both = observations.seen[a] & observations.seen[b]
        if both.any():
            errors.append(
                epipolar_distance(models[first], models[second], observations.uv[a, both], observations.uv[b, both])
            )
    return (np.concatenate(errors) if errors else np.empty(0)), len(errors)


def expected_errors(adjusted: Adjusted, models: Mapping[str, CameraModel]) -> list[ExpectedError]:
    """Return how far off a point in space will be at `DISTANCES_M`, by drawing calibrations from the covariance.

    Points on a grid before the reference camera, seen by two cameras or more, are projected with the calibration and
    brought back with a drawn one, once without and once with noise of `MARKER_SIGMA_PX`. The error is one of places
    relative to the rig frame; a common tilt of all of it counts too.
    """
    rng = np.random.default_rng(0)
    drawn = [_drawn(adjusted, models, rng) for _ in range(_DRAWS)]
    result = []
    for distance in DISTANCES_M:
        points = _points_at(next(iter(models.values())), distance)
        seen = np.stack([model.contains(model.project(points)) for model in models.values()])
        kept = seen.sum(axis=0) >= 2
        points, seen = points[kept], seen[:, kept]
        if not len(points):
            continue
        pixels = [model.project(points) for model in models.values()]
        errors: list[list[FloatArray]] = [[], []]
        for cameras in drawn:
            for index, sigma in enumerate((0.0, MARKER_SIGMA_PX)):
                noisy = [uv + sigma * rng.standard_normal(uv.shape) for uv in pixels]
                found = meeting_points(cameras, noisy, seen)
                errors[index].append(np.sum((found - points) ** 2, axis=1))
        calibration, total = (1e3 * np.sqrt(np.mean(each, axis=0)) for each in errors)
        result.append(
            ExpectedError(
                distance, float(np.median(calibration)), float(np.median(total)), float(np.percentile(total, 90))
            )
        )
    return result


def lens_sd_named(figures: CameraFigures) -> dict[str, float]:
    """Return the standard deviations of a lens by name."""
    return dict(zip(LENS_NAMES, figures.lens_sd.tolist(), strict=True))


def _pose_columns(adjusted: Adjusted, index: int) -> slice:
    start = len(adjusted.cameras) * LENS_SIZE + (index - 1) * 6
    return slice(start, start + 6)


def _pose_sd(adjusted: Adjusted, index: int) -> tuple[float, float]:
    """Return the standard deviation of a camera's centre, metres, and of its rotation, radians (RMS of an axis)."""
    at = _pose_columns(adjusted, index)
    rotation = adjusted.bundle.covariance[at, at][:3, :3]
    center = _center_covariance(adjusted, adjusted.cameras[index])
    return float(np.sqrt(np.trace(center) / 3.0)), float(np.sqrt(np.trace(rotation) / 3.0))


def _center_covariance(adjusted: Adjusted, first: str, second: str | None = None) -> FloatArray:
    """Return the covariance (3, 3) of a camera's centre in the rig frame, or of two cameras' with each other, m²."""
    a = adjusted.cameras.index(first)
    b = a if second is None else adjusted.cameras.index(second)
    if 0 in (a, b):
        return np.zeros((3, 3))
    block = adjusted.bundle.covariance[_pose_columns(adjusted, a), _pose_columns(adjusted, b)]
    covariance: FloatArray = _center_by_motion(adjusted, a) @ block @ _center_by_motion(adjusted, b).T
    return covariance


def _center_by_motion(adjusted: Adjusted, index: int) -> FloatArray:
    # c = −Rᵀ·t; with R ← exp(δω)·R and t ← t + δt: δc = −Rᵀ·[t]×·δω − Rᵀ·δt.
    R, t = adjusted.bundle.geometry.camera_R[index], adjusted.bundle.geometry.camera_t[index]
    return np.hstack([-R.T @ cross_matrix(t), -R.T])


def _drawn(adjusted: Adjusted, models: Mapping[str, CameraModel], rng: np.random.Generator) -> list[CameraModel]:
    """Return cameras as the calibration might as well have found them."""
    count = len(adjusted.cameras)
    size = count * LENS_SIZE + (count - 1) * 6
    covariance = adjusted.bundle.covariance[:size, :size]
    step = _factor(covariance) @ rng.standard_normal(size)
    lenses = adjusted.bundle.geometry.lenses + step[: count * LENS_SIZE].reshape(count, LENS_SIZE)
    motion = np.zeros((count, 6))
    motion[1:] = step[count * LENS_SIZE :].reshape(-1, 6)
    cameras = []
    for index, model in enumerate(models.values()):
        R = rotation_from_vector(motion[index, :3]) @ adjusted.bundle.geometry.camera_R[index]
        t = adjusted.bundle.geometry.camera_t[index] + motion[index, 3:]
        K = camera_matrix(lenses[index])
        cameras.append(CameraModel.from_arrays(model.width, model.height, K, lenses[index, 4:], inverse(rigid(R, t))))
    return cameras


def _factor(covariance: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    factor: FloatArray = vectors * np.sqrt(np.maximum(values, 0.0))
    return factor


def _points_at(reference: CameraModel, distance_m: float) -> FloatArray:
    grid = (7, 5)
    columns, rows = grid
    u, v = np.meshgrid(
        np.linspace(0.05, 0.95, columns) * (reference.width - 1), np.linspace(0.05, 0.95, rows) * (reference.height - 1)
    )
    xy = reference.undistort(np.column_stack([u.ravel(), v.ravel()]))
    in_camera = distance_m * np.column_stack([xy, np.ones(len(xy))])
    points: FloatArray = in_camera @ reference.T_rig_camera[:3, :3].T + reference.center
    return points
