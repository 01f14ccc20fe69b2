"""The hand: from a wrist pose and joint angles to the 26 joints of OpenXR, and to the markers painted on them.

Frames. The wrist frame has OpenXR's axes: −Z towards the fingers, +Y out of the back of the hand, +X to the right
when the palm faces down (so the thumb of a right hand lies at −X, of a left hand at +X). The metacarpals are fixed in
it; it is also called the palm frame. Each finger f bends in a plane that holds its own Y axis:

    R_wrist_k = F_f · Ry(±abduction) · Rx(−(flexion_1 + … + flexion_k)),   k = 1, 2, 3
    joint_{k+1} = joint_k − bone_k · (Z axis of R_wrist_k)

with F_f the finger's rest frame, + for a right and − for a left hand. Flexion is positive towards the palm, abduction
towards the thumb's side (for the thumb itself: away from the palm). All angles zero is the flat open hand. The thumb
is the same chain on its saddle joint: its frame is rotated by about 90° so that its nail faces sideways, its three
bones are metacarpal, proximal and distal, and its four angles are carpometacarpal flexion and abduction,
metacarpophalangeal flexion and interphalangeal flexion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.hand_proportions import HandMeasures, RestGeometry, rest_geometry
from rhot.anatomy.markers import PaintedMarker
from rhot.anatomy.skeleton import CHAINS, FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.types import Side, Vector3

CAP_SHARE: Final = 0.75
"""A painted fingertip is painted over this share of its last segment, from the very tip. People stop between the root
of the nail (about half of it) and the crease at the last joint (all of it, as on the 2018 rig, whose paint is 1.6 to
1.9 times as long as wide in the photo of the flat hand)."""
CAP_LENGTH_M: Final = 0.017
"""What that is on the long fingers of an average hand, where nothing more is known of it."""
PATCH_FORWARD_M: Final = 0.025
"""The patch on the back of the hand is centred this far in front of the wrist joint."""

PALM: Final = JOINTS.index("palm")
WRIST: Final = JOINTS.index("wrist")
MOVING: Final = np.array([[JOINTS.index(joint) for joint in CHAINS[finger][-4:]] for finger in FINGERS])
"""(5, 4) index in `JOINTS` of each finger's two-axis joint, two hinges and tip."""
METACARPALS: Final = np.array([JOINTS.index(CHAINS[finger][0]) for finger in FINGERS])
"""(5,) index in `JOINTS` of each finger's first joint."""
MOVING.setflags(write=False)
METACARPALS.setflags(write=False)


@dataclass(frozen=True, slots=True)
class HandJoints:
    """Joints of one hand or of many.

    Attributes:
        positions: (..., 26, 3) metres, in the order of `rhot.anatomy.skeleton.JOINTS`.
        rotations: (..., 26, 3, 3) axes of each joint as columns, OpenXR's axes.
    """

    positions: FloatArray
    rotations: FloatArray

    def position(self, joint: str) -> FloatArray:
        """Return the position (..., 3) of a joint by its OpenXR name, metres."""
        found: FloatArray = self.positions[..., JOINTS.index(joint), :]
        return found

    def rotation(self, joint: str) -> FloatArray:
        """Return the axes (..., 3, 3) of a joint by its OpenXR name."""
        found: FloatArray = self.rotations[..., JOINTS.index(joint), :, :]
        return found


