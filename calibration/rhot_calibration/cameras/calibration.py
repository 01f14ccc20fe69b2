"""The whole calibration of the cameras: solved, explained, judged, and ready to be written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.camera import CameraModel, epipolar_distance
from rhot.geometry.rotations import inverse
from rhot.rig import CameraCalibration, CamerasFile, Rig
from rhot.rig.calibration import today
from rhot.rig.cameras import camera_entry
from rhot.rig.folder import nominal_camera
from rhot_calibration.cameras.bundle.adjustment import Adjusted, adjust_views
from rhot_calibration.cameras.bundle.lens import camera_matrix, lens_of
from rhot_calibration.cameras.figures import (
    CameraFigures,
    ExpectedError,
    PairFigures,
    camera_figures,
    expected_errors,
    lens_sd_named,
    pair_figures,
)
from rhot_calibration.cameras.pictures import PictureReading
from rhot_calibration.cameras.refusals import (
    Expected,
    accuracy_warnings,
    refuse_contradictions,
    refuse_impossible,
    refuse_poor,
)
from rhot_calibration.cameras.solve.causes import Cause, contradiction_cause, unfit_cause
from rhot_calibration.cameras.solve.solve import Solution, solve
from rhot_calibration.cameras.solve.views import ViewSet

# From pictures of a board to the cameras of a rig, with what its folder says of them.


def calibrate_rig(
    rig: Rig, views: ViewSet, baseline_m: float | None, progress: Callable[[str], None] = lambda _: None
) -> Calibrated:
    """Return the calibration of a rig's cameras.

    Args:
        rig: its places and fields of view are roughly known from `rig.toml`.
        views: of the board.
        baseline_m: measured distance of the first two lenses; None = not measured.
        progress: told what is being done.

    Raises:
        CalibrationError: what cannot be right is refused, with the reason and what to do.
    """
    # The lenses start from rig.toml, not from the last calibration: a new camera may be in its place.
    nominal = {name: nominal_camera(camera) for name, camera in rig.config.cameras.items()}
    expected = Expected(
        nominal={name: np.array(camera.position_m) for name, camera in rig.config.cameras.items()},
        previous={name: np.array(camera.T_rig_camera)[:3, 3] for name, camera in rig.cameras.items()}
        if rig.calibrated
        else {},
        baseline_m=baseline_m,
    )
    return calibrate(views, nominal, expected, progress)


def refuse_other_board(reading: PictureReading) -> None:
    """Refuse pictures of which most show something else than the stated board.

    Raises:
        CalibrationError: names what they show.
    """
    views = reading.views
    if reading.hint:
        raise CalibrationError(f"the pictures show another board than {views.board}: {reading.hint}")
    if len(views.views) >= 0.5 * len(views.labels) and len(views.views):
        return
    count = reading.likely_count
    if count is not None:
        raise CalibrationError(
            f"the pictures show a board of {count[0]}x{count[1]} inner corners, not of {views.board.columns}x"
            f"{views.board.rows}: call again with --board {count[0]}x{count[1]} (count the points where squares meet)"
        )
    if reading.mirrored:
        raise CalibrationError(
            f"{', '.join(reading.mirrored[:3])}: the board is mirrored; switch the camera's mirroring off and take the "
            "pictures again"
        )
    if not views.views:
        raise CalibrationError(
            f"none of {len(views.labels)} pictures shows a {views.board}: is it wholly in the picture, sharp, evenly "
            "lit, with a white margin around it?"
        )


_FOLDS: Final = 3


@dataclass(frozen=True, slots=True)
class Calibrated:
    """An accepted calibration.

    Attributes:
        solution: how it was found.
        models: the cameras.
        cameras: figures by camera.
        pairs: figures by (first, second) camera.
        held_out_px: (first, second) camera to the 95th percentile of the epipolar error of pictures that were held out
            while calibrating with the others, pixels.
        errors: to expect in space.
        left_out: name of a picture to why it was not used, or for the lens only.
        warnings: what to do better.
    """

    solution: Solution
    models: Mapping[str, CameraModel]
    cameras: Mapping[str, CameraFigures]
    pairs: Mapping[tuple[str, str], PairFigures]
    held_out_px: Mapping[tuple[str, str], float]
    errors: Sequence[ExpectedError]
    left_out: Mapping[str, str]
    warnings: Sequence[str]


def calibrate(
    views: ViewSet,
    nominal: Mapping[str, CameraCalibration],
    expected: Expected,
    progress: Callable[[str], None] = lambda _: None,
) -> Calibrated:
    """Return the cameras' calibration.

    Args:
        views: of the board.
        nominal: first guess of the lenses, in the order of `rig.toml`; the first camera defines the rig frame.
        expected: what is known of the cameras' places.
        progress: told what is being done.

    Raises:
        CalibrationError: what cannot be right is refused, with the reason and what to do.
    """
    lenses = {name: lens_of(np.array(camera.K), np.array(camera.distortion)[:5]) for name, camera in nominal.items()}
    solution = solve(views, lenses, progress)
    progress("what did not fit, and why")
    unfit = [unfit_cause(views.board, solution, views, key) for key in solution.left_out]
    numbers = sorted({number for _, number in solution.split})
    contradictions = [contradiction_cause(views.board, solution, views, number) for number in numbers]
    warnings = refuse_contradictions(solution, contradictions)
    models = models_of(solution.adjusted, views)
    warnings += refuse_impossible(solution, models, expected, views.board.square_m)
    cameras = camera_figures(solution.adjusted)
    warnings += refuse_poor(views, solution, cameras, models)
    progress("what to expect of it")
    errors = expected_errors(solution.adjusted, models)
    return Calibrated(
        solution=solution,
        models=models,
        cameras=cameras,
        pairs=pair_figures(solution.adjusted, models),
        held_out_px=_held_out(views, solution),
        errors=errors,
        left_out=_left_out(views, [*unfit, *contradictions]),
        warnings=[*warnings, *accuracy_warnings(errors)],
    )


def models_of(adjusted: Adjusted, views: ViewSet) -> dict[str, CameraModel]:
    """Return the cameras of an adjustment."""
    return {
        name: CameraModel.from_arrays(
            *views.sizes[name],
            camera_matrix(adjusted.lens(name)),
            adjusted.lens(name)[4:],
            inverse(adjusted.T_camera_rig(name)),
        )
        for name in adjusted.cameras
    }


def cameras_file(calibrated: Calibrated, views: ViewSet) -> CamerasFile:
    """Return what is written into the rig folder."""
    cameras = {name: camera_entry(model) for name, model in calibrated.models.items()}
    return CamerasFile(date=today(), cameras=cameras, quality=_quality(calibrated, views))


def bow_mm(adjusted: Adjusted) -> float:
    """Return by how much the board's corners leave their best plane, from the lowest to the highest, mm."""
    corners = adjusted.bundle.geometry.corners
    centred = corners - corners.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    return 1e3 * float(np.ptp(centred @ normal))


