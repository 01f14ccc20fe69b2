"""`registration.json` with the offset that touches told."""

from __future__ import annotations

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot.messages.base import wire_position, wire_quaternion
from rhot.rig import RegistrationFile, RigidTransform
from rhot.rig.calibration import today
from rhot_calibration.objects.record import TouchQuality
from rhot_calibration.objects.touch.checks import Judged
from rhot_calibration.objects.touch.streams import TouchTask


def R_before(task: TouchTask) -> FloatArray:
    """Return R_device_object (3, 3) so far."""
    fixed = task.registration.T_device_object.get(task.object_id)
    return np.eye(3) if fixed is None else rotation_from_quaternion(fixed.orientation_xyzw)


def touched_registration(earlier: RegistrationFile, task: TouchTask, found: Judged, taken: int) -> RegistrationFile:
    """Return the file to write: the earlier one with another offset of one object.

    Args:
        earlier: whose tracker space and other objects stay.
        task: what was touched.
        found: the offset.
        taken: how many touches there were, with those left out.
    """
    fit = found.fit
    quality = TouchQuality(
        date=today(),
        finger=f"{task.side} {task.finger}",
        touches=len(found.kept),
        left_out=taken - len(found.kept),
        residual_rms_mm=round(1e3 * fit.rms_m, 3),
        position_sd_mm=round(1e3 * fit.position_sd_m, 3),
        rotation_sd_deg=round(float(np.degrees(fit.rotation_sd_rad)), 4),
        flesh_mm=round(1e3 * fit.flesh_m, 3),
    )
    # `quality` of an imported or simulated registration may be anything.
    before = earlier.quality if isinstance(earlier.quality, dict) else {}
    others = before.get("touched")
    touched = {**(others if isinstance(others, dict) else {}), task.object_id: quality.model_dump(mode="json")}
    offset = RigidTransform(
        position=wire_position(fit.p_device_object),
        orientation=wire_quaternion(quaternion_from_rotation(fit.R_device_object)),
    )
    return earlier.model_copy(
        update={
            "quality": {**before, "touched": touched},
            "T_tracker_object": {**earlier.T_tracker_object, task.object_id: offset},
        }
    )
