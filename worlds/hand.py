"""A random right hand: bones, radii, paint and patch, and its forward kinematics.

Hand frame: origin wrist, x to the thumb, y distal, z palmar; millimetres. A bone frame has its origin at the proximal
joint, y to the tip and z palmar. Flexion turns about x (positive towards the palm), abduction about -z (positive
towards the thumb): `R_mcp = Rz(-(fan + abduction)) @ Rx(flexion)`, and for the thumb the base rotation comes first.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from rhot.arrays import FloatArray

FINGERS: Final = ("index", "middle", "ring", "little")
MARKERS: Final = ("thumb", *FINGERS, "base")
BONES: Final = (
    "hand",
    "thumb_metacarpal",
    "thumb_proximal",
    "thumb_distal",
    *(f"{finger}_{bone}" for finger in FINGERS for bone in ("proximal", "middle", "distal")),
)
JOINTS: Final = (
    "wrist",
    *(f"thumb_{joint}" for joint in ("cmc", "mcp", "ip", "tip")),
    *(f"{finger}_{joint}" for finger in FINGERS for joint in ("mcp", "pip", "dip", "tip")),
)
ANGLES: Final = (
    *(f"thumb_{angle}" for angle in ("cmc_flex", "cmc_abd", "mcp_flex", "ip_flex")),
    *(f"{finger}_{angle}" for finger in FINGERS for angle in ("mcp_flex", "mcp_abd", "pip_flex", "dip_flex")),
)
"""Columns of a pose; degrees."""
DIP_OF_PIP: Final = 2.0 / 3.0


@dataclass(frozen=True, slots=True)
class Cone:
    """A tapered capsule, rigid in one bone.

    Attributes:
        bone: index into `BONES`.
        start, end: (3,) centres of its two spheres, bone frame, mm.
        start_mm, end_mm: their radii.
    """

    bone: int
    start: FloatArray
    end: FloatArray
    start_mm: float
    end_mm: float


@dataclass(frozen=True, slots=True)
class Hand:
    """A hand with its paint.

    Attributes:
        lengths: per finger and thumb the three bone lengths, the last up to the skin of the tip, mm.
        mcp: per finger (3,) position of its MCP joint, hand frame, mm.
        cmc: (3,) base of the thumb, hand frame, mm.
        thumb_base: (3, 3) rotation of the thumb's metacarpal at zero angles.
        fan_deg: per finger its direction at zero abduction, positive towards the thumb.
        radii: per finger and thumb the radii at the three joints and the tip, mm.
        painted: per finger and thumb the painted length from the tip, mm.
        pulp: per finger and thumb how far palmar the centre of the tip's sphere lies, mm.
        patch: across, along the hand, thickness, mm.
        T_hand_patch: (4, 4) pose of the patch, its z palmar.
    """

    lengths: dict[str, tuple[float, float, float]]
    mcp: dict[str, FloatArray]
    cmc: FloatArray
    thumb_base: FloatArray
    fan_deg: dict[str, float]
    radii: dict[str, tuple[float, float, float, float]]
    painted: dict[str, float]
    pulp: dict[str, float]
    patch: tuple[float, float, float]
    T_hand_patch: FloatArray

    @property
    def length_mm(self) -> float:
        """Wrist to the tip of the middle finger, as `hand.json` implies it."""
        return float(np.linalg.norm(self.mcp["middle"])) + sum(self.lengths["middle"])

    def tip_cone(self, finger: str) -> Cone:
        """Return the distal phalanx of a finger or the thumb."""
        length, radii = self.lengths[finger][2], self.radii[finger]
        end = np.array([0.0, length - radii[3], self.pulp[finger]])
        return Cone(BONES.index(f"{finger}_distal"), np.zeros(3), end, radii[2], radii[3])

    def finger_cones(self, finger: str) -> tuple[Cone, Cone, Cone]:
        """Return the three bones of a finger or the thumb, proximal first."""
        names = _bone_names(finger)[:2]
        cones = [
            Cone(
                BONES.index(f"{finger}_{name}"),
                np.zeros(3),
                np.array([0.0, self.lengths[finger][place], 0.0]),
                self.radii[finger][place],
                self.radii[finger][place + 1],
            )
            for place, name in enumerate(names)
        ]
        return cones[0], cones[1], self.tip_cone(finger)

    def marker_centres(self) -> dict[str, FloatArray]:
        """Return the centroid of each painted solid in its bone frame, of the patch in the hand frame; (3,) mm."""
        centres = {}
        for finger in MARKERS[:5]:
            cone = self.tip_cone(finger)
            end = float(cone.end[0]), float(cone.end[1]), float(cone.end[2])
            centres[finger] = np.array(_painted_centroid(end, cone.start_mm, cone.end_mm, self.border(finger)))
        return {**centres, "base": self.T_hand_patch[:3, 3].copy()}

    def border(self, finger: str) -> float:
        """Return the y of the paint's border in the distal bone's frame, mm."""
        return self.lengths[finger][2] - self.painted[finger]

    def to_json(self) -> dict[str, Any]:
        """Return the hand in the form of `hand.json`."""
        names = {finger: (*_bone_names(finger)[:2], "distal_to_tip") for finger in (*FINGERS, "thumb")}
        bones = {finger: f"{finger} distal phalanx (origin DIP, y to the tip, z palmar)" for finger in FINGERS}
        return {
            "bone_lengths_mm": {
                finger: dict(zip(names[finger], _rounded(self.lengths[finger]), strict=True)) for finger in names
            },
            "mcp_in_hand_frame_mm": {finger: _rounded(self.mcp[finger]) for finger in FINGERS},
            "thumb_cmc_in_hand_frame_mm": _rounded(self.cmc),
            "thumb_base_rotation": self.thumb_base.tolist(),
            "finger_fan_deg": {finger: round(self.fan_deg[finger], 4) for finger in FINGERS},
            "hand_frame": "origin wrist, x towards the thumb (radial), y distal, z palmar",
            "painted_length_from_tip_mm": {finger: round(self.painted[finger], 3) for finger in (*FINGERS, "thumb")},
            "marker_centre_in_bone_frame_mm": {name: _rounded(c) for name, c in self.marker_centres().items()},
            "marker_bone": {**bones, "thumb": "thumb distal phalanx (origin IP)", "base": "hand frame"},
            "base_patch_mm": _rounded(self.patch),
            "finger_radii_mm": {finger: _rounded(self.radii[finger]) for finger in (*FINGERS, "thumb")},
        }


def _bone_names(finger: str) -> tuple[str, str, str]:
    return ("metacarpal", "proximal", "distal") if finger == "thumb" else ("proximal", "middle", "distal")


def bone_poses(hand: Hand, angles: FloatArray) -> FloatArray:
    """Return the pose of each bone in the hand frame by forward kinematics.

    Args:
        hand: its bones.
        angles: (N, 20) degrees, columns `ANGLES`.

    Returns:
        (N, 16, 4, 4), bones in the order of `BONES`; millimetres.
    """
    count = len(angles)
    poses = np.tile(np.eye(4), (count, len(BONES), 1, 1))
    column = {name: angles[:, place] for place, name in enumerate(ANGLES)}
    for finger in MARKERS[:5]:
        if finger == "thumb":
            first = hand.thumb_base @ _rz(-column["thumb_cmc_abd"]) @ _rx(column["thumb_cmc_flex"])
            flexions = (column["thumb_mcp_flex"], column["thumb_ip_flex"])
            origin = np.broadcast_to(hand.cmc, (count, 3))
        else:
            first = _rz(-(hand.fan_deg[finger] + column[f"{finger}_mcp_abd"])) @ _rx(column[f"{finger}_mcp_flex"])
            flexions = (column[f"{finger}_pip_flex"], column[f"{finger}_dip_flex"])
            origin = np.broadcast_to(hand.mcp[finger], (count, 3))
        rotation = first
        for place, name in enumerate(_bone_names(finger)):
            if place:
                origin = origin + rotation[..., 1] * hand.lengths[finger][place - 1]
                rotation = rotation @ _rx(flexions[place - 1])
            bone = BONES.index(f"{finger}_{name}")
            poses[:, bone, :3, :3], poses[:, bone, :3, 3] = rotation, origin
    return poses


def joint_positions(hand: Hand, poses: FloatArray) -> FloatArray:
    """Return (N, 21, 3) joints in the order of `JOINTS`, in the frame that the poses map to."""
    bone = {name: poses[:, place] for place, name in enumerate(BONES)}
    joints = [bone["hand"][:, :3, 3]]
    for finger in MARKERS[:5]:
        joints += [bone[f"{finger}_{name}"][:, :3, 3] for name in _bone_names(finger)]
        last = bone[f"{finger}_distal"]
        joints.append(last[:, :3, 3] + last[:, :3, 1] * hand.lengths[finger][2])
    return np.stack(joints, axis=1)


def marker_positions(hand: Hand, poses: FloatArray) -> FloatArray:
    """Return (N, 6, 3) marker centres in the order of `MARKERS`, in the frame that the poses map to."""
    centres = hand.marker_centres()
    bones = [BONES.index(f"{name}_distal") for name in MARKERS[:5]] + [0]
    at = [poses[:, b, :3, :3] @ centres[m] + poses[:, b, :3, 3] for m, b in zip(MARKERS, bones, strict=True)]
    return np.stack(at, axis=1)


def rotation_xyz(degrees: FloatArray) -> FloatArray:
    """Return `Rz @ Ry @ Rx` of three angles in degrees; (..., 3) to (..., 3, 3)."""
    degrees = np.asarray(degrees, float)
    a = np.radians(degrees[..., 1])
    ry = np.zeros((*a.shape, 3, 3))
    ry[..., 0, 0], ry[..., 0, 2], ry[..., 2, 0], ry[..., 2, 2], ry[..., 1, 1] = (
        np.cos(a),
        np.sin(a),
        -np.sin(a),
        np.cos(a),
        1.0,
    )
    return _rz(degrees[..., 2]) @ ry @ _rx(degrees[..., 0])


def _rx(degrees: FloatArray) -> FloatArray:
    a = np.radians(np.asarray(degrees, float))
    out = np.zeros((*a.shape, 3, 3))
    out[..., 0, 0] = 1.0
    out[..., 1, 1], out[..., 1, 2], out[..., 2, 1], out[..., 2, 2] = np.cos(a), -np.sin(a), np.sin(a), np.cos(a)
    return out


def _rz(degrees: FloatArray) -> FloatArray:
    a = np.radians(np.asarray(degrees, float))
    out = np.zeros((*a.shape, 3, 3))
    out[..., 2, 2] = 1.0
    out[..., 0, 0], out[..., 0, 1], out[..., 1, 0], out[..., 1, 1] = np.cos(a), -np.sin(a), np.sin(a), np.cos(a)
    return out


@lru_cache(maxsize=64)
def _painted_centroid(
    end: tuple[float, float, float], start_mm: float, end_mm: float, border_mm: float
) -> tuple[float, float, float]:
    """Return the centroid of the part of a fingertip beyond a border, by cells of a quarter millimetre."""
    reach = max(start_mm, end_mm) + 1.0
    x = np.arange(-reach, reach, 0.25)
    y = np.arange(border_mm, end[1] + end_mm + 0.25, 0.25) + 0.125
    z = np.arange(-reach, reach + end[2], 0.25)
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = cone_distance(grid, np.zeros(3), np.array(end), start_mm, end_mm) < 0.0
    across, along, palmar = grid[inside].mean(axis=0).tolist()
    return across, along, palmar


def cone_distance(points: FloatArray, start: FloatArray, end: FloatArray, start_mm: float, end_mm: float) -> FloatArray:
    """Return the signed distance to a tapered capsule (its radius interpolated along the axis), negative inside."""
    axis = end - start
    along = np.clip((points - start) @ axis / (axis @ axis), 0.0, 1.0)
    closest = start + along[..., None] * axis
    return np.asarray(np.linalg.norm(points - closest, axis=-1) - (start_mm + along * (end_mm - start_mm)))


def _rounded(values: ArrayLike) -> Any:
    return np.round(np.asarray(values, float), 3).tolist()
