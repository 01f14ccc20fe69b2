"""VMC protocol: avatars in VSeeFace, Warudo, VNyan, VMagicMirror, Blender.

    /VMC/Ext/OK i                     1: the rig runs
    /VMC/Ext/T f                      seconds since the bridge started
    /VMC/Ext/Root/Pos s fff ffff      root, at the origin
    /VMC/Ext/Bone/Pos s fff ffff      bone (Unity's HumanBodyBones), position, quaternion x y z w, in the parent's axes
    /VMC/Ext/Tra/Pos s fff ffff       an object by its id, in the world's axes

Unity's axes; bones as in `rhot_bridge.retarget`. With `fingers` only finger bones are sent, for programs that get arms
and head from another source; with `arms` also arms, head, spine, hips and legs as far as they are known. A frame
consists of several bundles, each smaller than an Ethernet frame. An absent hand is not sent, so that the avatar keeps
its own. Source: the VMC protocol's specification, protocol.vmc.info.
"""

from __future__ import annotations

from typing import Final, Literal

from rhot.geometry.rotations import quaternion_from_rotation
from rhot.messages import Side
from rhot.rig import BridgeConfig
from rhot_bridge.links import UdpLink
from rhot_bridge.output import PacketOutput
from rhot_bridge.retarget.arms import body_bones
from rhot_bridge.retarget.vrm import FINGER_BONES, faded, finger_bones
from rhot_bridge.scene import Axes, Scene
from rhot_bridge.targets.osc import Block, Template, bundles

PORT: Final = 39539
"""Default port of programs that show an avatar (marionettes); performers listen on 39540."""
_SIDES: Final[tuple[Side, Side]] = ("left", "right")
_ARMS: Final = {
    side: tuple(f"{side.capitalize()}{name}" for name in ("UpperArm", "LowerArm", "Hand")) for side in _SIDES
}


class VmcTarget:
    """Bones of a VRM avatar."""

    axes: Axes = "unity"
    triggers = ("hand", "body", "head", "foot", "object")

    def __init__(self, body: Literal["fingers", "arms"] = "fingers", height_m: float = 1.70) -> None:
        self._body = body
        self._height_m = height_m
        self._started_ns: int | None = None
        self._ok = Template("/VMC/Ext/OK", 1, floats=0).pack()
        self._time = Template("/VMC/Ext/T", floats=1)
        root = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        self._root = Template("/VMC/Ext/Root/Pos", "root", floats=7).pack(*root)
        self._fingers = {side: Block([_bone(side.capitalize() + name) for name in FINGER_BONES], 7) for side in _SIDES}
        self._bones: dict[str, Template] = {}
        self._trackers: dict[str, Template] = {}

    def frame(self, scene: Scene, now_ns: int) -> list[bytes]:
        """Return the known bones and objects; for an empty scene only the status messages."""
        if self._started_ns is None:
            self._started_ns = now_ns
        messages = [self._ok, self._time.pack((now_ns - self._started_ns) / 1e9)]
        if self._body == "arms":
            messages.append(self._root)
            for bone in body_bones(scene, self._height_m):
                rotation = quaternion_from_rotation(bone.rotation)
                for side in _SIDES:
                    if bone.name in _ARMS[side]:
                        rotation = faded(rotation, scene.hands[side].weight)
                if bone.name not in self._bones:
                    self._bones[bone.name] = _bone(bone.name)
                messages.append(self._bones[bone.name].pack(*bone.position.tolist(), *rotation.tolist()))
        # Rebuilt in each frame, so that templates of absent objects are discarded.
        self._trackers = {
            identity: self._trackers.get(identity) or Template("/VMC/Ext/Tra/Pos", identity, floats=7)
            for identity in scene.objects
        }
        for identity, thing in scene.objects.items():
            pose = (*thing.positions[0].tolist(), *thing.orientations[0].tolist())
            messages.append(self._trackers[identity].pack(*pose))
        if scene.hands:
            for side, bones in zip(scene.hands, finger_bones(scene.hands), strict=True):
                messages += self._fingers[side].pack(bones)
        return bundles(messages)


def _bone(name: str) -> Template:
    return Template("/VMC/Ext/Bone/Pos", name, floats=7)


def make_output(config: BridgeConfig) -> PacketOutput:
    """Return the output that a configuration asks for."""
    return PacketOutput(VmcTarget(config.body, config.height_m), UdpLink(config.host, config.port or PORT))
