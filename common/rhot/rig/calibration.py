"""What calibration writes into a rig folder: JSON with version, date and its own quality figures."""

from __future__ import annotations

import datetime as dt
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from rhot.geometry.rotations import quaternion_from_rotation, rigid, rotation_from_quaternion
from rhot.messages import Name, Quaternion
from rhot.messages.base import wire_position, wire_quaternion
from rhot.rig.file_model import FileModel, Vector3

Row3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
Matrix3 = tuple[Row3, Row3, Row3]
Matrix4 = tuple[Row4, Row4, Row4, Row4]

_ROTATION_TOLERANCE = 1e-4
WIDTH_OVER_LENGTH = (0.33, 0.60)
"""Believable width of a hand across the knuckles over its length; an estimate with room on both sides."""

LOWEST_DESK_M, HIGHEST_DESK_M = 0.3, 1.5
"""A desk's top over the floor: from a couch table to a standing desk, with room on both sides."""
DeskHeight = Annotated[float, Field(ge=LOWEST_DESK_M, le=HIGHEST_DESK_M)]


def matrix3(M: NDArray[np.float64]) -> Matrix3:
    """Return an array (3, 3) as the files hold it."""
    a, b, c = ((float(row[0]), float(row[1]), float(row[2])) for row in M)
    return a, b, c


def matrix4(M: NDArray[np.float64]) -> Matrix4:
    """Return an array (4, 4) as the files hold it."""
    a, b, c, d = ((float(row[0]), float(row[1]), float(row[2]), float(row[3])) for row in M)
    return a, b, c, d


def today() -> str:
    """Return the date that a calibration file carries, ISO 8601."""
    return dt.datetime.now(dt.UTC).date().isoformat()


class CalibrationFile(FileModel):
    """What every calibration file carries.

    Attributes:
        version: of the file's layout.
        date: day of the calibration, ISO 8601.
        quality: figures of the calibration itself, for people and for `rhot doctor`.
    """

    version: Literal[1] = 1
    date: str = ""
    quality: Any = {}


class Intrinsics(FileModel):
    """The lens of one camera.

    Attributes:
        width, height: pixels of the pictures that it was calibrated with.
        K: 3x3 intrinsics, pixels.
        distortion: k1, k2, p1, p2, k3, … in OpenCV's order; 0, 4, 5, 8, 12 or 14 numbers.
    """

    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]
    K: Matrix3
    distortion: tuple[float, ...] = ()

    @field_validator("K")
    @classmethod
    def _is_intrinsics(cls, K: Matrix3) -> Matrix3:
        if K[0][0] <= 0 or K[1][1] <= 0 or K[2] != (0.0, 0.0, 1.0) or K[1][0] != 0.0:
            raise ValueError("K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths")
        if K[0][1] != 0.0:
            raise ValueError(f"K has a skew of {K[0][1]:g} px, which cameras here do not have; calibrate without skew")
        return K

    @field_validator("distortion")
    @classmethod
    def _has_opencv_length(cls, distortion: tuple[float, ...]) -> tuple[float, ...]:
        if len(distortion) not in (0, 4, 5, 8, 12, 14):
            raise ValueError(f"OpenCV's models have 0, 4, 5, 8, 12 or 14 coefficients, not {len(distortion)}")
        return distortion


class CameraCalibration(Intrinsics):
    """One calibrated camera.

    Attributes:
        T_rig_camera: 4x4, maps camera coordinates to rig coordinates, metres.
    """

    T_rig_camera: Matrix4

    @field_validator("T_rig_camera")
    @classmethod
    def _is_rigid(cls, T: Matrix4) -> Matrix4:
        matrix = np.array(T)
        R = matrix[:3, :3]
        if not np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE) or np.linalg.det(R) < 0:
            raise ValueError("the upper left 3x3 of T_rig_camera is not a rotation")
        if not np.allclose(matrix[3], (0, 0, 0, 1)):
            raise ValueError("the last row of T_rig_camera must be 0, 0, 0, 1")
        return T


