"""Rigid transforms as position and unit quaternion, and the motion between two of them.

Convention: T_a_b maps coordinates of frame b to frame a, X_a = R(q) · X_b + p; quaternions are (x, y, z, w), Hamilton
product, so that R(q1 · q2) = R(q1) · R(q2). q and −q are the same rotation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rhot.arrays import FloatArray
from rhot.geometry.rotations import product_matrix, quaternion_from_rotation, rotation_from_quaternion
from rhot.rig.calibration import RegistrationFile, RigidTransform

# Transformation between the tracking system's space and the rig frame.
#
# T_rig_object = T_rig_tracker · T_space_device · T_device_object, where T_space_device is the tracking system's
# measurement, T_rig_tracker the pose of its space in the rig frame, and T_device_object (`T_tracker_object` in
# `registration.json`) the pose of the object in the frame of the device that is attached to it.


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


_ROTATION_TOLERANCE = 1e-2
_CONJUGATE = (-1.0, -1.0, -1.0, 1.0)
_SLERP_LINEAR_ABOVE = 1.0 - 1e-10
"""Cosine of the half angle above which linear interpolation is used, because slerp would divide by a sine near 0."""


@dataclass(frozen=True, slots=True)
class Pose:
    """A rigid transform T_a_b.

    Attributes:
        position: (3,) read-only float64, metres: origin of b in a.
        orientation_xyzw: (4,) read-only float64, unit quaternion: rotates b's directions into a.
    """

    position: FloatArray
    orientation_xyzw: FloatArray

    @classmethod
    def from_arrays(cls, position: ArrayLike, orientation_xyzw: ArrayLike) -> Pose:
        """Build a pose from position (3,), metres, and a quaternion (4,) of any norm but zero.

        Raises:
            ValueError: a value is not finite or the quaternion is zero.
        """
        p = np.array(position, dtype=np.float64).reshape(3)
        q = np.array(orientation_xyzw, dtype=np.float64).reshape(4)
        norm = math.hypot(*q)
        if not (np.isfinite(p).all() and np.isfinite(norm) and norm > 1e-9):
            raise ValueError(f"not a pose: position {p.tolist()}, quaternion {q.tolist()}")
        q /= norm
        p.setflags(write=False)
        q.setflags(write=False)
        return cls(p, q)

    @classmethod
    def from_transform(cls, transform: RigidTransform) -> Pose:
        """Build a pose from an entry of `registration.json`."""
        return cls.from_arrays(transform.position, transform.orientation)

    @classmethod
    def from_matrix(cls, T: ArrayLike) -> Pose:
        """Build a pose from the upper three rows of a 4x4 transform, (3, 4) or (4, 4), metres.

        Raises:
            ValueError: a value is not finite or the left 3x3 is far from a rotation.
        """
        matrix = np.asarray(T, dtype=np.float64)[:3]
        R = matrix[:, :3]
        if not (np.allclose(R @ R.T, np.eye(3), atol=_ROTATION_TOLERANCE) and np.linalg.det(R) > 0.0):
            raise ValueError(f"not a rotation matrix: {R.tolist()}")
        return cls.from_arrays(matrix[:, 3], quaternion_from_rotation(R))

    def __matmul__(self, other: Pose) -> Pose:
        """Return T_a_c = T_a_b · T_b_c."""
        return Pose.from_arrays(
            self.position + rotation_from_quaternion(self.orientation_xyzw) @ other.position,
            product_matrix(*self.orientation_xyzw) @ other.orientation_xyzw,
        )

    def inverse(self) -> Pose:
        """Return T_b_a."""
        conjugate = self.orientation_xyzw * _CONJUGATE
        return Pose.from_arrays(-rotation_from_quaternion(conjugate) @ self.position, conjugate)


def interpolate(start: Pose, end: Pose, share: float) -> Pose:
    """Return an interpolated pose: linear in position, slerp along the shorter arc in orientation.

    Args:
        start: pose at share 0.
        end: pose at share 1.
        share: 0 to 1.

    Slerp after K. Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985.
    """
    q0, q1 = start.orientation_xyzw, end.orientation_xyzw
    cosine = float(q0 @ q1)
    if cosine < 0.0:
        q1, cosine = -q1, -cosine
    if cosine > _SLERP_LINEAR_ABOVE:
        weights = (1.0 - share, share)
    else:
        half_angle = np.arccos(cosine)
        weights = (
            np.sin((1.0 - share) * half_angle) / np.sin(half_angle),
            np.sin(share * half_angle) / np.sin(half_angle),
        )
    return Pose.from_arrays((1.0 - share) * start.position + share * end.position, weights[0] * q0 + weights[1] * q1)


def angle_between(first: Pose, second: Pose) -> float:
    """Return the angle of the rotation from one pose to the other, radians, 0 to π."""
    # atan2 is precise at small angles, where arccos of the dot product loses half of the digits.
    relative = product_matrix(*(first.orientation_xyzw * _CONJUGATE)) @ second.orientation_xyzw
    return float(2.0 * np.arctan2(np.linalg.norm(relative[:3]), abs(relative[3])))
