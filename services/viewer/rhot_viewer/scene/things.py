"""Everything beside the hand as balls, rods and boxes: markers, objects, head, feet and legs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.skeleton import BODY_PARENTS
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.messages import (
    BodyPose,
    BoxShape,
    CylinderShape,
    FootPose,
    HeadPose,
    MeshShape,
    ObjectPose,
    PointSet,
    SphereShape,
)
from rhot_viewer.scene.instances import Instances, Rgb, balls, instances, rods

MARKER_RADIUS_M: Final = 0.0095
PREDICTED_SHARE: Final = 0.6
"""A predicted marker is drawn this much smaller."""
UNKNOWN_COLOR: Final[Rgb] = (150, 150, 150)
OBJECT_COLOR: Final[Rgb] = (214, 160, 60)
OBJECT_SIZE_M: Final = (0.06, 0.06, 0.06)
"""A cube stands for an object of unknown shape; its axes show how it is rotated."""
HEAD_COLOR: Final[Rgb] = (110, 118, 130)
HEADSET_SIZE_M: Final = (0.18, 0.10, 0.12)
FOOT_COLOR: Final[Rgb] = (92, 128, 172)
FOOT_SIZE_M: Final = (0.09, 0.06, 0.26)
FOOT_MIDDLE_M: Final = (0.0, -0.04, 0.03)
"""Middle of the foot's box in the frame of `FootPose`, whose origin is the marker on the instep."""
PREDICTED_COLOR: Final[Rgb] = (150, 190, 235)
LEG_COLOR: Final[Rgb] = (176, 182, 190)
LEG_RADIUS_M: Final = 0.045

_Placed = tuple[ObjectPose, tuple[float, float, float], Rgb]
"""A body, its size along its own axes, metres, and its colour."""
_ARM: Final = ("shoulder", "elbow", "wrist")


def marker_balls(points: PointSet, colors: Mapping[str, Rgb]) -> Instances:
    """Return the markers in their colours; what is only predicted is smaller."""
    names = list(points.points)
    radii = [MARKER_RADIUS_M * (1.0 if points.points[n].state == "measured" else PREDICTED_SHARE) for n in names]
    centers = np.array([points.points[name].position for name in names]).reshape(-1, 3)
    return balls(centers, np.array(radii), [colors.get(name, UNKNOWN_COLOR) for name in names])


@dataclass(frozen=True, slots=True)
class ObjectCopies:
    """Objects and the headset, to scale.

    Attributes:
        boxes, rods, balls: copies of the three unit meshes.
    """

    boxes: Instances
    rods: Instances
    balls: Instances


def object_copies(objects: Mapping[str, ObjectPose], head: HeadPose | None) -> ObjectCopies:
    """Return objects by their shapes, but those with a surface of their own, and the headset as a box."""
    boxes: list[_Placed] = []
    rods_: list[_Placed] = []
    balls_: list[_Placed] = []
    for pose in objects.values():
        match pose.shape:
            case BoxShape(size=size):
                boxes.append((pose, size, OBJECT_COLOR))
            case CylinderShape(radius=radius, height=height):
                rods_.append((pose, (radius, radius, height), OBJECT_COLOR))
            case SphereShape(radius=radius):
                balls_.append((pose, (radius, radius, radius), OBJECT_COLOR))
            case MeshShape():
                pass
            case None:
                boxes.append((pose, OBJECT_SIZE_M, OBJECT_COLOR))
    if head is not None:
        boxes.append((head, HEADSET_SIZE_M, HEAD_COLOR))
    return ObjectCopies(_copies(boxes), _copies(rods_), _copies(balls_))


def _copies(placed: Sequence[_Placed]) -> Instances:
    return instances(
        [pose.position for pose, _, _ in placed],
        np.array([_wxyz(pose.orientation) for pose, _, _ in placed]).reshape(-1, 4),
        [size for _, size, _ in placed],
        [color if pose.state == "measured" else PREDICTED_COLOR for pose, _, color in placed],
    )


def foot_boxes(feet: Mapping[str, FootPose]) -> Instances:
    """Return feet as boxes around the marker on their instep."""
    poses = list(feet.values())
    rotations = rotation_from_quaternion(np.array([pose.orientation for pose in poses]).reshape(-1, 4))
    positions = np.array([pose.position for pose in poses]).reshape(-1, 3)
    return instances(
        positions + rotations @ np.array(FOOT_MIDDLE_M),
        np.array([_wxyz(pose.orientation) for pose in poses]).reshape(-1, 4),
        np.tile(FOOT_SIZE_M, (len(poses), 1)),
        [FOOT_COLOR if pose.state == "measured" else PREDICTED_COLOR for pose in poses],
    )


def body_rods(body: BodyPose) -> tuple[Instances, Instances]:
    """Return the joints (balls) and bones (rods) of a body, as far as the message holds them."""
    limbs = {f"{side}_leg": state for side, state in body.legs.items()}
    limbs |= {f"{side}_arm": state for side, state in body.arms.items()}
    bones = [
        (parent, name, limbs.get(_limb(name)) == "predicted")
        for name, parent in BODY_PARENTS.items()
        if parent is not None and parent in body.joints and name in body.joints
    ]
    starts = np.array([body.joints[start].position for start, _, _ in bones]).reshape(-1, 3)
    ends = np.array([body.joints[end].position for _, end, _ in bones]).reshape(-1, 3)
    colors = [PREDICTED_COLOR if predicted else LEG_COLOR for _, _, predicted in bones]
    radii = np.full(len(bones), LEG_RADIUS_M)
    return balls(ends, radii, colors), rods(starts, ends, 0.8 * radii, colors)


def _limb(joint: str) -> str:
    side, _, name = joint.partition("_")
    return f"{side}_{'arm' if name in _ARM else 'leg'}"


def _wxyz(xyzw: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    x, y, z, w = xyzw
    return w, x, y, z