def _quality(calibrated: Calibrated, views: ViewSet) -> dict[str, Any]:
    solution = calibrated.solution
    return {
        "board": str(views.board),
        "rms_px": round(solution.adjusted.total_rms_px(), 4),
        "board_shape": {
            "estimated": solution.adjusted.released,
            "bow_mm": round(bow_mm(solution.adjusted), 2),
            "rms_px_if_flat": round(solution.flat_rms_px, 4),
        },
        "cameras": {
            name: {
                "pictures": figures.pictures,
                "rms_px": round(figures.rms_px, 4),
                "p95_px": round(figures.p95_px, 4),
                "lens_sd": {key: float(f"{value:.3g}") for key, value in lens_sd_named(figures).items()},
                "position_sd_mm": round(figures.position_sd_mm, 3),
                "rotation_sd_deg": round(figures.rotation_sd_deg, 4),
            }
            for name, figures in calibrated.cameras.items()
        },
        "pairs": {
            f"{first}-{second}": {
                "pictures": figures.pictures,
                "baseline_mm": round(figures.baseline_mm, 3),
                "baseline_sd_mm": round(figures.baseline_sd_mm, 3),
                "angle_deg": round(figures.angle_deg, 3),
                "epipolar_rms_px": round(figures.epipolar_rms_px, 4),
                "epipolar_p95_px": round(figures.epipolar_p95_px, 4),
                "epipolar_p95_px_held_out": round(calibrated.held_out_px[first, second], 4)
                if (first, second) in calibrated.held_out_px
                else None,
            }
            for (first, second), figures in calibrated.pairs.items()
        },
        "expected_error_mm": {
            f"{100 * error.distance_m:.0f} cm": {
                "calibration": round(error.calibration_mm, 3),
                "with_marker_noise": round(error.total_mm, 3),
                "near_rim": round(error.rim_mm, 3),
            }
            for error in calibrated.errors
        },
        "left_out": dict(calibrated.left_out),
        "warnings": list(calibrated.warnings),
    }


def _left_out(views: ViewSet, causes: Sequence[Cause]) -> dict[str, str]:
    found = {}
    for cause in causes:
        label = " and ".join(views.labels[key] for key in cause.keys)
        found[label] = cause.text if cause.kind in ("misread", "unfit") else f"{cause.text}; used for the lenses alone"
    return found


def _held_out(views: ViewSet, solution: Solution) -> dict[tuple[str, str], float]:
    """Return the epipolar error, 95th percentile, of pictures that did not take part, by cross-validation."""
    adjusted = solution.adjusted
    shared = [place for place in adjusted.places if sum(each == place for each in solution.place_of.values()) > 1]
    if len(shared) < 2 * _FOLDS:
        return {}
    widths = {name: size[0] for name, size in views.sizes.items()}
    lenses = {name: adjusted.lens(name) for name in adjusted.cameras}
    poses = {name: adjusted.T_camera_rig(name) for name in adjusted.cameras}
    boards = {place: adjusted.T_rig_board(place) for place in adjusted.places}
    errors: dict[tuple[str, str], list[FloatArray]] = {}
    for fold in range(_FOLDS):
        held = set(shared[fold::_FOLDS])
        kept = {key: view for key, view in solution.views.items() if solution.place_of[key] not in held}
        without = adjust_views(
            views.board,
            kept,
            solution.place_of,
            lenses,
            poses,
            boards,
            widths,
            corners=adjusted.bundle.geometry.corners,
            release=adjusted.released,
            sigma_px=adjusted.bundle.sigma_px,
        )
        models = models_of(without, views)
        for place in held:
            seen = {key[0]: solution.views[key] for key, at in solution.place_of.items() if at == place}
            for first, second in ((a, b) for a in seen for b in seen if list(models).index(a) < list(models).index(b)):
                _, one, two = np.intersect1d(seen[first].ids, seen[second].ids, return_indices=True)
                distance = epipolar_distance(
                    models[first], models[second], seen[first].corners[one], seen[second].corners[two]
                )
                errors.setdefault((first, second), []).append(np.abs(distance))
    return {pair: float(np.percentile(np.concatenate(each), 95)) for pair, each in errors.items()}
