"""One leg between hip and ankle: where the knee is, exactly, and how thigh and shank lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Leg:
    """A leg at N moments, rig frame; frames as in `rhot.messages.BodyJoint`.

    Attributes:
        knee: (N, 3) metres.
        R_thigh, R_shank: (N, 3, 3); +Y along the bone towards the hip, +X the axis of the knee, to the body's right.
    """

    knee: FloatArray
    R_thigh: FloatArray
    R_shank: FloatArray


def solve_leg(hip: FloatArray, ankle: FloatArray, ahead: FloatArray, thigh_m: float, shank_m: float) -> Leg:
    """Bend a leg between hip and ankle, (N, 3), so that the knee points to `ahead` (N, 3) as far as it can.

    Two triangles with a common side: the knee lies at a² − b² + d² over 2 d from the hip along the line to the ankle,
    and as far off that line as the thigh's length then asks. Where the ankle is out of reach the lengths are kept and
    the leg ends short of it.
    """
    line = ankle - hip
    reach = np.linalg.norm(line, axis=1)
    along_axis = line / reach[:, None]
    distance = np.minimum(reach, thigh_m + shank_m)
    along = (thigh_m**2 - shank_m**2 + distance**2) / (2.0 * distance)
    off = np.sqrt(np.maximum(thigh_m**2 - along**2, 0.0))
    bend = ahead - (ahead * along_axis).sum(axis=1, keepdims=True) * along_axis
    bend /= np.linalg.norm(bend, axis=1, keepdims=True)
    knee = hip + along[:, None] * along_axis + off[:, None] * bend
    right = np.cross(along_axis, bend)
    end = hip + distance[:, None] * along_axis
    return Leg(knee, _frame(hip - knee, right), _frame(knee - end, right))


def _frame(up: FloatArray, right: FloatArray) -> FloatArray:
    y = up / np.linalg.norm(up, axis=1, keepdims=True)
    return np.stack([right, y, np.cross(right, y)], axis=-1)
