"""Transformation between the tracking system's space and the rig frame.

T_rig_object = T_rig_tracker · T_space_device · T_device_object, where T_space_device is the tracking system's
measurement, T_rig_tracker the pose of its space in the rig frame, and T_device_object (`T_tracker_object` in
`registration.json`) the pose of the object in the frame of the device that is attached to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rhot.rig.calibration import RegistrationFile
from rhot_objects.pose import Pose


@dataclass(frozen=True, slots=True)
class Registration:
    """`registration.json`, ready to use.

    Attributes:
        T_rig_tracker: maps the tracking system's space to the rig frame.
        T_device_object: pose of each object in its device's frame, by object id; identity if absent.
    """

    T_rig_tracker: Pose
    T_device_object: Mapping[str, Pose]

    @classmethod
    def from_file(cls, file: RegistrationFile) -> Registration:
        """Return the registration of a loaded `registration.json`."""
        return cls(
            Pose.from_transform(file.T_rig_tracker),
            {name: Pose.from_transform(transform) for name, transform in file.T_tracker_object.items()},
        )

    def to_rig(self, object_id: str, T_space_device: Pose) -> Pose:
        """Return T_rig_object of a measured device pose."""
        T_rig_device = self.T_rig_tracker @ T_space_device
        fixed = self.T_device_object.get(object_id)
        return T_rig_device if fixed is None else T_rig_device @ fixed

    def to_tracker(self, object_id: str, T_rig_object: Pose) -> Pose:
        """Return T_space_device, the tracking system's measurement of an object at a pose in the rig frame."""
        fixed = self.T_device_object.get(object_id)
        T_rig_device = T_rig_object if fixed is None else T_rig_object @ fixed.inverse()
        return self.T_rig_tracker.inverse() @ T_rig_device
