"""The whole lower body from the head and the feet: hips, knees, ankles, balls of the feet, joint angles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.geometry.transforms import rigid
from rhot.messages import Side
from rhot_ik.legs.hips import OUTWARDS, hip_joint
from rhot_ik.legs.leg import Ankle, LegPose, bend_leg

_FOOT_WEIGHT: Final = 0.75
"""How much a knee points where the toes do, and how much where the hips do."""
_LEAST_ACROSS: Final = 0.1
"""Cosine to the hips' own axis from which on a direction counts in full; 84°. Chosen."""


@dataclass(frozen=True, slots=True)
class BodySolution:
    """A solved lower body.

    Attributes:
        joints: name as in `BodyPose` to (4, 4) in the rig frame.
        legs: side to the leg.
        angles_rad: side to (5,): hip flexion, abduction and rotation, knee flexion, ankle flexion as in `LegAngles`.
    """

    joints: Mapping[str, FloatArray]
    legs: Mapping[Side, LegPose]
    angles_rad: Mapping[Side, FloatArray]


def solve_body(T_rig_hips: FloatArray, ankles: Mapping[Side, Ankle], body: BodyModel) -> BodySolution:
    """Return the lower body between the hips and the ankles that are known.

    Args:
        T_rig_hips: (4, 4) middle between the hip joints.
        ankles: one foot or both.
        body: lengths.
    """
    R_hips = T_rig_hips[:3, :3]
    joints: dict[str, FloatArray] = {"hips": T_rig_hips}
    legs: dict[Side, LegPose] = {}
    angles: dict[Side, FloatArray] = {}
    for side, ankle in ankles.items():
        hip = R_hips @ hip_joint(side, body) + T_rig_hips[:3, 3]
        leg = bend_leg(hip, ankle.position, _hinge(R_hips, ankle, hip), body.thigh_m, body.shank_m)
        R_foot = ankle.T_rig_ankle[:3, :3]
        legs[side] = leg
        joints[f"{side}_hip"] = rigid(leg.R_thigh, leg.hip)
        joints[f"{side}_knee"] = rigid(leg.R_shank, leg.knee)
        joints[f"{side}_ankle"] = rigid(R_foot, leg.ankle)
        joints[f"{side}_foot"] = rigid(R_foot, leg.ankle + R_foot @ body.ball_m)
        angles[side] = _angles(R_hips, leg, R_foot, OUTWARDS[side])
    return BodySolution(joints, legs, angles)


def _hinge(R_hips: FloatArray, ankle: Ankle, hip: FloatArray) -> FloatArray:
    """Return the direction (3,) of the knee's axis: between those of the foot and of the hips.

    Both are weighed by how much of them lies across the leg, so that the mixture never vanishes and never jumps while a
    foot rolls along the leg.
    """
    line = ankle.position - hip
    down = line / max(float(np.linalg.norm(line)), 1e-9)
    hinge = np.zeros(3)
    share = _FOOT_WEIGHT * ankle.trust
    for direction, weight in ((ankle.T_rig_ankle[:3, 0], share), (R_hips[:, 0], 1.0 - share)):
        across = direction - (direction @ down) * down
        # A foot turned backwards is a wrong measurement: it must not turn the knee.
        agreement = float(np.clip((across @ R_hips[:, 0]) / _LEAST_ACROSS, 0.0, 1.0))
        hinge += weight * agreement * across
    if float(np.linalg.norm(hinge)) < 1e-3:
        # The leg lies along the hips' own axis: the hips' front decides.
        hinge = np.cross(down, -R_hips[:, 2])
    return hinge if float(np.linalg.norm(hinge)) > 1e-6 else np.cross(down, R_hips[:, 1])


def _angles(R_hips: FloatArray, leg: LegPose, R_foot: FloatArray, outwards: float) -> FloatArray:
    """Return (5,) angles of a leg: R_hipsᵀ R_thigh = Rx(flexion) · Rz(abduction) · Ry(rotation), ankle about +X.

    Flexion forwards, abduction away from the other leg, rotation with the toes outwards, toes upwards.
    """
    thigh = R_hips.T @ leg.R_thigh
    abduction = np.arcsin(np.clip(-thigh[0, 1], -1.0, 1.0))
    flexion = np.arctan2(thigh[2, 1], thigh[1, 1])
    rotation = np.arctan2(thigh[0, 2], thigh[0, 0])
    foot = leg.R_shank.T @ R_foot
    ankle = np.arctan2(foot[2, 1], foot[1, 1])
    return np.array([flexion, outwards * abduction, -outwards * rotation, leg.knee_flexion_rad, ankle])
