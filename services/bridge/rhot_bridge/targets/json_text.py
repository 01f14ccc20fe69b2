"""JSON for your own programs: one message per frame, by WebSocket or UDP.

    {"version": 1, "t": seconds since 1970 on the rig clock, "axes": "stage" | "unity" | "rig",
     "hands":   [{"side": "left" | "right", "state": …, "weight": 0…1,
                  "positions": [78 numbers], "orientations": [104 numbers], "radii": [26 numbers]}],
     "objects": [{"id": …, "state": …, "weight": …, "position": [3], "orientation": [4], "shape": {…}}],
     "head":    {"state": …, "weight": …, "position": [3], "orientation": [4]},
     "feet":    [{"side": …, "state": …, "weight": …, "position": [3], "orientation": [4]}],
     "body":    {"state": …, "weight": …, "joints": [{"name": "hips", "position": [3], "orientation": [4]}]}}

Metres; quaternions x, y, z, w. Joints are the 26 of OpenXR's XR_EXT_hand_tracking in its order, x y z of the first,
then of the second, …. `state` is `measured`, `predicted` or `kept` (no longer tracked); `weight` falls from 1 to 0
during a fade. `shape` is `{"kind": "box", "size": [3]}`, `{"kind": "cylinder", "radius", "height"}`,
`{"kind": "sphere", "radius"}`, `{"kind": "mesh", "file", "size": [3]}`, or absent. Unknown poses are absent (`head`,
`body`) or missing from their list.
"""

from __future__ import annotations

import itertools
import json
from typing import Final

from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot.messages import ObjectShape
from rhot.rig import BridgeConfig
from rhot_bridge.links import UdpLink, WebSocketLink
from rhot_bridge.output import PacketOutput
from rhot_bridge.scene import Axes, BridgedHand, Poses, Scene, Thing

VERSION: Final = 1
WEBSOCKET_PORT: Final = 8765
UDP_PORT: Final = 8766
"""Chosen: no other program uses this format."""
_HAND_FORMAT: Final = (
    f'"positions":[{",".join(["%.5f"] * 3 * len(JOINTS))}],'
    f'"orientations":[{",".join(["%.5f"] * 4 * len(JOINTS))}],'
    f'"radii":[{",".join(["%.4f"] * len(JOINTS))}]'
)
"""Resolution 0.01 mm and 0.001°, so that both hands take 4 kB."""
_POSE_FORMAT: Final = '"position":[%.5f,%.5f,%.5f],"orientation":[%.5f,%.5f,%.5f,%.5f]'


class JsonTarget:
    """Frames as JSON; see the module for the format."""

    triggers = ("hand", "body", "foot", "object", "head")

    def __init__(self, axes: Axes) -> None:
        self.axes: Axes = axes

    def frame(self, scene: Scene, now_ns: int) -> list[bytes]:
        """Return one message, even for an empty scene, so that readers see that the rig runs."""
        hands = ",".join(f'{{"side":"{side}",{_hand(hand)}}}' for side, hand in scene.hands.items())
        objects = ",".join(
            f'{{"id":{json.dumps(name)},{_thing(thing)}{_shape(thing.shape)}}}' for name, thing in scene.objects.items()
        )
        feet = ",".join(f'{{"side":"{side}",{_thing(thing)}}}' for side, thing in scene.feet.items())
        parts = [
            f'"version":{VERSION},"t":{scene.t_ns / 1e9:.6f},"axes":"{scene.axes}"',
            f'"hands":[{hands}],"objects":[{objects}],"feet":[{feet}]',
        ]
        if scene.head is not None:
            parts.append(f'"head":{{{_thing(scene.head)}}}')
        if (body := scene.body) is not None:
            joints = ",".join(
                f'{{"name":{json.dumps(name)},{_POSE_FORMAT % _numbers(position, orientation)}}}'
                for name, position, orientation in zip(body.names, body.positions, body.orientations, strict=True)
            )
            parts.append(f'"body":{{{_state(body)},"joints":[{joints}]}}')
        return [f"{{{','.join(parts)}}}".encode()]


def make_output(config: BridgeConfig) -> PacketOutput:
    """Return the output that a configuration asks for."""
    target = JsonTarget(config.axes)
    if config.transport == "udp":
        return PacketOutput(target, UdpLink(config.host, config.port or UDP_PORT))
    return PacketOutput(target, WebSocketLink(config.host, config.port or WEBSOCKET_PORT, config.allow_origins))


def _numbers(*arrays: FloatArray) -> tuple[float, ...]:
    return tuple(itertools.chain.from_iterable(array.ravel().tolist() for array in arrays))


def _state(poses: Poses) -> str:
    return f'"state":"{poses.state}","weight":{poses.weight:.3f}'


def _hand(hand: BridgedHand) -> str:
    return f"{_state(hand)},{_HAND_FORMAT % _numbers(hand.positions, hand.orientations, hand.radii)}"


def _thing(thing: Thing) -> str:
    return f"{_state(thing)},{_POSE_FORMAT % _numbers(thing.positions, thing.orientations)}"


def _shape(shape: ObjectShape | None) -> str:
    # Without the planes of a mesh, which would have to be mirrored in a left-handed frame.
    return "" if shape is None else f',"shape":{shape.model_dump_json(exclude={"planes"})}'
