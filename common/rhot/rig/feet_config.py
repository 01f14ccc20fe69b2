"""What people write in `rig.toml` about feet and legs."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rigid, rotation_x
from rhot.messages import Side
from rhot.rig.file_model import FileModel, HoldS, Positive, Vector3

WalkProgram = Literal[
    "still",
    "marker_moving",
    "head_moving",
    "sudden",
    "step",
    "side_steps",
    "line",
    "circle",
    "bend_knees",
    "turn_body",
    "on_spot",
    "walk",
    "curve",
    "step_over",
    "squat",
    "sitting",
]
"""What the simulated person does: the 2021 thesis's four tests and six walking tasks, then ours."""


class DepthCameraConfig(FileModel):
    """The head-worn depth camera that looks at the feet.

    Attributes:
        source: kind of source.
        serial: of the RealSense; the only one that is plugged in when left out.
        path: recording folder, relative to the rig folder.
        width, height: pixels, of colour and depth.
        rate_hz: frames per second.
        pitch_deg: how far the camera looks down from the head's forward direction.
        position_m: of the camera in the head's frame (x right, y up, z backwards).
        min_depth_m, max_depth_m: depths outside are not believed.
        loop: start a recording again at its end.
    """

    source: Literal["realsense", "recorded", "simulated"] = "realsense"
    serial: str | None = None
    path: str | None = None
    width: Annotated[int, Field(ge=64, le=4096)] = 848
    height: Annotated[int, Field(ge=64, le=4096)] = 480
    rate_hz: Annotated[float, Field(gt=0.0, le=300.0)] = 60.0
    pitch_deg: Annotated[float, Field(ge=-90.0, le=90.0)] = 20.0
    position_m: Vector3 = (0.0, 0.05, -0.08)
    min_depth_m: Positive = 0.3
    max_depth_m: Positive = 4.0
    loop: bool = False

    @property
    def T_head_camera(self) -> FloatArray:
        """(4, 4): OpenCV's camera axes in the head's (x right, y up, -z forward), pitched down."""
        R = rotation_x(-math.radians(self.pitch_deg)) @ np.diag([1.0, -1.0, -1.0])
        return rigid(R, np.array(self.position_m))

    @model_validator(mode="after")
    def _consistent(self) -> DepthCameraConfig:
        if self.source == "recorded" and not self.path:
            raise ValueError('source = "recorded" needs `path`')
        if self.min_depth_m >= self.max_depth_m:
            raise ValueError(f"min_depth_m {self.min_depth_m} must be below max_depth_m {self.max_depth_m}")
        return self


class ImuConfig(FileModel):
    """The inertial sensor on an ankle.

    Attributes:
        source: kind of source.
        device: serial port.
        baud: of the serial port.
        format: `text` (lines of `timestamp L|R values ;`, as of a BNO080) or `binary` (see docs/feet.md).
        path: CSV file, relative to the rig folder.
        rate_hz: samples per second that are expected.
        loop: start a recording again at its end.
    """

    source: Literal["serial", "recorded", "simulated"] = "serial"
    device: str = ""
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] = 115_200
    format: Literal["text", "binary"] = "text"
    path: str | None = None
    rate_hz: Annotated[float, Field(gt=0.0, le=2000.0)] = 100.0
    loop: bool = False

    @model_validator(mode="after")
    def _has_origin(self) -> ImuConfig:
        if self.source == "serial" and not self.device:
            raise ValueError('source = "serial" needs `device`, for example device = "/dev/ttyUSB0"')
        if self.source == "recorded" and not self.path:
            raise ValueError('source = "recorded" needs `path`')
        return self


class FootConfig(FileModel):
    """What one foot wears.

    Attributes:
        marker_id: of its ArUco marker.
        imu: its inertial sensor, if it has one.
        ankle_m: position of the ankle joint in the foot's frame (see `FootPose`).
    """

    marker_id: Annotated[int, Field(ge=0, le=1023)]
    imu: ImuConfig | None = None
    ankle_m: Vector3 = (0.0, 0.0, 0.07)


class FeetConfig(FileModel):
    """How feet are tracked from the head.

    Attributes:
        camera: the depth camera on the head.
        left, right: the feet; at least one.
        dictionary: of the markers, by OpenCV's name; `3X3_32` is the 2021 thesis's own kind with 3x3 bits.
        marker_size_m: side of a marker's black square.
        up: the direction against gravity in the rig frame.
        method: `filter` (error-state Kalman filter) or `thesis` (the 2021 thesis's constant-acceleration filter).
        hold_s: how long a foot is predicted after it was last measured.
        predict_s: poses are published for this much after the newest measurement.
    """

    camera: DepthCameraConfig = DepthCameraConfig()
    left: FootConfig | None = None
    right: FootConfig | None = None
    dictionary: Annotated[str, Field(pattern=r"^[A-Z0-9_]{3,32}$")] = "3X3_32"
    marker_size_m: Annotated[float, Field(gt=0.005, le=0.5)] = 0.06
    up: Vector3 = (0.0, 1.0, 0.0)
    method: Literal["filter", "thesis"] = "filter"
    hold_s: HoldS = 3.0
    predict_s: Annotated[float, Field(ge=0.0, le=0.2)] = 0.0

    @model_validator(mode="after")
    def _consistent(self) -> FeetConfig:
        if self.left is None and self.right is None:
            raise ValueError("name at least one foot: [feet.left] or [feet.right] with marker_id")
        if self.left and self.right and self.left.marker_id == self.right.marker_id:
            raise ValueError(f"left and right both have marker_id {self.left.marker_id}; each foot needs its own")
        if not any(abs(component) > 1e-9 for component in self.up):
            raise ValueError("up = [0, 0, 0] is no direction")
        return self

    @property
    def feet(self) -> dict[Side, FootConfig]:
        """The feet that are tracked, left before right."""
        both: dict[Side, FootConfig | None] = {"left": self.left, "right": self.right}
        return {side: foot for side, foot in both.items() if foot is not None}


class BodyConfig(FileModel):
    """The person whose body is solved.

    Attributes:
        height_m: standing, without shoes.
        hip_width_m, thigh_m, shank_m: between the hip joints, hip to knee, knee to ankle; from the height by average
            proportions when left out.
        upper_arm_m, forearm_m: shoulder to elbow, elbow to wrist; likewise.
    """

    height_m: Annotated[float, Field(ge=0.8, le=2.5)] = 1.75
    hip_width_m: Positive | None = None
    thigh_m: Positive | None = None
    shank_m: Positive | None = None
    upper_arm_m: Positive | None = None
    forearm_m: Positive | None = None
