"""The lens of a RealSense stream as OpenCV writes it."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from rhot.errors import DeviceError
from rhot.geometry.camera import CameraModel
from rhot_feet.frames import pinhole

_BROWN_CONRADY: Final = ("brown_conrady", "modified_brown_conrady", "inverse_brown_conrady")
"""The SDK bends points by the same equation and order of coefficients as OpenCV for all of these, whatever their names
say (`rs2_project_point_to_pixel`; measured with 2.59, also for the inverse kind that D400 colour cameras report)."""


def camera_of(intrinsics: Any) -> CameraModel:
    """Return the camera of an SDK `intrinsics` (width, height, fx, fy, ppx, ppy, model, coeffs).

    Raises:
        DeviceError: a kind of lens that OpenCV's model cannot express.
    """
    K = np.array([[intrinsics.fx, 0.0, intrinsics.ppx], [0.0, intrinsics.fy, intrinsics.ppy], [0.0, 0.0, 1.0]])
    coefficients = np.array(intrinsics.coeffs, dtype=np.float64)
    # The enum's name, so that no SDK is needed here.
    model = str(intrinsics.model).rpartition(".")[2]
    if model == "none" or not coefficients.any():
        coefficients = np.empty(0)
    elif model not in _BROWN_CONRADY:
        raise DeviceError(
            f"RealSense: a colour lens of the kind {model} is not supported; use a camera of the D400 series"
        )
    return pinhole(int(intrinsics.width), int(intrinsics.height), K, coefficients)
