"""What the scene draws: hand, joint limits, fingertip paths, markers, objects, head, feet and legs."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import BODY_PARENTS, CHAINS, FINGERS, JOINTS, PARENTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.messages import (
    BodyPose,
    BoxShape,
    CylinderShape,
    FingerAngles,
    FootPose,
    HandPose,
    HeadPose,
    MeshShape,
    ObjectPose,
    PointSet,
    Side,
    SphereShape,
    State,
    TruePose,
)
from rhot_viewer.scene.instances import Instances, Rgb, balls, instances, rods

# A hand as balls at its joints and rods for its bones, as thick as its flesh.

BONE_COLOR: Final[dict[str, Rgb]] = {"right": (226, 184, 150), "left": (196, 176, 208)}
JOINT_COLOR: Final[dict[str, Rgb]] = {"right": (186, 128, 92), "left": (140, 112, 160)}
PREDICTED_BONE: Final[Rgb] = (150, 190, 235)
PREDICTED_JOINT: Final[Rgb] = (88, 140, 205)
GHOST: Final[Rgb] = (120, 205, 140)
GHOST_SWELL: Final = 1.18
"""The ghost is this much thicker: around a hand that is tracked well it shows as a rim of even width."""

_BONE_SHARE: Final = 0.86
"""A bone is a little thinner than its joints, so that these can be seen."""
_FINGER_OF: Final = {
    joint: finger for finger, chain in CHAINS.items() for joint in chain if not joint.endswith("_metacarpal")
}
"""The joints that move with a finger; all others belong to the palm."""
_KNUCKLES: Final = tuple(f"{finger}_proximal" for finger in FINGERS[1:])
_LINKS: Final[tuple[tuple[str, str], ...]] = (
    *((parent, joint) for joint, parent in PARENTS.items() if parent is not None and joint != "palm"),
    *pairwise(_KNUCKLES),
)
"""Every bone from its nearer to its farther joint; then the flesh between neighbouring knuckles."""
_ROW: Final = {joint: row for row, joint in enumerate(JOINTS)}
_BALLS: Final = np.array([_ROW[joint] for joint in JOINTS if joint != "palm"])
_STARTS: Final = np.array([_ROW[start] for start, _ in _LINKS])
_ENDS: Final = np.array([_ROW[end] for _, end in _LINKS])


@dataclass(frozen=True, slots=True)
class HandShape:
    """A hand to be drawn.

    Attributes:
        joints: balls.
        bones: rods.
    """

    joints: Instances
    bones: Instances


def hand_shape(pose: HandPose) -> HandShape | None:
    """Return a tracked hand, what is only predicted in another colour; None when one of the 26 joints is missing."""
    if any(name not in pose.joints for name in JOINTS):
        return None
    joints = [pose.joints[name] for name in JOINTS]
    positions = np.array([joint.position for joint in joints])
    radii = np.array([joint.radius for joint in joints])
    predicted = _predicted_rows(pose.fingers, pose.state)
    ball_colors = np.where(predicted[:, None], PREDICTED_JOINT, JOINT_COLOR[pose.side])
    rod_colors = np.where(predicted[_ENDS][:, None], PREDICTED_BONE, BONE_COLOR[pose.side])
    return _shape(positions, radii, ball_colors[_BALLS], rod_colors)


def ghost_shape(joints: Mapping[str, TruePose], radii: FloatArray) -> HandShape | None:
    """Return a true hand, swollen a little; None when one of the 26 joints is missing.

    Args:
        joints: pose by joint name, rig frame.
        radii: (26,) metres, of the flesh around each joint.
    """
    if any(name not in joints for name in JOINTS):
        return None
    positions = np.array([joints[name].position for name in JOINTS])
    return _shape(
        positions, GHOST_SWELL * radii, np.tile(GHOST, (len(_BALLS), 1)), np.tile(GHOST, (len(_ENDS), 1)), 1.0
    )


def fingertips(side: Side, pose: HandPose) -> dict[str, tuple[float, float, float]]:
    """Return the positions of a hand's tip joints by `<side> <finger>`, metres, rig frame; a missing one is absent."""
    return {
        f"{side} {finger}": pose.joints[f"{finger}_tip"].position
        for finger in FINGERS
        if f"{finger}_tip" in pose.joints
    }


def _predicted_rows(fingers: Mapping[str, State], state: State) -> NDArray[np.bool_]:
    """Tell per joint (26,) whether it is predicted; the palm follows the whole hand."""
    return np.array([fingers.get(_FINGER_OF.get(joint, ""), state) == "predicted" for joint in JOINTS])


def _shape(
    positions: FloatArray,
    radii: FloatArray,
    ball_colors: NDArray[np.int_],
    rod_colors: NDArray[np.int_],
    share: float = _BONE_SHARE,
) -> HandShape:
    # The wrist's ball alone is thinner than the flesh: as thick, it would hide the hand from whoever sits behind
    # it.
    ball_radii = radii[_BALLS] * np.where(_ROW["wrist"] == _BALLS, 0.75, 1.0)
    rod_radii = share * 0.5 * (radii[_STARTS] + radii[_ENDS])
    return HandShape(
        balls(positions[_BALLS], ball_radii, ball_colors),
        rods(positions[_STARTS], positions[_ENDS], rod_radii, rod_colors),
    )


