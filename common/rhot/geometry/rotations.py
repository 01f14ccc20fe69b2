"""Rotations of three dimensions; matrices act on column vectors, quaternions are (x, y, z, w).

Single rotations are computed in plain arithmetic: beside array calls on three numbers it takes a fifth of the time.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from rhot.arrays import FloatArray

# Small pure functions on rigid transforms: T_a_b is (4, 4) and maps coordinates of frame b to frame a, metres.


def rigid(R: FloatArray, t: FloatArray) -> FloatArray:
    """Return the transform (4, 4) of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def inverse(T: FloatArray) -> FloatArray:
    """Return the inverse of a rigid transform (4, 4)."""
    return rigid(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])


_IDENTITY: Final = np.eye(3)

_CROSS: Final = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)
"""(3, 9): v @ _CROSS is [v]×, row by row."""


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
    """Return exp([v]×), (3, 3), of a rotation vector (3,), radians (Rodrigues' formula)."""
    x, y, z = vector_rad.tolist()
    squared = x * x + y * y + z * z
    if squared < 1e-12:
        sine, cosine = 1.0 - squared / 6.0, 0.5 - squared / 24.0
    else:
        angle = math.sqrt(squared)
        sine, cosine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / squared
    xy, xz, yz = cosine * x * y, cosine * x * z, cosine * y * z
    return np.array(
        [
            [1.0 - cosine * (y * y + z * z), xy - sine * z, xz + sine * y],
            [xy + sine * z, 1.0 - cosine * (x * x + z * z), yz - sine * x],
            [xz - sine * y, yz + sine * x, 1.0 - cosine * (x * x + y * y)],
        ]
    )


def vector_from_rotation(R: FloatArray) -> FloatArray:
    """Return the rotation vector (3,), axis times angle in radians, of a rotation (3, 3); the angle lies in [0, π]."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    cosine = 0.5 * (a + e + i - 1.0)
    if cosine < 0.0:
        # Near half a turn the sine says little of the axis; the quaternion says all.
        x, y, z, w = quaternion_from_rotation(R).tolist()
        sine = math.copysign(math.sqrt(x * x + y * y + z * z), w)
        scale = 2.0 * math.atan2(abs(sine), abs(w)) / sine
        return np.array([x * scale, y * scale, z * scale])
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 1.0 if sine < 1e-9 else math.atan2(sine, cosine) / sine
    return np.array([x * scale, y * scale, z * scale])


def rotation_vectors(R: FloatArray) -> FloatArray:
    """Return the rotation vectors (..., 3), radians, of rotations (..., 3, 3)."""
    xyzw = quaternion_from_rotation(R)
    xyzw = np.where(xyzw[..., 3:] < 0.0, -xyzw, xyzw)
    sine = np.linalg.norm(xyzw[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, xyzw[..., 3:])
    vectors: FloatArray = xyzw[..., :3] * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)
    return vectors


def rotation_between(R0: FloatArray, R1: FloatArray) -> FloatArray:
    """Return the rotation vector (3,), radians, in the outer frame, that takes R0 (3, 3) to R1: R1 = exp([v]×)·R0."""
    return vector_from_rotation(R1 @ R0.T)


def rotation_cosine(R0: FloatArray, R1: FloatArray) -> float:
    """Return the cosine of the angle between two rotations (3, 3)."""
    return 0.5 * (float((R0 * R1).sum()) - 1.0)


def shortest_rotation(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the shortest rotation (3, 3) that takes one unit vector (3,) to another."""
    axis = np.cross(start, end)
    sine = math.sqrt(float(axis @ axis))
    return rotation_from_vector(axis * (math.atan2(sine, float(start @ end)) / max(sine, 1e-9)))


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Return the rotations nearest to `M` (..., 3, 3) in the Frobenius norm, the maximisers of trace(Rᵀ M).

    Source: Kabsch 1976; Umeyama 1991, eq. 40.
    """
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    rotation: FloatArray = U @ Vt
    return rotation


def orthonormal(R: FloatArray) -> FloatArray:
    """Return a rotation (3, 3) freed of rounding errors: one step of R·(3 − RᵀR)/2."""
    nearer: FloatArray = R @ (1.5 * _IDENTITY - 0.5 * (R.T @ R))
    return nearer


def quaternion_from_rotation(R: FloatArray) -> FloatArray:
    """Return unit quaternions (..., 4), x y z w, of rotations (..., 3, 3).

    The largest of the four components is computed first and the others follow from it, so no case is badly
    conditioned (Shepperd 1978). The sign is whatever falls out; q and −q are the same rotation.
    """
    if R.ndim == 2:
        return _quaternion_from_one(R)
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


def _quaternion_from_one(R: FloatArray) -> FloatArray:
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    largest = max(a, e, i, a + e + i)
    if largest == a + e + i:
        x, y, z, w = h - f, c - g, d - b, 1.0 + largest
    elif largest == a:
        x, y, z, w = 1.0 + a - e - i, b + d, c + g, h - f
    elif largest == e:
        x, y, z, w = b + d, 1.0 - a + e - i, f + h, c - g
    else:
        x, y, z, w = c + g, f + h, 1.0 - a - e + i, d - b
    scale = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
    return np.array([x * scale, y * scale, z * scale, w * scale])


def rotation_from_quaternion(xyzw: FloatArray) -> FloatArray:
    """Return rotations (..., 3, 3) of quaternions (..., 4), x y z w, of any length but zero."""
    if xyzw.ndim == 1:
        return _rotation_from_one(xyzw)
    x, y, z, w = np.moveaxis(xyzw / np.linalg.norm(xyzw, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    R: FloatArray = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    return R


def _rotation_from_one(xyzw: FloatArray) -> FloatArray:
    x, y, z, w = xyzw.tolist()
    s = 2.0 / (x * x + y * y + z * z + w * w)
    xx, yy, zz, xy, xz, yz = s * x * x, s * y * y, s * z * z, s * x * y, s * x * z, s * y * z
    wx, wy, wz = s * w * x, s * w * y, s * w * z
    return np.array(
        [
            [1.0 - yy - zz, xy - wz, xz + wy],
            [xy + wz, 1.0 - xx - zz, yz - wx],
            [xz - wy, yz + wx, 1.0 - xx - yy],
        ]
    )


def product_matrix(x: float, y: float, z: float, w: float) -> FloatArray:
    """Return the matrix (4, 4) that takes a quaternion r, x y z w, to the product q·r."""
    return np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])


def cross_matrix(vectors: FloatArray) -> FloatArray:
    """Return [v]× (..., 3, 3) of vectors (..., 3): [v]× · w = v × w."""
    crossed: FloatArray = (vectors @ _CROSS).reshape(*vectors.shape, 3)
    return crossed
