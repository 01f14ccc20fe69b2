"""What moves in a recording, as arrays over time: hands, body, feet, objects and the headset."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import BODY_PARENTS, JOINTS, PARENTS, angle_name
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.messages import BodyPose, FootPose, HandPose, Message, ObjectPose, Side
from rhot.messages.base import Pose
from rhot.messages.tracked import ObjectShape
from rhot.take.take import require_few

HAND_PARENTS: Final = tuple(-1 if (parent := PARENTS[name]) is None else JOINTS.index(parent) for name in JOINTS)
"""(26,) index in `JOINTS` of each joint's parent, −1 for the wrist."""
_LIMB_RADIUS_M: Final = 0.03
"""Of a body's joints where they are drawn; their messages carry none."""


@dataclass(frozen=True, slots=True)
class ExportedMotion:
    """One thing over time: a skeleton of joints, or a rigid thing, which is a skeleton of one.

    Attributes:
        name: as in its key, such as `hand_right`, `object_cup`, `body`.
        joints: their names.
        parents: (J,) index of each joint's parent, −1 for the root.
        t_ns: (N,) int64, increasing.
        positions: (N, J, 3) metres.
        rotations: (N, J, 3, 3) joint axes as columns.
        radii_m: (J,) of what is around the joints.
        angles: by name, (N,) radians; for hands and body.
        shape: of an object where it is known.
        incomplete: poses left out because a joint is missing.
    """

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    t_ns: NDArray[np.int64]
    positions: FloatArray
    rotations: FloatArray
    radii_m: FloatArray
    angles: Mapping[str, FloatArray] = field(default_factory=dict)
    shape: ObjectShape | None = None
    incomplete: int = 0

    @property
    def root(self) -> int:
        """Index of the joint that has no parent."""
        return self.parents.index(-1)

    @property
    def is_rigid(self) -> bool:
        """Whether there is one joint alone."""
        return len(self.joints) == 1

    @property
    def is_hand(self) -> bool:
        """Whether it is a hand."""
        return self.name.startswith("hand_")

    def moved(self, T_to_from: FloatArray) -> ExportedMotion:
        """Return the motion in another frame, T_to_from (4, 4), metres."""
        R = T_to_from[:3, :3]
        return replace(self, positions=self.positions @ R.T + T_to_from[:3, 3], rotations=R @ self.rotations)


@dataclass(slots=True)
class _Collected:
    """The poses of one thing: time to (J, 8), position, quaternion and radius of each joint, and angles."""

    joints: tuple[str, ...]
    poses: dict[int, FloatArray] = field(default_factory=dict)
    angles: dict[int, dict[str, float]] = field(default_factory=dict)
    shape: ObjectShape | None = None
    incomplete: int = 0


def motions(messages: Iterable[tuple[str, Message]], *, measured: bool = False) -> dict[str, ExportedMotion]:
    """Collect everything that moves, by name; of several poses at one moment the last counts.

    Args:
        messages: of a recording, rig frame.
        measured: leave out poses that are only predicted.
    """
    found: dict[str, _Collected] = {}
    for key, message in messages:
        if not isinstance(message, HandPose | BodyPose | FootPose | ObjectPose):
            continue
        if measured and message.state != "measured":
            continue
        name = key.removeprefix("rhot/").replace("/", "_")
        joints, poses = _posed(message)
        kept = found.setdefault(
            f"{name}:{'+'.join(joints)}" if isinstance(message, BodyPose) else name, _Collected(joints)
        )
        if not all(joint in poses for joint in joints):
            kept.incomplete += 1
            continue
        rows = [(*poses[joint].position, *poses[joint].orientation, _radius(poses[joint])) for joint in joints]
        kept.poses[message.t_ns] = np.array(rows, np.float64)
        kept.angles[message.t_ns] = _angles(message)
        if isinstance(message, ObjectPose) and message.shape is not None:
            kept.shape = message.shape
    return {name: _motion(name, kept) for name, kept in _with_one_body(found).items() if kept.poses}


def hand_motion(messages: Iterable[tuple[str, Message]], side: Side | None) -> ExportedMotion:
    """Collect the complete poses of one hand, by time.

    Args:
        messages: of a recording.
        side: whose hand; None = the only one there is.

    Raises:
        ConfigError: no such hand, or both hands and no choice.
    """
    wanted = ("hand_left", "hand_right") if side is None else (f"hand_{side}",)
    hands = [(key, message) for key, message in messages if isinstance(message, HandPose)]
    found = {name: motion for name, motion in motions(hands).items() if name in wanted}
    if not found:
        which = "hand" if side is None else f"{side} hand"
        incomplete = sum(1 for _, message in hands if side in (None, message.side))
        raise ConfigError(f"the recording holds no complete pose of a {which} ({incomplete} lack joints)")
    if len(found) > 1:
        raise ConfigError("the recording holds both hands; choose one with --hand left or --hand right")
    return next(iter(found.values()))