# The paths that fingertips have left in the last moments.

_STEP_NS: Final = 50_000_000
_BREAK_NS: Final = 400_000_000
"""After a longer pause the path starts over: a straight line would show a motion nobody saw."""


class Trails:
    """Newest positions of named points, thinned to one in 50 ms."""

    def __init__(self, names: Sequence[str], seconds: float) -> None:
        """Prepare trails.

        Args:
            names: of the points; the order of the lines.
            seconds: how far back the trails reach.
        """
        self._steps = max(2, round(seconds * 1e9 / _STEP_NS))
        self._paths: dict[str, deque[tuple[float, float, float]]] = {n: deque(maxlen=self._steps + 1) for n in names}
        self._newest_ns: dict[str, int] = {}

    def add(self, t_ns: int, positions: Mapping[str, tuple[float, float, float]]) -> bool:
        """Add positions, metres, of the moment `t_ns`, but for unknown names; return whether a line has changed."""
        changed = False
        for name, position in positions.items():
            trail = self._paths.get(name)
            if trail is None:
                continue
            pause_ns = t_ns - self._newest_ns.get(name, t_ns - _STEP_NS)
            if 0 <= pause_ns < _STEP_NS:
                continue
            if pause_ns > _BREAK_NS or pause_ns < 0:
                trail.clear()
            trail.append(position)
            self._newest_ns[name] = t_ns
            changed = True
        return changed

    def clear(self, prefix: str = "") -> None:
        """Forget the trails whose names begin with `prefix`."""
        for name, trail in self._paths.items():
            if name.startswith(prefix):
                trail.clear()
                self._newest_ns.pop(name, None)

    @property
    def lines(self) -> FloatArray:
        """(names · steps, 2, 3) pieces of all trails, newest first, metres; those that are not there have no length."""
        return np.concatenate([self._line(trail) for trail in self._paths.values()])

    def _line(self, trail: deque[tuple[float, float, float]]) -> FloatArray:
        pieces = np.zeros((self._steps, 2, 3))
        if trail:
            path = np.array(trail)[::-1]
            pieces[:] = path[-1]
            pieces[: len(path) - 1, 0], pieces[: len(path) - 1, 1] = path[:-1], path[1:]
        return pieces

    def colors(self, of: Mapping[str, Rgb], background: Rgb) -> NDArray[np.uint8]:
        """Return colours (names · steps, 2, 3) that fade into the background with age."""
        age = np.linspace(0.0, 1.0, self._steps + 1)
        ends = np.stack([age[:-1], age[1:]], axis=1)[..., None]
        faded = [np.array(of[name]) * (1.0 - ends) + np.array(background) * ends for name in self._paths]
        return np.concatenate(faded).astype(np.uint8)


# How far each joint of a hand may bend, as fans of lines: what the filter and the chain solver obey.
#
# A knuckle has two fans, one for flexion and one for abduction; each hinge has one. A fan shows where the bone's end
# goes from one limit to the other while every other angle stays as it is.

STEPS: Final = 12
"""Lines of which an arc consists."""
_END_OF_ANGLE: Final = (1, 1, 2, 3)
"""Which point of a finger's chain each angle moves: flexion and abduction the first bone's end, then the hinges'."""
FANS: Final = len(FINGERS) * len(_END_OF_ANGLE)
LINES: Final = FANS * (STEPS + 2)


def limit_lines(model: HandModel, pose: HandPose) -> FloatArray | None:
    """Return the fans of a hand as lines (`LINES`, 2, 3), metres, rig frame; None where the pose tells too little.

    Args:
        model: of the person, of the pose's side.
        pose: with its wrist and the angles of all fingers.
    """
    wrist = pose.joints.get("wrist")
    if wrist is None or any(finger not in pose.angles for finger in FINGERS):
        return None
    angles = np.array([_row(pose.angles[finger]) for finger in FINGERS])
    lines = []
    for column, end in enumerate(_END_OF_ANGLE):
        sweep = np.tile(angles, (STEPS + 1, 1, 1))
        sweep[:, :, column] = np.linspace(model.angle_min[:, column], model.angle_max[:, column], STEPS + 1)
        chain = model.finger_chains(sweep)[0]
        hub, arc = chain[:, :, end - 1], chain[:, :, end]
        for finger in range(len(FINGERS)):
            own = arc[:, finger]
            lines += [(own[k], own[k + 1]) for k in range(STEPS)]
            lines += [(hub[0, finger], own[0]), (hub[-1, finger], own[-1])]
    R = rotation_from_quaternion(np.array(wrist.orientation))
    drawn: FloatArray = np.array(lines) @ R.T + np.array(wrist.position)
    return drawn


def _row(angles: FingerAngles) -> tuple[float, float, float, float]:
    return angles.mcp_flexion, angles.mcp_abduction, angles.pip_flexion, angles.dip_flexion


# Everything beside the hand as balls, rods and boxes: markers, objects, head, feet and legs.

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
