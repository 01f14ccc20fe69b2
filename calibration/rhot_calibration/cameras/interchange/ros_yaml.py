"""ROS `camera_info` YAML files, one per camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.transforms import rigid
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

_MODELS: Final = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "thin_prism": (12,)}
_FISHEYE: Final = ("equidistant", "fisheye", "kannala_brandt")


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
        content = yaml.safe_load(read_text(file))
    except (yaml.YAMLError, RecursionError) as error:
        raise CalibrationError(f"{file}: not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{file}: not a ROS camera_info file; expected camera_matrix and distortion_model")
    model = str(content.get("distortion_model", "plumb_bob"))
    if model in _FISHEYE:
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
