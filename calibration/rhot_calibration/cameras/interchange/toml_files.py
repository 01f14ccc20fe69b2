"""Anipose's `calibration.toml` and Caliscope's `camera_array.toml`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import rotation_from_vector
from rhot.geometry.transforms import inverse, rigid
from rhot.text_files import parse_toml
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


def read_toml(file: Path) -> tuple[ForeignCamera, ...]:
    """Return the cameras of a TOML file: tables `[cam_0]` (or under `[cameras]`) with their poses.

    `rotation` (Rodrigues vector, or 3x3) and `translation` map world to camera: X_camera = R · X_world + t. A camera
    without them has no pose. The unit of length is whatever the board was measured in.

    Raises:
        CalibrationError: malformed, incomplete, a fisheye model or a turned picture; names table and field.
    """
    try:
        content = parse_toml(read_text(file))
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
