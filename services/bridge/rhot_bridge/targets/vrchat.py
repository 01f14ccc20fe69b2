"""VRChat's OSC trackers, which SlimeVR's server also accepts (port 9001).

    /tracking/trackers/{1…8}/position fff    metres, Unity's axes (x right, y up, z forward)
    /tracking/trackers/{1…8}/rotation fff    degrees about x, y, z, applied z, then x, then y
    /tracking/trackers/head/position  fff
    /tracking/trackers/head/rotation  fff

Tracker 1 is the hip, 2 and 3 the left and right foot, 4 and 5 the knees. VRChat translates all trackers so that the
head's position coincides with the player's head, so it is sent with every frame. The head's rotation rotates all
trackers, so it is sent only for a second after the head appears. Source: VRChat's documentation, "OSC Trackers".
"""

from __future__ import annotations

from typing import Final

from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot.rig import BridgeConfig
from rhot_bridge.axes import unity_euler_deg
from rhot_bridge.links import UdpLink
from rhot_bridge.output import PacketOutput
from rhot_bridge.scene import Axes, Scene, Thing
from rhot_bridge.targets.osc import Template, bundles

PORT: Final = 9000
_HEAD_TURN_NS: Final = 1_000_000_000
"""Duration for which the head's rotation is sent after the head appears; covers lost packets."""
_BODY: Final = {"1": "hips", "2": "left_ankle", "3": "right_ankle", "4": "left_knee", "5": "right_knee"}
_FEET: Final[dict[str, Side]] = {"2": "left", "3": "right"}


class VrChatTarget:
    """Hip, feet, knees and head as trackers."""

    axes: Axes = "unity"
    triggers = ("body", "foot", "head", "object", "hand")

    def __init__(self) -> None:
        names = (*_BODY, "head")
        self._position = {name: Template(f"/tracking/trackers/{name}/position", floats=3) for name in names}
        self._rotation = {name: Template(f"/tracking/trackers/{name}/rotation", floats=3) for name in names}
        self._head_since_ns: int | None = None

    def frame(self, scene: Scene, now_ns: int) -> list[bytes]:
        """Return the known trackers; a tracked foot takes precedence over the solved body's."""
        messages: list[bytes] = []
        for name, joint in _BODY.items():
            foot = scene.feet.get(_FEET[name]) if name in _FEET else None
            body = scene.body
            row = None if body is None else body.row(joint)
            if foot is not None:
                messages += self._tracker(name, foot.positions[0], foot.orientations[0])
            elif body is not None and row is not None:
                messages += self._tracker(name, body.positions[row], body.orientations[row])
        messages += self._head(scene.head, now_ns)
        return bundles(messages)

    def _head(self, head: Thing | None, now_ns: int) -> list[bytes]:
        if head is None:
            self._head_since_ns = None
            return []
        if self._head_since_ns is None:
            self._head_since_ns = now_ns
        both = self._tracker("head", head.positions[0], head.orientations[0])
        return both if now_ns - self._head_since_ns < _HEAD_TURN_NS else both[:1]

    def _tracker(self, name: str, position: FloatArray, orientation: FloatArray) -> list[bytes]:
        return [
            self._position[name].pack(*position.tolist()),
            self._rotation[name].pack(*unity_euler_deg(orientation)),
        ]


def make_output(config: BridgeConfig) -> PacketOutput:
    """Return the output that a configuration asks for."""
    return PacketOutput(VrChatTarget(), UdpLink(config.host, config.port or PORT))
