"""Virtual Motion Tracker, a driver of SteamVR on Windows: trackers for objects, feet and hips, hands with fingers.

    /VMT/Room/Driver     i i f fff ffff   device, type (0 off, 1 tracker, 5 and 6 left and right controller), time
                                          offset, position, quaternion x y z w
    /VMT/Skeleton/Driver i i fff ffff     device, bone, position, quaternion, in the parent's axes
    /VMT/Skeleton/Apply  i f              device, time offset
    /VMT/Set/RoomMatrix/Temporary 12 f    3x4, row by row

OpenVR's axes, which are the stage's. VMT refuses poses until it has a room matrix; the identity is sent once a second
and applies until SteamVR ends. Devices: 0 and 1 the hands, 2 and 3 the feet, 4 the hips, 10 and up the objects in order
of appearance. VMT holds a device at its last pose until the device is switched off; this message is repeated for a
second, in case packets are lost, and sent for all devices when the bridge ends. Types are strict. Source: VMT's
documentation.
"""

from __future__ import annotations

from typing import Final

from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot.rig import BridgeConfig
from rhot_bridge.links import UdpLink
from rhot_bridge.output import PacketOutput
from rhot_bridge.retarget.openvr import BONES, openvr_bones
from rhot_bridge.scene import Axes, Scene
from rhot_bridge.targets.osc import Block, Template, bundles

PORT: Final = 39570
_ROOM_INTERVAL_NS: Final = 1_000_000_000
_OFF_REPEATED_NS: Final = 1_000_000_000
_CLOSING_REPEATS: Final = 3
"""How often each closing packet is sent, in case packets are lost; chosen."""
_OFF, _TRACKER = 0, 1
_CONTROLLER: Final[dict[Side, int]] = {"left": 5, "right": 6}
_HAND: Final[dict[Side, int]] = {"left": 0, "right": 1}
_FOOT: Final[dict[Side, int]] = {"left": 2, "right": 3}
_IDENTITY: Final = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_NOWHERE: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class VmtTarget:
    """Devices of VMT."""

    axes: Axes = "stage"
    triggers = ("hand", "object", "body", "foot", "head")

    def __init__(self) -> None:
        self._room = Template("/VMT/Set/RoomMatrix/Temporary", floats=12).pack(*_IDENTITY)
        self._room_sent_ns: int | None = None
        self._bones = {
            side: Block(
                [Template("/VMT/Skeleton/Driver", device, bone, floats=7) for bone in range(BONES)],
                7,
                Template("/VMT/Skeleton/Apply", device, floats=1).zeros,
            )
            for side, device in _HAND.items()
        }
        self._drivers: dict[tuple[int, int], Template] = {}
        self._objects: dict[str, int] = {}
        self._seen_ns: dict[int, int] = {}

    def frame(self, scene: Scene, now_ns: int) -> list[bytes]:
        """Return the packets of all devices; devices that have disappeared are switched off for a second."""
        messages: list[bytes] = []
        bones: list[bytes] = []
        if self._room_sent_ns is None or now_ns - self._room_sent_ns >= _ROOM_INTERVAL_NS:
            self._room_sent_ns = now_ns
            messages.append(self._room)
        present: set[int] = set()

        def device(number: int, mode: int, position: FloatArray, orientation: FloatArray) -> None:
            present.add(number)
            messages.append(self._driver(number, mode).pack(0.0, *position.tolist(), *orientation.tolist()))

        for side, hand in scene.hands.items():
            device(_HAND[side], _CONTROLLER[side], hand.positions[1], hand.orientations[1])
        if scene.hands:
            for side, skeleton in zip(scene.hands, openvr_bones(scene.hands), strict=True):
                bones += self._bones[side].pack(skeleton)
        for side, foot in scene.feet.items():
            device(_FOOT[side], _TRACKER, foot.positions[0], foot.orientations[0])
        if scene.body is not None and (row := scene.body.row("hips")) is not None:
            hips = 4
            device(hips, _TRACKER, scene.body.positions[row], scene.body.orientations[row])
        for name, thing in scene.objects.items():
            if (number := self._number(name, scene)) is not None:
                device(number, _TRACKER, thing.positions[0], thing.orientations[0])
        self._seen_ns |= dict.fromkeys(present, now_ns)
        self._seen_ns = {n: seen_ns for n, seen_ns in self._seen_ns.items() if now_ns - seen_ns <= _OFF_REPEATED_NS}
        messages += [self._off(number) for number in sorted(self._seen_ns.keys() - present)]
        return bundles([*messages, *bones])

    def closing_packets(self) -> list[bytes]:
        """Return packets that switch all devices off, repeated a few times."""
        packets = bundles(self._off(number) for number in sorted(self._seen_ns))
        self._seen_ns.clear()
        return packets * _CLOSING_REPEATS

    def _off(self, number: int) -> bytes:
        return self._driver(number, _OFF).pack(*_NOWHERE)

    def _number(self, name: str, scene: Scene) -> int | None:
        """Return an object's device; if none is free, that of the oldest absent object, None if all are present."""
        if name not in self._objects:
            first_object = 10
            number = first_object + len(self._objects)
            most_devices = 58
            if number >= most_devices:
                gone = next((other for other in self._objects if other not in scene.objects), None)
                if gone is None:
                    return None
                number = self._objects.pop(gone)
            self._objects[name] = number
        return self._objects[name]

    def _driver(self, number: int, mode: int) -> Template:
        found = self._drivers.get((number, mode))
        if found is None:
            found = self._drivers[number, mode] = Template("/VMT/Room/Driver", number, mode, floats=8)
        return found


def make_output(config: BridgeConfig) -> PacketOutput:
    """Return the output that a configuration asks for."""
    target = VmtTarget()
    return PacketOutput(target, UdpLink(config.host, config.port or PORT), target.closing_packets)
