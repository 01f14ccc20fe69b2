"""One leg in closed form: a thigh and a shank on a hinge, between a hip joint and an ankle.

A chain of two bones whose hinge axis is known has one solution (the law of cosines), so that nothing is iterated: with
d the distance from hip to ankle, the knee lies d/2 + (a² − b²)/(2 d) along that line and as far in front of it as
the thigh's length asks. The bend is to the front of the hinge axis by construction: a knee cannot point backwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Ankle:
    """An ankle at a moment.

    Attributes:
        T_rig_ankle: (4, 4), axes level when the foot stands flat.
        trust: 1 = as measured, 0 = only guessed.
    """

    T_rig_ankle: FloatArray
    trust: float = 1.0

    @property
    def position(self) -> FloatArray:
        """(3,) metres, rig frame."""
        position: FloatArray = self.T_rig_ankle[:3, 3]
        return position


@dataclass(frozen=True, slots=True)
class LegPose:
    """A solved leg; frames as in `rhot.messages.BodyJoint`.

    Attributes:
        hip, knee, ankle: (3,) metres. The ankle differs from the asked one where that was out of reach.
        R_thigh, R_shank: (3, 3); +X along the hinge to the body's right, +Y along the bone towards the hip.
        knee_flexion_rad: 0 = straight.
    """

    hip: FloatArray
    knee: FloatArray
    ankle: FloatArray
    R_thigh: FloatArray
    R_shank: FloatArray
    knee_flexion_rad: float


def bend_leg(hip: FloatArray, ankle: FloatArray, hinge: FloatArray, thigh_m: float, shank_m: float) -> LegPose:
    """Return the leg between a hip joint and an ankle, (3,) metres.

    Args:
        hip, ankle: (3,) metres; the ankle is moved along the line to the hip where it is out of reach, and by up
            to 0.3 % of the leg's length where the leg is straight.
        hinge: (3,) direction of the knee's axis, to the body's right; the part of it across the leg counts, and it must
            have one.
        thigh_m, shank_m: lengths.
    """
    line = ankle - hip
    reach = float(np.linalg.norm(line))
    length = thigh_m + shank_m
    down = _unit(line) if reach > 1e-9 else _unit(np.cross(_across(hinge), hinge))
    # Ankle to hip is no shorter than this share of the leg: the flesh of thigh and calf meets at about 150° of
    # flexion.
    distance = max(_softened(reach, length), 0.25 * length, 1.001 * abs(thigh_m - shank_m))
    right = _unit(hinge - (hinge @ down) * down)
    front = np.cross(right, down)
    along = (distance**2 + thigh_m**2 - shank_m**2) / (2.0 * distance)
    off = float(np.sqrt(max(thigh_m**2 - along**2, 0.0)))
    knee = hip + along * down + off * front
    end = hip + distance * down
    cosine = (thigh_m**2 + shank_m**2 - distance**2) / (2.0 * thigh_m * shank_m)
    flexion = float(np.pi - np.arccos(np.clip(cosine, -1.0, 1.0)))
    return LegPose(hip, knee, end, _bone_frame(hip - knee, right), _bone_frame(knee - end, right), flexion)


def _bone_frame(up: FloatArray, right: FloatArray) -> FloatArray:
    y = _unit(up)
    return np.stack([right, y, np.cross(right, y)], axis=-1)


def _softened(reach_m: float, length_m: float) -> float:
    """Return the distance from hip to ankle that a leg takes on for an asked one.

    Near the straight leg the knee's position goes with the root of what is left, and an error of millimetres would make
    it jump by centimetres; so the last bit is approached exponentially ("soft IK", known from character animation).
    """
    # The last part of the leg's length, over which it straightens ever more slowly.
    soft_m = 0.008 * length_m
    begin_m = length_m - soft_m
    if reach_m <= begin_m:
        return reach_m
    return length_m - soft_m * float(np.exp(-(reach_m - begin_m) / soft_m))


def _unit(vector: FloatArray) -> FloatArray:
    unit: FloatArray = vector / np.linalg.norm(vector)
    return unit


def _across(direction: FloatArray) -> FloatArray:
    """Return the axis (3,) that a direction has least of: any that is not parallel to it."""
    axis = np.zeros(3)
    axis[int(np.argmin(np.abs(direction)))] = 1.0
    return axis
