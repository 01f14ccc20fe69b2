"""Calibrations of other programs to `cameras.json`, and back to OpenCV's files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.transforms import inverse
from rhot.rig import CameraCalibration, CamerasFile
from rhot.rig.calibration import today
from rhot_calibration.cameras.interchange.foreign_camera import ForeignCamera, read_text
from rhot_calibration.cameras.interchange.opencv_yaml import read_opencv, write_opencv
from rhot_calibration.cameras.interchange.ros_yaml import read_ros
from rhot_calibration.cameras.interchange.toml_files import read_toml

MAX_BASELINE_M = 20.0
MIN_BASELINE_M = 0.005


def import_cameras(
    files: Sequence[Path],
    nominal: Mapping[str, CameraCalibration],
    *,
    unit_m: float | None = None,
    names: Sequence[str] | None = None,
) -> CamerasFile:
    """Return the calibration in files of another program.

    Args:
        files: OpenCV FileStorage (a pair, or one per camera), ROS camera_info (one per camera), or one TOML file of
            Anipose or Caliscope.
        nominal: the rig's cameras in the order of `rig.toml`, the first is the reference. They say what a file leaves
            out: the picture size, and the poses when no file states them (`quality` then says so).
        unit_m: length of the file's unit, metres (the square's side where translations are in squares); None = the
            format fixes it (ROS: metres).
        names: rig names of the file's cameras in the order of the file; None = by the file's own names where these are
            the rig's, else in the order of `rig.toml`.

    Raises:
        CalibrationError: unreadable, incomplete, other cameras than the rig's, or impossible; names file and field.
    """
    kind, cameras = _read(files)
    assigned = _assign(cameras, tuple(nominal), names)
    missing = [name for name, camera in assigned.items() if camera.T_world_camera is None]
    if missing and len(missing) < len(assigned):
        raise CalibrationError(
            f"{assigned[missing[0]].place}: camera {missing[0]} has no pose, others have; import a complete calibration"
        )
    posed = not missing and len(assigned) > 1
    scale = _scale(kind, unit_m, cameras[0].place) if posed else 1.0
    reference = assigned[next(iter(nominal))].T_world_camera
    calibrated = {}
    for name in nominal:
        camera = assigned[name]
        T_rig_camera = np.array(nominal[name].T_rig_camera)
        if posed and reference is not None and camera.T_world_camera is not None:
            T_rig_camera = inverse(reference) @ camera.T_world_camera
            T_rig_camera[:3, 3] *= scale
        calibrated[name] = _calibration(name, camera, nominal[name], T_rig_camera)
    if posed:
        _require_believable(calibrated, [camera.place for camera in cameras])
    quality = {
        "imported": {
            "format": kind,
            "files": [file.name for file in files],
            "poses": "from the files" if posed else "nominal, from rig.toml: the files state none",
        }
    }
    return CamerasFile(date=today(), cameras=calibrated, quality=quality)


def export_opencv_yaml(cameras: CamerasFile, folder: Path) -> tuple[Path, ...]:
    """Write a calibration as OpenCV YAML into a folder and return the files; see `write_opencv`.

    Raises:
        ConfigError: the folder cannot be made or written.
        CalibrationError: `folder` is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise CalibrationError(f"{folder}: is a file; give a folder for OpenCV's intrinsics.yml and extrinsics.yml")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot be made: {error.strerror or error}") from error
    return write_opencv(cameras.cameras, folder)


def _read(files: Sequence[Path]) -> tuple[str, tuple[ForeignCamera, ...]]:
    if not files:
        raise CalibrationError("no file to import; give the calibration files of the other program")
    kinds = {file: _kind(file) for file in files}
    kind = kinds[files[0]]
    for file, other in kinds.items():
        if other != kind:
            raise CalibrationError(f"{file} is {other}, {files[0]} is {kind}; import one kind at a time")
    if kind == "TOML":
        if len(files) > 1:
            raise CalibrationError(f"{files[1]}: a TOML calibration holds all cameras; give one file")
        return kind, read_toml(files[0])
    return kind, read_opencv(files) if kind == "OpenCV" else read_ros(files)