def frame_times_s(end_s: float, rate_hz: float) -> FloatArray:
    """Return the times (F,) of frames at a steady rate from 0 to an end, seconds.

    Raises:
        ConfigError: there would be more than a file is made of, as where one pose has a time of another year.
    """
    # Share of a frame by which the last one may lie behind the last pose: times are rounded to nanoseconds, which
    # adds up to 0.007 frames in an hour at 60 Hz.
    count = int(end_s * rate_hz + 0.01) + 1
    require_few(count, end_s, rate_hz)
    times: FloatArray = np.minimum(np.arange(count) / rate_hz, end_s)
    return times


def _posed(message: HandPose | BodyPose | FootPose | ObjectPose) -> tuple[tuple[str, ...], Mapping[str, Pose]]:
    """Return the joints that a complete message has, and those that this one has."""
    if isinstance(message, HandPose):
        return JOINTS, message.joints
    if isinstance(message, BodyPose):
        # Joints are known by whole limbs; one whose parent is missing hangs nowhere.
        known = [name for name in BODY_PARENTS if name in message.joints]
        whole = [name for name in known if all(ancestor in message.joints for ancestor in _ancestors(name))]
        return tuple(whole or ["hips"]), message.joints
    return ("origin",), {"origin": Pose(position=message.position, orientation=message.orientation)}


def _radius(pose: Pose) -> float:
    return float(getattr(pose, "radius", _LIMB_RADIUS_M))


def _angles(message: HandPose | BodyPose | FootPose | ObjectPose) -> dict[str, float]:
    if not isinstance(message, HandPose | BodyPose):
        return {}
    return {angle_name(part, name): value for part, angles in message.angles.items() for name, value in angles}


def _with_one_body(found: Mapping[str, _Collected]) -> dict[str, _Collected]:
    """Keep of each body the joints that most of its poses have; the other poses count as incomplete.

    Of several sets of joints the one with most joints counted over all poses that have them, so that an arm that is
    tracked now and then is left out, and one that is hardly ever missing is not.
    """
    kept = {name: each for name, each in found.items() if ":" not in name}
    bodies: dict[str, list[_Collected]] = {}
    for name, each in found.items():
        if ":" in name:
            bodies.setdefault(name.partition(":")[0], []).append(each)
    for name, variants in bodies.items():
        counts = [sum(len(more.poses) for more in _with(each, variants)) * len(each.joints) for each in variants]
        chosen = variants[counts.index(max(counts))]
        whole = _Collected(chosen.joints, incomplete=chosen.incomplete)
        for more in variants:
            if more not in _with(chosen, variants):
                whole.incomplete += len(more.poses)
                continue
            rows = [more.joints.index(joint) for joint in chosen.joints]
            whole.poses |= {t_ns: poses[rows] for t_ns, poses in more.poses.items()}
            whole.angles |= more.angles
        kept[name] = whole
    return kept


def _with(wanted: _Collected, variants: Sequence[_Collected]) -> list[_Collected]:
    """Return the variants that have all joints of one."""
    return [each for each in variants if set(wanted.joints) <= set(each.joints)]


def _ancestors(name: str) -> list[str]:
    parent = BODY_PARENTS[name]
    return [] if parent is None else [parent, *_ancestors(parent)]


def _motion(name: str, kept: _Collected) -> ExportedMotion:
    t_ns = np.array(sorted(kept.poses), dtype=np.int64)
    stacked = np.stack([kept.poses[moment] for moment in t_ns.tolist()])
    angles = [kept.angles[moment] for moment in t_ns.tolist()]
    names = sorted({each for row in angles for each in row})
    return ExportedMotion(
        name=name,
        joints=kept.joints,
        parents=_parents(kept.joints),
        t_ns=t_ns,
        positions=stacked[..., :3],
        rotations=rotation_from_quaternion(stacked[..., 3:7]),
        radii_m=np.median(stacked[..., 7], axis=0),
        angles={each: np.array([row.get(each, np.nan) for row in angles]) for each in names},
        shape=kept.shape,
        incomplete=kept.incomplete,
    )


def _parents(joints: Sequence[str]) -> tuple[int, ...]:
    if tuple(joints) == JOINTS:
        return HAND_PARENTS
    if len(joints) == 1:
        return (-1,)
    parents = [BODY_PARENTS[name] for name in joints]
    return tuple(-1 if parent is None else joints.index(parent) for parent in parents)
