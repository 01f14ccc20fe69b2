"""Messages as the JSON texts that the page *Grasp* is sent.

A frame is `{"type": "frame", "keys": {key: …}}` with the newest of each key that has changed:

    rhot/hand/<side>    {"t", "state", "predicted": [finger, …], "joints": [26 × (x y z qx qy qz qw)], "radii": [26]}
    rhot/object/<id>    {"t", "state", "pose": [7], "shape": {…} or absent}
    rhot/head, rhot/foot/<side>    {"t", "state", "pose": [7]}
    rhot/body           {"t", "state", "joints": {name: [x, y, z]}, "predicted": [side or side_arm, …]}
    rhot/truth          {"t", "hands": {side: [26 × 7]}, "objects": {id: [7]}}
    rhot/space/<name>   {"T": [16, row by row], "source"}

Everything stands in the rig frame, metres, quaternions x, y, z, w; `t` is the moment it was true in milliseconds on
the rig clock. Joints are OpenXR's, in its order (`rhot.anatomy.skeleton.JOINTS`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from rhot.anatomy.skeleton import JOINTS
from rhot.messages import BodyPose, FootPose, HandPose, HeadPose, Message, ObjectPose, Pose, Space, Truth

_POSE: Final = "%.5f,%.5f,%.5f,%.6f,%.6f,%.6f,%.6f"
_JOINTS: Final = ",".join([_POSE] * len(JOINTS))
_RADII: Final = ",".join(["%.4f"] * len(JOINTS))
"""A hundredth of a millimetre, ten-thousandths of a degree."""


def text_of(message: Message) -> str | None:
    """Return a message as JSON; None for a hand that lacks joints, and for what the page does not show."""
    for model, write in _WRITERS.items():
        if isinstance(message, model):
            return write(message)
    return None


def _time(message: Message) -> str:
    return f'"t":{message.t_ns / 1e6:.3f}'


def _numbers(pose: Any) -> tuple[float, ...]:
    return (*pose.position, *pose.orientation)


def _all_joints(joints: Mapping[str, Pose]) -> str | None:
    try:
        return _JOINTS % tuple(number for name in JOINTS for number in _numbers(joints[name]))
    except KeyError:
        return None


def _hand(hand: HandPose) -> str | None:
    joints = _all_joints(hand.joints)
    if joints is None:
        return None
    radii = _RADII % tuple(hand.joints[name].radius for name in JOINTS)
    predicted = json.dumps([finger for finger, state in hand.fingers.items() if state == "predicted"])
    return f'{{{_time(hand)},"state":"{hand.state}","predicted":{predicted},"joints":[{joints}],"radii":[{radii}]}}'


def _object(thing: ObjectPose) -> str:
    shape = "" if thing.shape is None else f',"shape":{thing.shape.model_dump_json()}'
    return f'{{{_time(thing)},"state":"{thing.state}","pose":[{_POSE % _numbers(thing)}]{shape}}}'


def _foot(foot: FootPose) -> str:
    return f'{{{_time(foot)},"state":"{foot.state}","pose":[{_POSE % _numbers(foot)}]}}'


def _body(body: BodyPose) -> str:
    joints = {name: [round(number, 5) for number in joint.position] for name, joint in body.joints.items()}
    predicted: list[str] = [side for side, state in body.legs.items() if state == "predicted"]
    predicted += [f"{side}_arm" for side, state in body.arms.items() if state == "predicted"]
    return f'{{{_time(body)},"state":"{body.state}","joints":{_short(joints)},"predicted":{_short(predicted)}}}'


def _truth(truth: Truth) -> str:
    hands = {side: _all_joints(joints) for side, joints in truth.hands.items()}
    shown = ",".join(f'"{side}":[{joints}]' for side, joints in hands.items() if joints is not None)
    objects = ",".join(f"{json.dumps(name)}:[{_POSE % _numbers(pose)}]" for name, pose in truth.objects.items())
    return f'{{{_time(truth)},"hands":{{{shown}}},"objects":{{{objects}}}}}'


def _space(space: Space) -> str:
    return space_text(space.T_rig_space, space.source)


def space_text(T_rig_space: Sequence[Sequence[float]], source: str) -> str:
    """Return a frame and where it lies in the rig, (4, 4), as the page is sent it."""
    numbers = [round(float(number), 7) for row in T_rig_space for number in row]
    return f'{{"T":{_short(numbers)},"source":{json.dumps(source)}}}'


def _short(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))


# HeadPose is an ObjectPose, too.
_WRITERS: Final[dict[type[Message], Callable[[Any], str | None]]] = {
    HandPose: _hand,
    HeadPose: _object,
    ObjectPose: _object,
    FootPose: _foot,
    BodyPose: _body,
    Truth: _truth,
    Space: _space,
}
