"""Calibrations of other programs to `cameras.json`, and back to OpenCV's files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import yaml

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import cross_matrix, inverse, rigid
from rhot.rig import CameraCalibration, CamerasFile
from rhot.rig.calibration import today
from rhot.rig.folder import write_text_atomic
from rhot_calibration.cameras.interchange.foreign_camera import (
    ForeignCamera,
    coefficients,
    foreign_text,
    intrinsics,
    matrix,
    picture_size,
    read_toml,
    refuse_fisheye,
    rotation,
)

# ROS `camera_info` YAML files, one per camera.

_MODELS: Final = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "thin_prism": (12,)}
_ROS_YAML_FISHEYE: Final = ("equidistant", "fisheye", "kannala_brandt")


def read_ros(files: Sequence[Path]) -> tuple[ForeignCamera, ...]:
    """Return the cameras of ROS files.

    A rectified pair states its geometry in R and P (REP 104; `sensor_msgs/CameraInfo`): with X_r = R_i · X_i turned
    into the common rectified frame, P[0, 3] = −fx' · B and the camera stands at (−P[0, 3]/fx', −P[1, 3]/fy', 0) there,
    metres. Without any such shift the poses are unknown.

    Raises:
        CalibrationError: malformed, incomplete or another lens model; names file and field.
    """
    read = [_camera(file) for file in files]
    posed = sum(bool(np.any(shift)) for _, _, shift in read) >= len(read) - 1 and len(read) > 1
    if not posed:
        return tuple(camera for camera, _, _ in read)
    return tuple(
        ForeignCamera(
            camera.place, camera.name, camera.size, camera.K, camera.distortion, rigid(R_rectified_camera, center)
        )
        for camera, R_rectified_camera, center in read
    )


def _camera(file: Path) -> tuple[ForeignCamera, FloatArray, FloatArray]:
    """Return a camera, its rotation into the rectified frame and its place there (zeros where not stated)."""
    try:
        content = yaml.safe_load(foreign_text(file))
    except (yaml.YAMLError, RecursionError) as error:
        raise CalibrationError(f"{file}: not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{file}: not a ROS camera_info file; expected camera_matrix and distortion_model")
    model = str(content.get("distortion_model", "plumb_bob"))
    if model in _ROS_YAML_FISHEYE:
        refuse_fisheye(f"{file}: distortion_model {model}")
    if model not in _MODELS:
        raise CalibrationError(f"{file}: distortion_model {model} is unknown; one of {', '.join(_MODELS)}")
    K = intrinsics(_data(content, "camera_matrix", file), f"{file}: camera_matrix")
    D = coefficients(_data(content, "distortion_coefficients", file), f"{file}: distortion_coefficients")
    if len(D) not in (0, *_MODELS[model]):
        raise CalibrationError(
            f"{file}: distortion_model {model} has {' or '.join(map(str, _MODELS[model]))} coefficients, not {len(D)}"
        )
    size = picture_size(content.get("image_width"), content.get("image_height"), f"{file}: image_width, image_height")
    R, center = np.eye(3), np.zeros(3)
    if "rectification_matrix" in content and "projection_matrix" in content:
        R = rotation(_data(content, "rectification_matrix", file), f"{file}: rectification_matrix")
        P = matrix(_data(content, "projection_matrix", file), (3, 4), f"{file}: projection_matrix")
        if P[0, 0] > 0.0 and P[1, 1] > 0.0:
            center = np.array([-P[0, 3] / P[0, 0], -P[1, 3] / P[1, 1], 0.0])
    name = str(content.get("camera_name", ""))
    return ForeignCamera(str(file), name, size, K, D), R, center


def _data(content: dict[str, Any], field: str, file: Path) -> Any:
    entry = content.get(field)
    if entry is None:
        raise CalibrationError(f"{file}: no {field}; expected a ROS camera_info file as camera_calibration saves it")
    return entry.get("data") if isinstance(entry, dict) else entry


# OpenCV FileStorage files: the usual pair `intrinsics.yml` and `extrinsics.yml`, and one camera per file.

INTRINSICS_FILE: Final = "intrinsics.yml"
EXTRINSICS_FILE: Final = "extrinsics.yml"

_PAIR_K: Final = ("M{}", "K{}", "cameraMatrix{}", "camera_matrix_{}")
_PAIR_D: Final = ("D{}", "distCoeffs{}", "distortion_coefficients_{}")
_ONE_K: Final = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M")
_ONE_D: Final = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D")
_WIDTH: Final = ("image_width", "image_Width", "width")
_HEIGHT: Final = ("image_height", "image_Height", "height")
_FISHEYE: Final = ("fisheye_model", "fisheye", "xi")

Value = FloatArray | float | str


def read_opencv(files: Sequence[Path]) -> tuple[ForeignCamera, ...]:
    """Return the cameras of OpenCV files.

    Either the two cameras of a stereo pair, whose matrices M1, D1, M2, D2, R and T may lie in one file or in two
    (X_2 = R · X_1 + T; the world is camera 1's frame), or one camera per file.

    Raises:
        CalibrationError: malformed, incomplete or a fisheye model; names file and entry.
    """
    contents = {file: _entries(file) for file in files}
    for file, entries in contents.items():
        for name in _FISHEYE:
            if name in entries and entries[name] != 0.0:
                refuse_fisheye(f"{file}: {name}")
    if any(_find(entries, _numbered(_PAIR_K, 1)) for entries in contents.values()):
        return _pair(contents)
    return tuple(_single(file, entries) for file, entries in contents.items())


def write_opencv(cameras: Mapping[str, CameraCalibration], folder: Path) -> tuple[Path, ...]:
    """Write the cameras as OpenCV YAML into a folder and return the files.

    Two cameras: `intrinsics.yml` (M1, D1, M2, D2) and `extrinsics.yml` (R, T, E, F; X_2 = R · X_1 + T, metres), as
    OpenCV's stereo samples write them. More: one `<camera>.yml` each, with `R` and `T` of X_camera = R · X_rig + T.

    Raises:
        ConfigError: the folder cannot be written.
    """
    if len(cameras) == 2:
        first, second = cameras.values()
        T_21 = inverse(np.array(second.T_rig_camera)) @ np.array(first.T_rig_camera)
        K1, K2 = np.array(first.K), np.array(second.K)
        R, t = T_21[:3, :3], T_21[:3, 3]
        E = cross_matrix(t) @ R
        F = np.linalg.inv(K2).T @ E @ np.linalg.inv(K1)
        F = F / F[2, 2] if abs(F[2, 2]) > 1e-12 else F
        inner = {"M1": K1, "D1": _row(first), "M2": K2, "D2": _row(second)}
        texts = {
            INTRINSICS_FILE: _text({"image_width": first.width, "image_height": first.height}, inner),
            EXTRINSICS_FILE: _text({}, {"R": R, "T": t.reshape(3, 1), "E": E, "F": F}),
        }
    else:
        texts = {}
        for name, camera in cameras.items():
            T_camera_rig = inverse(np.array(camera.T_rig_camera))
            matrices = {
                "camera_matrix": np.array(camera.K),
                "distortion_coefficients": _row(camera),
                "R": T_camera_rig[:3, :3],
                "T": T_camera_rig[:3, 3:],
            }
            texts[f"{name}.yml"] = _text({"image_width": camera.width, "image_height": camera.height}, matrices)
    for name, text in texts.items():
        write_text_atomic(folder / name, text)
    return tuple(folder / name for name in texts)


def _row(camera: CameraCalibration) -> FloatArray:
    return np.array(camera.distortion or (0.0,) * 5, dtype=np.float64).reshape(1, -1)


def _text(numbers: Mapping[str, int], matrices: Mapping[str, FloatArray]) -> str:
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, number in numbers.items():
        storage.write(name, number)
    for name, values in matrices.items():
        storage.write(name, np.ascontiguousarray(values, dtype=np.float64))
    return str(storage.releaseAndGetString())


def _entries(file: Path) -> dict[str, Value]:
    """Return the numbers, strings and matrices at the top of a file."""
    text = foreign_text(file)
    entries: dict[str, Value] = {}
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        if not storage.isOpened():
            raise CalibrationError(f"{file}: not an OpenCV FileStorage file; save it again")
        for name in list(storage.root().keys()):
            node = storage.getNode(name)
            if node.isInt() or node.isReal():
                entries[name] = float(node.real())
            elif node.isString():
                entries[name] = node.string()
            elif node.isMap():
                values = node.mat()
                if values is not None:
                    entries[name] = np.asarray(values, dtype=np.float64)
        storage.release()
    except (cv2.error, SystemError, UnicodeDecodeError) as error:
        raise CalibrationError(
            f"{file}: damaged OpenCV file, or a matrix in it is incomplete; save it again"
        ) from error
    return entries


def _numbered(names: Sequence[str], number: int) -> tuple[str, ...]:
    return tuple(name.format(number) for name in names)


def _find(entries: Mapping[str, Value], names: Sequence[str]) -> str | None:
    return next((name for name in names if name in entries), None)


def _pair(contents: Mapping[Path, dict[str, Value]]) -> tuple[ForeignCamera, ...]:
    merged: dict[str, tuple[Path, Value]] = {}
    for file, entries in contents.items():
        for name, value in entries.items():
            if name in merged and name in ("R", "T"):
                raise CalibrationError(f"{file}: {name} is also in {merged[name][0]}; give the files of one pair only")
            merged[name] = (file, value)
    values = {name: value for name, (_, value) in merged.items()}
    listed = ", ".join(str(file) for file in contents)
    missing = [name for name in ("R", "T") if name not in values]
    if missing:
        raise CalibrationError(
            f"{listed}: no {missing[0]}, the pose of camera 2; give the extrinsics file too (usually {EXTRINSICS_FILE})"
        )
    T_21 = rigid(rotation(values["R"], f"{merged['R'][0]}: R"), matrix(values["T"], (3,), f"{merged['T'][0]}: T"))
    cameras = []
    for number, T_world_camera in ((1, np.eye(4)), (2, inverse(T_21))):
        k_name, d_name = (_find(values, _numbered(names, number)) for names in (_PAIR_K, _PAIR_D))
        if k_name is None or d_name is None:
            raise CalibrationError(f"{listed}: camera {number} lacks {'M' if k_name is None else 'D'}{number}")
        file = merged[k_name][0]
        K = intrinsics(values[k_name], f"{file}: {k_name}")
        D = coefficients(values[d_name], f"{merged[d_name][0]}: {d_name}")
        cameras.append(ForeignCamera(f"{file}: {k_name}", "", _size(file, values), K, D, T_world_camera))
    return tuple(cameras)


def _single(file: Path, entries: Mapping[str, Value]) -> ForeignCamera:
    k_name, d_name = _find(entries, _ONE_K), _find(entries, _ONE_D)
    if k_name is None or d_name is None:
        raise CalibrationError(
            f"{file}: no camera in it; expected camera_matrix and distortion_coefficients (one camera) or M1, D1, M2, "
            f"D2, R, T (a pair), found {', '.join(entries) or 'nothing'}"
        )
    K = intrinsics(entries[k_name], f"{file}: {k_name}")
    D = coefficients(entries[d_name], f"{file}: {d_name}")
    T_world_camera = None
    if "R" in entries and "T" in entries:
        R, t = rotation(entries["R"], f"{file}: R"), matrix(entries["T"], (3,), f"{file}: T")
        T_world_camera = inverse(rigid(R, t))
    return ForeignCamera(str(file), file.stem, _size(file, entries), K, D, T_world_camera)


def _size(file: Path, entries: Mapping[str, Value]) -> tuple[int, int] | None:
    width, height = _find(entries, _WIDTH), _find(entries, _HEIGHT)
    if width is None or height is None:
        return None
    return picture_size(entries[width], entries[height], f"{file}: {width}, {height}")


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
    start = foreign_text(file).lstrip()[:4096]
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
