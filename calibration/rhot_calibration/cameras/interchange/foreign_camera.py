"""One camera as another program's file describes it, checked value by value."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rhot import text_files
from rhot.arrays import FloatArray
from rhot.atomic_file import why_unread
from rhot.errors import CalibrationError

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


def read_text(file: Path) -> str:
    """Return the text of a file.

    Raises:
        CalibrationError: it cannot be read or is empty.
    """
    try:
        text = text_files.read_text(file)
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{file}: cannot be read: {why_unread(error)}") from error
    if not text.strip():
        raise CalibrationError(f"{file}: is empty; save the calibration again")
    return text
