"""Rotations, inverses and distances of size 3 in plain arithmetic: for single ones faster than array calls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import vector_from_rotation

FloatArray = NDArray[np.float64]

_UNIT = np.eye(3)


def turn_from_vector(vector_rad: FloatArray) -> FloatArray:
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


def vector_from_turn(R: FloatArray) -> FloatArray:
    """Return the rotation vector (3,), radians, of a rotation (3, 3)."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    cosine = 0.5 * (a + e + i - 1.0)
    if cosine < 0.0:
        return vector_from_rotation(R)
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 1.0 if sine < 1e-9 else math.atan2(sine, cosine) / sine
    return np.array([x * scale, y * scale, z * scale])


def rotation_between(R0: FloatArray, R1: FloatArray) -> FloatArray:
    """Return the rotation vector (3,), radians, in the outer frame, that takes R0 (3, 3) to R1: R1 = exp([v]×)·R0."""
    return vector_from_turn(R1 @ R0.T)


def turn_cosine(R0: FloatArray, R1: FloatArray) -> float:
    """Return the cosine of the angle between two rotations (3, 3)."""
    return 0.5 * (float((R0 * R1).sum()) - 1.0)


def turn_between(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the shortest rotation (3, 3) that takes one unit vector (3,) to another."""
    axis = np.cross(start, end)
    sine = math.sqrt(float(axis @ axis))
    return turn_from_vector(axis * (math.atan2(sine, float(start @ end)) / max(sine, 1e-9)))


def quaternion_from_turn(R: FloatArray) -> tuple[float, float, float, float]:
    """Return the unit quaternion x, y, z, w of a rotation (3, 3) (Shepperd 1978)."""
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
    return x * scale, y * scale, z * scale, w * scale


def turn_from_quaternion(xyzw: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) of one quaternion (4,), x y z w, of any length but zero."""
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


def symmetric_inverse(M: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric positive definite matrix (3, 3), by its cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = M.tolist()
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * A + b * B + c * C)
    A, B, C = A * scale, B * scale, C * scale
    E = (b * c - a * e) * scale
    return np.array([[A, B, C], [B, (a * f - c * c) * scale, E], [C, E, (a * d - b * b) * scale]])


def squared_distance(vector: FloatArray, covariance: FloatArray) -> float:
    """Return the squared Mahalanobis distance vᵀ·C⁻¹·v of a vector (3,) under a covariance (3, 3)."""
    return max(0.0, float(vector @ symmetric_inverse(covariance) @ vector))


def orthonormal(R: FloatArray) -> FloatArray:
    """Return a matrix (3, 3) that is a rotation but for rounding as a rotation: one step of R·(3 − RᵀR)/2."""
    nearer: FloatArray = R @ (1.5 * _UNIT - 0.5 * (R.T @ R))
    return nearer
