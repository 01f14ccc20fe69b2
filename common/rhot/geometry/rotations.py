"""Small pure functions on rotations; matrices act on column vectors, quaternions are (x, y, z, w)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def rotation_x(angle_rad: float) -> FloatArray:
    """Return the right-handed rotation about x as a (3, 3) matrix."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle_rad: float) -> FloatArray:
    """Return the right-handed rotation about y as a (3, 3) matrix."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle_rad: float) -> FloatArray:
    """Return the right-handed rotation about z as a (3, 3) matrix."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_from_vector(vector_rad: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) about `vector_rad` (3,) by its length in radians (Rodrigues' formula)."""
    angle = float(np.sqrt(vector_rad @ vector_rad))
    x, y, z = (float(component) for component in vector_rad)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-7:
        return nearest_rotation(np.eye(3) + K)
    rotation: FloatArray = np.eye(3) + (np.sin(angle) / angle) * K + ((1.0 - np.cos(angle)) / angle**2) * (K @ K)
    return rotation


def vector_from_rotation(R: FloatArray) -> FloatArray:
    """Return the axis times the angle (3,), radians, of a rotation (3, 3); the angle lies in [0, π]."""
    x, y, z, w = quaternion_from_rotation(R)
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    sine = float(np.sqrt(x * x + y * y + z * z))
    scale = 2.0 if sine < 1e-9 else 2.0 * float(np.arctan2(sine, w)) / sine
    return np.array([x, y, z]) * scale


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) nearest to `M` (3, 3) in the Frobenius norm, the maximiser of trace(Rᵀ M).

    Source: Kabsch 1976; Umeyama 1991, eq. 40.
    """
    U, _, Vt = np.linalg.svd(M)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0.0:
        U[:, 2] = -U[:, 2]
    rotation: FloatArray = U @ Vt
    return rotation


def quaternion_from_rotation(R: FloatArray) -> FloatArray:
    """Return unit quaternions (..., 4), x y z w, of rotations (..., 3, 3).

    The largest of the four components is computed first and the others follow from it, so no case is badly
    conditioned (Shepperd 1978). The sign is whatever falls out; q and −q are the same rotation.
    """
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # Rows of 4·q·qᵀ; the one with the largest diagonal is 4·q_i·q, free of cancellation.
    table = np.empty((*R.shape[:-2], 4, 4))
    table[..., 0, 0] = 1.0 + m00 - m11 - m22
    table[..., 1, 1] = 1.0 - m00 + m11 - m22
    table[..., 2, 2] = 1.0 - m00 - m11 + m22
    table[..., 3, 3] = 1.0 + m00 + m11 + m22
    table[..., 0, 1] = table[..., 1, 0] = R[..., 0, 1] + R[..., 1, 0]
    table[..., 0, 2] = table[..., 2, 0] = R[..., 0, 2] + R[..., 2, 0]
    table[..., 1, 2] = table[..., 2, 1] = R[..., 1, 2] + R[..., 2, 1]
    table[..., 0, 3] = table[..., 3, 0] = R[..., 2, 1] - R[..., 1, 2]
    table[..., 1, 3] = table[..., 3, 1] = R[..., 0, 2] - R[..., 2, 0]
    table[..., 2, 3] = table[..., 3, 2] = R[..., 1, 0] - R[..., 0, 1]
    largest = np.argmax(np.diagonal(table, axis1=-2, axis2=-1), axis=-1)
    quaternion = np.take_along_axis(table, largest[..., None, None], axis=-2)[..., 0, :]
    unit: FloatArray = quaternion / np.sqrt((quaternion * quaternion).sum(axis=-1, keepdims=True))
    return unit


def rotation_from_quaternion(xyzw: FloatArray) -> FloatArray:
    """Return rotations (..., 3, 3) of quaternions (..., 4), x y z w, of any length but zero."""
    x, y, z, w = np.moveaxis(xyzw / np.linalg.norm(xyzw, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    R: FloatArray = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    return R
