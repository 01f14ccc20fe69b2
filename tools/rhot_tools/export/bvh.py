"""A skeleton's motion as BVH (Biovision Hierarchy), for Blender and other animation programs.

Lengths are centimetres. BVH programs expect Y up, as the stage has it. A motion in the rig frame is rotated by half a
turn about x,

    p_file = (x, −y, −z) · 100,

so that up in the camera's picture is +Y and the camera looks along −Z. The root (a hand's wrist, a body's hips) has
position and rotation, every other joint has rotations alone; finger tips and the balls of the feet are the end sites of
the last bones. A joint's rotation is

    R = Rz(Zrotation) · Ry(Yrotation) · Rx(Xrotation),  degrees, channels in this order,

with abduction in the middle angle and flexion in the last, so that no finger comes near the middle angle's 90°.

Format: Meredith & Maddock, "Motion Capture File Formats Explained", University of Sheffield CS-01-11, 2001, section 3.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_tools.export.skeleton_motion import SkeletonMotion

CM_PER_M: Final = 100.0
RIG_TO_FILE: Final = np.diag([1.0, -1.0, -1.0])
"""Turns rig coordinates into the file's; it is its own inverse."""
RIG_TO_FILE.setflags(write=False)
STAGE_TO_FILE: Final = np.eye(3)
STAGE_TO_FILE.setflags(write=False)
_ROTATIONS: Final = "Zrotation Yrotation Xrotation"


def bvh_text(motion: SkeletonMotion, to_file: FloatArray = RIG_TO_FILE) -> str:
    """Return the BVH file of a motion.

    Args:
        motion: in the rig frame or the stage.
        to_file: (3, 3) rotates that frame into the file's: `RIG_TO_FILE` or `STAGE_TO_FILE`.
    """
    lines = ["HIERARCHY"]
    order: list[int] = []
    _describe(motion, motion.parents.index(-1), 0, lines, order)
    local = motion.local[:, order].copy()
    local[:, 0] = to_file @ local[:, 0]
    angles_deg = euler_zyx_deg(local).reshape(len(local), -1)
    root_cm = motion.root @ to_file.T * CM_PER_M
    lines += ["MOTION", f"Frames: {len(local)}", f"Frame Time: {motion.interval_s:.9f}"]
    lines += [" ".join(f"{value:.6f}" for value in row) for row in np.hstack([root_cm, angles_deg])]
    return "\n".join(lines) + "\n"


def euler_zyx_deg(rotations: FloatArray) -> FloatArray:
    """Return angles (N, ..., 3), degrees, about z, y, x with R = Rz·Ry·Rx, of rotations (N, ..., 3, 3).

    Along the first axis, time, the first and the last angle are continuous where they can be.
    """
    R = rotations
    y = np.arcsin(np.clip(-R[..., 2, 0], -1.0, 1.0))
    z = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    x = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    # At y = ±90° only the sum or the difference of the others is defined.
    locked = np.hypot(R[..., 2, 1], R[..., 2, 2]) < 1e-9
    z = np.where(locked, 0.0, z)
    x = np.where(locked, np.arctan2(-R[..., 1, 2], R[..., 1, 1]), x)
    angles: FloatArray = np.degrees(np.stack([np.unwrap(z, axis=0), y, np.unwrap(x, axis=0)], axis=-1))
    return angles


def _describe(motion: SkeletonMotion, joint: int, depth: int, lines: list[str], order: list[int]) -> None:
    """Append the description of a joint and of all below it; `order` gets the joints that have channels."""
    indent, inner = "  " * depth, "  " * (depth + 1)
    offset_cm = motion.offsets[joint] * CM_PER_M
    children = [child for child, parent in enumerate(motion.parents) if parent == joint]
    if not children and depth > 1:
        _end_site(offset_cm, depth, lines)
        return
    order.append(joint)
    channels = f"3 {_ROTATIONS}" if depth else f"6 Xposition Yposition Zposition {_ROTATIONS}"
    lines += [f"{indent}{'JOINT' if depth else 'ROOT'} {motion.joints[joint]}", f"{indent}{{"]
    lines += [f"{inner}OFFSET {_numbers(offset_cm)}", f"{inner}CHANNELS {channels}"]
    for child in children:
        _describe(motion, child, depth + 1, lines, order)
    if not children:
        # The palm and rigid things have no child; an end site gives the bone a length to be drawn with.
        _end_site(np.array((0.0, 0.0, -2.0)), depth + 1, lines)
    lines.append(f"{indent}}}")


def _end_site(offset_cm: FloatArray, depth: int, lines: list[str]) -> None:
    indent = "  " * depth
    lines += [f"{indent}End Site", f"{indent}{{", f"{indent}  OFFSET {_numbers(offset_cm)}", f"{indent}}}"]


def _numbers(values: FloatArray) -> str:
    return " ".join(f"{value:.6f}" for value in values)
