"""A rig on disk: `rig.toml`, written by people, beside the files that calibration wrote."""

from rhot.rig.calibration import (
    CameraCalibration,
    CamerasFile,
    HandFile,
    HeadsetFile,
    RegistrationFile,
    RigidTransform,
    StageFile,
)
from rhot.rig.config import (
    CameraConfig,
    FusionConfig,
    HandConfig,
    IkConfig,
    MarkerConfig,
    ObjectConfig,
    RigConfig,
)
from rhot.rig.feet_config import BodyConfig, DepthCameraConfig, FeetConfig, FootConfig, ImuConfig
from rhot.rig.folder import Rig, load_rig, read_json_model, write_json_model
from rhot.rig.sections import BridgeConfig, BridgeTarget, BusConfig

__all__ = [
    "BodyConfig",
    "BridgeConfig",
    "BridgeTarget",
    "BusConfig",
    "CameraCalibration",
    "CameraConfig",
    "CamerasFile",
    "DepthCameraConfig",
    "FeetConfig",
    "FootConfig",
    "FusionConfig",
    "HandConfig",
    "HandFile",
    "HeadsetFile",
    "IkConfig",
    "ImuConfig",
    "MarkerConfig",
    "ObjectConfig",
    "RegistrationFile",
    "Rig",
    "RigConfig",
    "RigidTransform",
    "StageFile",
    "load_rig",
    "read_json_model",
    "write_json_model",
]
