"""OpenCV FileStorage files: the usual pair `intrinsics.yml` and `extrinsics.yml`, and one camera per file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import cross_matrix
from rhot.geometry.transforms import inverse, rigid
from rhot.rig import CameraCalibration
from rhot.rig.folder import write_text_atomic
from rhot_calibration.cameras.interchange.foreign_camera import (
    ForeignCamera,
    coefficients,
    intrinsics,
    matrix,
    picture_size,
    read_text,
    refuse_fisheye,
    rotation,
)

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
    text = read_text(file)
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
