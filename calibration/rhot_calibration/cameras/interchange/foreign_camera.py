"""One camera as another program's file describes it, checked value by value."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rhot.arrays import FloatArray
from rhot.atomic_file import why_unread
from rhot.errors import CalibrationError
from rhot.geometry.rotations import inverse, rigid, rotation_from_vector
from rhot.text import parse_toml, read_text

# Anipose's `calibration.toml` and Caliscope's `camera_array.toml`.


def read_toml(file: Path) -> tuple[ForeignCamera, ...]:
    """Return the cameras of a TOML file: tables `[cam_0]` (or under `[cameras]`) with their poses.

    `rotation` (Rodrigues vector, or 3x3) and `translation` map world to camera: X_camera = R · X_world + t. A camera
    without them has no pose. The unit of length is whatever the board was measured in.

    Raises:
        CalibrationError: malformed, incomplete, a fisheye model or a turned picture; names table and field.
    """
    try:
        content = parse_toml(foreign_text(file))
    except ValueError as error:
        raise CalibrationError(f"{file}: not TOML: {error}") from error
    nested = content.get("cameras")
    tables = nested if isinstance(nested, dict) else content
    cameras = [
        _camera(f"{file}: [{name}]", name, table)
        for name, table in tables.items()
        if isinstance(table, dict) and "matrix" in table and not table.get("ignore", False)
    ]
    if not cameras:
        raise CalibrationError(f"{file}: no calibrated camera in it; expected tables such as [cam_0] with matrix")
    return tuple(cameras)


def _camera(place: str, table_name: str, table: dict[str, Any]) -> ForeignCamera:
    if table.get("fisheye", False):
        refuse_fisheye(f"{place}.fisheye")
    if table.get("rotation_count", 0):
        raise CalibrationError(
            f"{place}.rotation_count is {table['rotation_count']}: the pictures were turned before the calibration, "
            "RHOT tracks in raw ones; calibrate the camera again: rhot calibrate cameras RECORDING"
        )
    for name in ("size", "distortions"):
        if name not in table:
            raise CalibrationError(f"{place}: no {name}; save the calibration again")
    size = matrix(table["size"], (2,), f"{place}.size").tolist()
    T_world_camera = None
    if table.get("rotation") is not None and table.get("translation") is not None:
        t = matrix(table["translation"], (3,), f"{place}.translation")
        T_world_camera = inverse(rigid(_rotation(table["rotation"], f"{place}.rotation"), t))
    return ForeignCamera(
        place,
        str(table.get("name", table.get("port", table_name))),
        picture_size(size[0], size[1], f"{place}.size"),
        intrinsics(table["matrix"], f"{place}.matrix"),
        coefficients(table["distortions"], f"{place}.distortions"),
        T_world_camera,
    )


def _rotation(value: Any, place: str) -> FloatArray:
    if isinstance(value, list) and len(value) == 3 and not isinstance(value[0], list):
        return rotation_from_vector(matrix(value, (3,), place))
    return rotation(value, place)


DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True)
class ForeignCamera:
    """A camera of another program's calibration.

    Attributes:
        place: file and entry, for messages.
        name: as the file calls it; empty = it does not.
        size: (width, height), pixels; None = the file does not state it.
        K: (3, 3) intrinsics, pixels.
        distortion: (n,) OpenCV's coefficients.
        T_world_camera: (4, 4), maps camera coordinates to the file's own world, in the file's unit of length; None =
            the file does not state it.
    """

    place: str
    name: str
    size: tuple[int, int] | None
    K: FloatArray
    distortion: FloatArray
    T_world_camera: FloatArray | None = None


def matrix(value: Any, shape: tuple[int, ...], place: str) -> FloatArray:
    """Return a matrix or vector of finite numbers, given flat or nested.

    Raises:
        CalibrationError: something else; names the place.
    """
    size = int(np.prod(shape))
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{place}: not a list of {size} numbers; save the file again") from error
    if array.size != size or not np.isfinite(array).all():
        raise CalibrationError(f"{place}: needs {size} finite numbers, has {array.size} values; save the file again")
    return array.reshape(shape)


def intrinsics(value: Any, place: str) -> FloatArray:
    """Return K (3, 3).

    Raises:
        CalibrationError: not the intrinsics of a pinhole camera.
    """
    K = matrix(value, (3, 3), place)
    if K[0, 0] <= 0.0 or K[1, 1] <= 0.0 or K[1, 0] != 0.0 or not np.array_equal(K[2], (0.0, 0.0, 1.0)):
        raise CalibrationError(
            f"{place}: {K.round(3).tolist()} is not a camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with "
            "positive focal lengths"
        )
    if K[0, 1] != 0.0:
        raise CalibrationError(
            f"{place}: the camera matrix has a skew of {K[0, 1]:g} px, which RHOT's cameras do not have; calibrate "
            "without skew"
        )
    return K


def coefficients(value: Any, place: str) -> FloatArray:
    """Return OpenCV's distortion coefficients (n,).

    Raises:
        CalibrationError: a number of them that OpenCV does not know.
    """
    try:
        count = int(np.size(np.array(value, dtype=np.float64)))
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{place}: not a list of numbers; save the file again") from error
    if count not in DISTORTION_LENGTHS:
        raise CalibrationError(
            f"{place}: {count} distortion coefficients; OpenCV's models have {', '.join(map(str, DISTORTION_LENGTHS))}"
        )
    return matrix(value, (count,), place)


def rotation(value: Any, place: str) -> FloatArray:
    """Return a rotation (3, 3).

    Raises:
        CalibrationError: not one.
    """
    R = matrix(value, (3, 3), place)
    if not np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE) or np.linalg.det(R) < 0.0:
        raise CalibrationError(f"{place}: not a rotation (determinant {np.linalg.det(R):.4f}, must be 1)")
    U, _, Vt = np.linalg.svd(R)
    nearest: FloatArray = U @ Vt
    return nearest


def picture_size(width: Any, height: Any, place: str) -> tuple[int, int]:
    """Return (width, height), pixels.

    Raises:
        CalibrationError: not two whole positive numbers.
    """
    numbers = (width, height)
    if any(isinstance(n, bool) or not isinstance(n, int | float) or n != int(n) or n <= 0 for n in numbers):
        raise CalibrationError(f"{place}: picture size {width} x {height} is not two whole positive numbers of pixels")
    return int(width), int(height)


def refuse_fisheye(place: str) -> None:
    """Refuse a lens model that RHOT does not have.

    Raises:
        CalibrationError: always.
    """
    raise CalibrationError(
        f"{place}: a fisheye lens model; RHOT's cameras have OpenCV's pinhole model with up to 14 distortion "
        "coefficients. Calibrate the camera again: rhot calibrate cameras RECORDING"
    )


def foreign_text(file: Path) -> str:
    """Return the text of a file.

    Raises:
        CalibrationError: it cannot be read or is empty.
    """
    try:
        text = read_text(file)
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{file}: cannot be read: {why_unread(error)}") from error
    if not text.strip():
        raise CalibrationError(f"{file}: is empty; save the calibration again")
    return text