@dataclass(frozen=True, slots=True)
class HandModel(RestGeometry):
    """One person's hand of one side; see the module for frames and angles. Its arrays are read-only.

    Attributes:
        side: left or right.
        length_m: from the wrist crease to the tip of the middle finger.
        marker_offsets_m: marker name to measured offset from its joint, metres, in the joint's frame.
    """

    side: Side
    length_m: float
    marker_offsets_m: Mapping[str, Vector3]

    @classmethod
    def from_file(cls, hand: HandMeasures, side: Side) -> HandModel:
        """Build the model from `hand.json`; what it leaves out follows from the hand's length.

        A left hand is a right one mirrored at x = 0.

        Raises:
            CalibrationError: width and bones contradict one another.
        """
        rest = rest_geometry(hand)
        mirror = np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])
        # A rotation R mirrors to M·R·M, which keeps it a rotation.
        mirror_axes = mirror[:, None] * mirror[None, :]
        arrays = {
            "metacarpals": rest.metacarpals * mirror,
            "knuckles": rest.knuckles * mirror,
            "frames": rest.frames * mirror_axes,
            "metacarpal_frames": rest.metacarpal_frames * mirror_axes,
            "bones": rest.bones.copy(),
            "palm": rest.palm * mirror,
            "radii": rest.radii.copy(),
            "angle_min": rest.angle_min.copy(),
            "angle_max": rest.angle_max.copy(),
            "coupling": rest.coupling.copy(),
        }
        for array in arrays.values():
            array.setflags(write=False)
        return cls(side=side, length_m=hand.length_m, marker_offsets_m=dict(hand.marker_offsets_m), **arrays)

    @property
    def handedness(self) -> float:
        """+1 for a right hand, −1 for a left one: the sign that abduction takes about a finger's Y axis."""
        return 1.0 if self.side == "right" else -1.0

    @property
    def cap_lengths(self) -> FloatArray:
        """(5,) metres: how much of each fingertip is painted, from the very tip."""
        lengths: FloatArray = CAP_SHARE * (self.bones[:, 2] + self.radii[MOVING[:, 3]])
        return lengths

    def clamp(self, angles: FloatArray) -> FloatArray:
        """Return angles (..., 5, 4), radians, brought inside the limits."""
        return np.clip(angles, self.angle_min, self.angle_max)

    def forward(self, T_rig_wrist: FloatArray, angles: FloatArray) -> HandJoints:
        """Return all joints in the rig frame.

        Args:
            T_rig_wrist: (..., 4, 4) pose of the wrist joint, metres.
            angles: (..., 5, 4) radians, columns as in the module's text; not clamped. The leading dimensions of
                both broadcast.
        """
        local = self.forward_local(angles)
        T = np.asarray(T_rig_wrist, dtype=np.float64)
        R = T[..., :3, :3]
        if T.ndim == 2:
            # One wrist for all: two plain matrix products instead of 26 small ones each.
            positions = local.positions @ R.T + T[:3, 3]
            rotations = R @ local.rotations
        else:
            positions = local.positions @ np.swapaxes(R, -1, -2) + T[..., None, :3, 3]
            rotations = R[..., None, :, :] @ local.rotations
        return HandJoints(positions, rotations)

    def forward_local(self, angles: FloatArray) -> HandJoints:
        """Return all joints in the wrist frame of angles (..., 5, 4), radians."""
        chain, axes = self.finger_chains(angles)
        lead = chain.shape[:-3]
        positions = np.empty((*lead, len(JOINTS), 3))
        rotations = np.empty((*lead, len(JOINTS), 3, 3))
        positions[..., PALM, :] = self.palm
        positions[..., WRIST, :] = 0.0
        rotations[..., PALM, :, :] = rotations[..., WRIST, :, :] = np.eye(3)
        positions[..., METACARPALS, :] = self.metacarpals
        rotations[..., METACARPALS, :, :] = self.metacarpal_frames
        # The thumb's first joint moves, so this comes after the metacarpals.
        positions[..., MOVING, :] = chain
        rotations[..., MOVING, :, :] = axes[..., (0, 1, 2, 2), :, :]
        return HandJoints(positions, rotations)

    def finger_chains(self, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the moving part of the five fingers alone, in the wrist frame.

        Args:
            angles: (..., 5, 4) radians.

        Returns:
            Joints (..., 5, 4, 3), metres: knuckle, two hinges, tip; and axes (..., 5, 3, 3, 3) of the three bones.
        """
        abduction = self.handedness * angles[..., 1]
        cos_a, sin_a = np.cos(abduction)[..., None], np.sin(abduction)[..., None]
        X, Y, Z = self.frames[..., 0], self.frames[..., 1], self.frames[..., 2]
        side_axis = cos_a * X - sin_a * Z
        back_axis = sin_a * X + cos_a * Z
        bend = np.cumsum(angles[..., (0, 2, 3)], axis=-1)[..., None]
        cos_b, sin_b = np.cos(bend), np.sin(bend)
        axes = np.empty((*angles.shape[:-1], 3, 3, 3))
        axes[..., 0] = side_axis[..., None, :]
        axes[..., 1] = cos_b * Y[:, None, :] - sin_b * back_axis[..., None, :]
        axes[..., 2] = sin_b * Y[:, None, :] + cos_b * back_axis[..., None, :]
        chain = np.empty((*angles.shape[:-1], 4, 3))
        chain[..., 0, :] = self.knuckles
        chain[..., 1:, :] = self.knuckles[:, None, :] - np.cumsum(self.bones[..., None] * axes[..., 2], axis=-2)
        return chain, axes

    def marker_offset(self, name: str, marker: PaintedMarker) -> FloatArray:
        """Return where a marker's painted centre lies in its joint's frame, (3,), metres.

        A cap covers `CAP_SHARE` of the last segment, taken as a cylinder with a half ball at its end whose centre is
        the tip joint; the centre is that of the painted volume, about 10 mm behind the very tip. A patch lies on the
        skin of the back: above the palm joint when it marks the palm, above the middle metacarpal, 25 mm in front of
        the wrist joint, when it marks the wrist. An offset measured in `hand.json` replaces either.
        """
        if name in self.marker_offsets_m:
            return np.array(self.marker_offsets_m[name], dtype=np.float64)
        radius = float(self.radii[JOINTS.index(marker.joint)])
        if marker.kind == "patch":
            if marker.joint == "wrist":
                scale = PATCH_FORWARD_M / float(np.linalg.norm(self.knuckles[2]))
                forward: FloatArray = self.knuckles[2] * scale
                forward[1] = self.metacarpals[2, 1] + float(self.radii[PALM])
                return forward
            return np.array([0.0, radius, 0.0])
        if not marker.joint.endswith("_tip"):
            return np.zeros(3)
        finger = int(np.flatnonzero(JOINTS.index(marker.joint) == MOVING[:, 3])[0])
        straight = max(float(self.cap_lengths[finger]) - radius, 0.0)
        ball, cylinder = 2.0 / 3.0 * radius, straight
        # First moments of half ball (centroid 3/8 r in front of the tip joint) and cylinder (half its length behind).
        behind = (cylinder * straight / 2.0 - ball * 3.0 / 8.0 * radius) / (ball + cylinder)
        return np.array([0.0, 0.0, behind])

    def marker_positions(self, joints: HandJoints, markers: Mapping[str, PaintedMarker]) -> dict[str, FloatArray]:
        """Return the centre (..., 3), metres, of each marker that this hand wears; see `marker_offset`."""
        return {
            name: joints.position(marker.joint) + joints.rotation(marker.joint) @ self.marker_offset(name, marker)
            for name, marker in markers.items()
            if marker.hand == self.side
        }

    def patch_corners(self, joints: HandJoints, marker: PaintedMarker, name: str = "base") -> FloatArray:
        """Return the corners (..., 4, 3), metres, of a patch: front left, front right, back right, back left.

        Front is towards the fingers, left and right are −X and +X of its joint; the size is `marker.size_m`, across
        and along the hand.
        """
        outline = patch_outline(marker) + self.marker_offset(name, marker)
        R = joints.rotation(marker.joint)
        corners: FloatArray = outline @ np.swapaxes(R, -1, -2) + joints.position(marker.joint)[..., None, :]
        return corners


def patch_outline(marker: PaintedMarker) -> FloatArray:
    """Return the corners (4, 3) of a patch about its centre, metres, in its joint's frame; order of `patch_corners`."""
    across, along = marker.size_m or (0.0, 0.0)
    signs = np.array([[-1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]])
    outline: FloatArray = signs * np.array([across / 2.0, 0.0, along / 2.0])
    return outline