def _kind(file: Path) -> str:
    if file.suffix.lower() == ".toml":
        return "TOML"
    start = read_text(file).lstrip()[:4096]
    return "OpenCV" if start.startswith(("%YAML", "<?xml", "{")) or "!!opencv-matrix" in start else "ROS"


def _assign(
    cameras: Sequence[ForeignCamera], rig: Sequence[str], names: Sequence[str] | None
) -> dict[str, ForeignCamera]:
    """Return the file's cameras by their names in the rig."""
    if len(cameras) != len(rig):
        raise CalibrationError(
            f"{cameras[0].place}: the files hold {len(cameras)} cameras, the rig has {len(rig)} ({', '.join(rig)}); "
            "change rig.toml or import the matching files"
        )
    if names is None:
        own = [camera.name for camera in cameras]
        names = own if sorted(own) == sorted(rig) else tuple(rig)
    if sorted(names) != sorted(rig):
        raise CalibrationError(
            f"cameras {', '.join(names)} are not those of the rig; name each of {', '.join(rig)} once, in the order of "
            "the file"
        )
    return dict(zip(names, cameras, strict=True))


def _scale(kind: str, unit_m: float | None, place: str) -> float:
    if kind == "ROS":
        return 1.0
    if unit_m is None:
        raise CalibrationError(
            f"{place}: the file does not say in what unit its translations are; state it (millimetres, metres or the "
            "side of the board's squares)"
        )
    if not (np.isfinite(unit_m) and unit_m > 0.0):
        raise CalibrationError(f"unit of {unit_m} m: must be a positive length")
    return unit_m


def _calibration(
    name: str, camera: ForeignCamera, nominal: CameraCalibration, T_rig_camera: FloatArray
) -> CameraCalibration:
    width, height = camera.size or (nominal.width, nominal.height)
    if (width, height) != (nominal.width, nominal.height):
        raise CalibrationError(
            f"{camera.place}: calibrated with pictures of {width}x{height} pixels, rig.toml says "
            f"{nominal.width}x{nominal.height} for camera {name}; make them the same"
        )
    cx, cy = camera.K[0, 2], camera.K[1, 2]
    if not (0.0 < cx < width and 0.0 < cy < height):
        raise CalibrationError(
            f"{camera.place}: principal point ({cx:.1f}, {cy:.1f}) lies outside the picture of {width}x{height}; "
            f"another picture size? Correct width and height of camera {name} in rig.toml"
        )
    return CameraCalibration.model_validate(
        {
            "width": width,
            "height": height,
            "K": camera.K.tolist(),
            "distortion": camera.distortion.tolist(),
            "T_rig_camera": T_rig_camera.tolist(),
        }
    )


def _require_believable(cameras: Mapping[str, CameraCalibration], places: Sequence[str]) -> None:
    centers = {name: np.array(camera.T_rig_camera)[:3, 3] for name, camera in cameras.items()}
    listed = list(centers)
    for index, first in enumerate(listed):
        for second in listed[index + 1 :]:
            baseline = float(np.linalg.norm(centers[first] - centers[second]))
            if not MIN_BASELINE_M <= baseline <= MAX_BASELINE_M:
                raise CalibrationError(
                    f"{places[0]}: {first} and {second} would stand {1e3 * baseline:.4g} mm apart; between "
                    f"{1e3 * MIN_BASELINE_M:g} mm and {MAX_BASELINE_M:g} m are possible. Check the unit of length"
                )
    if {"left", "right"} <= cameras.keys():
        T_left_right = inverse(np.array(cameras["left"].T_rig_camera)) @ np.array(cameras["right"].T_rig_camera)
        x = float(T_left_right[0, 3])
        if x < 0.0 and abs(x) > 0.5 * float(np.linalg.norm(T_left_right[:3, 3])):
            raise CalibrationError(
                f"{places[0]}: camera right would stand {-1e3 * x:.1f} mm to the left of camera left; the file counts "
                "them the other way round: name them in its order, right before left"
            )