class CamerasFile(CalibrationFile):
    """`cameras.json`."""

    cameras: Annotated[dict[Name, CameraCalibration], Field(min_length=1)]


class HandFile(CalibrationFile):
    """`hand.json`: one person's hand.

    Attributes:
        length_m: from the wrist crease to the tip of the middle finger.
        width_m: across the knuckles of the four fingers, flesh included; where absent it follows from `length_m`.
        bones_m: OpenXR joint name to the length of the bone from its parent to it, metres; what is absent follows
            from `length_m`.
        radii_m: OpenXR joint name to the radius of the flesh around it, metres.
        marker_offsets_m: marker name to the offset from the joint to the marker's painted centre, metres, in the
            joint's frame.
    """

    length_m: Annotated[float, Field(ge=0.10, le=0.26)] = 0.189
    width_m: Annotated[float, Field(ge=0.03, le=0.16)] | None = None
    bones_m: dict[Name, Annotated[float, Field(gt=0.002, lt=0.2)]] = {}
    radii_m: dict[Name, Annotated[float, Field(gt=0.001, lt=0.05)]] = {}
    marker_offsets_m: dict[Name, Vector3] = {}

    @model_validator(mode="after")
    def _hand_shaped(self) -> HandFile:
        low, high = WIDTH_OVER_LENGTH
        if self.width_m is not None and not low <= self.width_m / self.length_m <= high:
            raise ValueError(
                f"width_m {self.width_m:g} is {self.width_m / self.length_m:.2f} of length_m {self.length_m:g}; "
                f"human hands are {low:g} to {high:g} as wide as long"
            )
        return self


class RigidTransform(FileModel):
    """A pose.

    Attributes:
        position: translation, metres.
        orientation: rotation, unit quaternion x, y, z, w.
    """

    position: Vector3
    orientation: Quaternion

    @model_validator(mode="after")
    def _unit(self) -> RigidTransform:
        norm = float(np.linalg.norm(self.orientation))
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"orientation (x, y, z, w) has norm {norm:.6g}, must be 1")
        return self

    @classmethod
    def identity(cls) -> RigidTransform:
        """Return the transform that changes nothing."""
        return cls(position=(0.0, 0.0, 0.0), orientation=(0.0, 0.0, 0.0, 1.0))

    @classmethod
    def from_matrix(cls, T: NDArray[np.float64]) -> RigidTransform:
        """Return the transform of a matrix (4, 4), metres."""
        return cls(position=wire_position(T[:3, 3]), orientation=wire_quaternion(quaternion_from_rotation(T[:3, :3])))

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(4, 4), metres."""
        return rigid(rotation_from_quaternion(np.array(self.orientation)), np.array(self.position))


class StageFile(CalibrationFile):
    """`stage.json`: the frame with a floor, which other programs want.

    Attributes:
        T_rig_stage: maps stage coordinates (right-handed, metres, y up, −z forward, origin on the floor) to the rig's.
        source: what it was found by, such as `desk board`.
        residual_m: how well that agrees with itself, metres; absent where nothing could tell.
        desk_height_m: of the desk's top over the floor; absent where no desk was involved.
    """

    T_rig_stage: RigidTransform
    source: Annotated[str, Field(max_length=64)]
    residual_m: Annotated[float, Field(ge=0.0, le=1e3)] | None = None
    desk_height_m: DeskHeight | None = None


class HeadsetFile(CalibrationFile):
    """`headset.json`: where the feet's depth camera sits on the headset; it holds in place of `[feet.camera]`'s pose.

    Attributes:
        T_head_camera: maps OpenCV's camera coordinates to the head's (x right, y up, −z forward).
    """

    T_head_camera: RigidTransform


class RegistrationFile(CalibrationFile):
    """`registration.json`: tracker space to rig.

    Attributes:
        T_rig_tracker: maps coordinates of the tracking system (SteamVR) to rig coordinates.
        T_tracker_object: per object, from the tracked device to the object's own frame.
    """

    T_rig_tracker: RigidTransform
    T_tracker_object: dict[Name, RigidTransform] = {}
