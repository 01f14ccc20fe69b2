"""The other programs: one module each, which turns scenes into packets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from rhot_bridge.scene import Axes, Scene


class Target(Protocol):
    """The protocol of one other program; no socket, no clock."""

    @property
    def axes(self) -> Axes:
        """Axes of the scenes that it accepts."""
        ...

    @property
    def triggers(self) -> Sequence[str]:
        """Kinds of samples that trigger a frame, by priority; see `rhot_bridge.newest`."""
        ...

    def frame(self, scene: Scene, now_ns: int) -> list[bytes]:
        """Return the packets of a scene; none if there is nothing to send.

        Args:
            scene: in the target's axes; may be empty.
            now_ns: monotonic clock, for what is sent at intervals.
        """
        ...


@dataclass(frozen=True, slots=True)
class TargetKind:
    """One line of the table of targets.

    Attributes:
        summary: purpose, one line for people.
        module: its module, whose `make_output(config)` returns a `rhot_bridge.output.Output`.
        port: default port of the other program; None if it has none.
        extra: the extra of the package `rhot` that installs its libraries.
    """

    summary: str
    module: str
    port: int | None = None
    extra: str = "bridge"


TARGETS: Final[Mapping[str, TargetKind]] = {
    "vmc": TargetKind("Avatars: VSeeFace, Warudo, VNyan, VMagicMirror, Blender.", "rhot_bridge.targets.vmc", 39539),
    "vrchat": TargetKind(
        "VRChat's trackers, feet and hips but no fingers (vmt); SlimeVR's with --port 9001.",
        "rhot_bridge.targets.vrchat",
        9000,
    ),
    "vmt": TargetKind(
        "SteamVR on Windows, and so fingers in VRChat, through Virtual Motion Tracker.",
        "rhot_bridge.targets.vmt",
        39570,
    ),
    "json": TargetKind(
        "Unity, Godot, Blender, browsers, your program: JSON by WebSocket or UDP.",
        "rhot_bridge.targets.json_text",
        8765,
    ),
    "lsl": TargetKind(
        "Lab Streaming Layer: LabRecorder and others, beside EEG, gaze, forces.", "rhot_bridge.targets.lsl", extra="lsl"
    ),
    "openxr": TargetKind(
        "Native VR programs, by the OpenXR layer that `rhot openxr install` registers.", "rhot_bridge.targets.openxr"
    ),
    "ros2": TargetKind("ROS 2, by rmw_zenoh: tf, PoseArray, PoseStamped.", "rhot_bridge.targets.ros2", 7447, "ros2"),
}

_BY_NETWORK: Final = frozenset(TARGETS) - {"lsl", "openxr"}
"""All except LSL, which discovers readers by itself, and OpenXR's memory; both get every sample."""
TARGETS_OF: Final[Mapping[str, frozenset[str]]] = {
    "host": _BY_NETWORK,
    "port": _BY_NETWORK,
    "rate_hz": _BY_NETWORK,
    "axes": frozenset({"json", "lsl", "ros2"}),
    "transport": frozenset({"json"}),
    "allow_origins": frozenset({"json"}),
    "body": frozenset({"vmc"}),
    "height_m": frozenset({"vmc"}),
    "offset": frozenset({"openxr"}),
}
"""Targets of each setting that does not apply to all of them."""
