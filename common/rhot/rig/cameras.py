"""Cameras between the rig's files and geometry: this is the only place that turns one into the other."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rhot.geometry.camera import CameraModel, CameraRig
from rhot.rig.calibration import CameraCalibration, matrix3, matrix4
from rhot.rig.folder import Rig


def camera_model(entry: CameraCalibration) -> CameraModel:
    """Return the model of an entry of `cameras.json`."""
    return CameraModel.from_arrays(
        entry.width, entry.height, np.array(entry.K), np.array(entry.distortion), np.array(entry.T_rig_camera)
    )


def camera_models(entries: Mapping[str, CameraCalibration]) -> dict[str, CameraModel]:
    """Return the models of entries of `cameras.json`, by camera."""
    return {name: camera_model(entry) for name, entry in entries.items()}


def camera_entry(model: CameraModel) -> CameraCalibration:
    """Return the entry of `cameras.json` of a model."""
    return CameraCalibration(
        width=model.width,
        height=model.height,
        K=matrix3(model.K),
        distortion=tuple(model.distortion.tolist()),
        T_rig_camera=matrix4(model.T_rig_camera),
    )


def camera_rig(rig: Rig) -> CameraRig:
    """Return the cameras of a rig."""
    rates_hz = tuple(camera.rate_hz for camera in rig.config.cameras.values())
    models = camera_models(rig.cameras)
    return CameraRig(tuple(models), tuple(models.values()), rates_hz, rig.calibrated, rig.quality)
