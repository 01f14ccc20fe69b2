"""The `rig.toml` that `rhot init` writes: for people, so every line that may need a change says what it means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import tomlkit

from rhot.messages import Side
from rhot.text import printable

_HEAD: Final = """\
# RHOT rig. Lengths in metres, times in seconds, angles in degrees where the name says so.
# Check it with: rhot doctor --rig {folder}
version = 1
name = {name}
# Installed as services (docs/deploy.md): track as soon as they run, also after a power cut, without `rhot start`.
autostart = false

[bus]
# Every service connects to one Zenoh router; `rhot up` runs it on the PC. On the Pis the PC's address stands here.
mode = "client"
connect = [{connect}]
# The router opens this port; 127.0.0.1 lets only this machine in. `rhot keys make --address ADDRESS` lets the Pis in,
# with certificates. Without them, 0.0.0.0 lets everybody on the network read, stop and change the rig.
listen = [{listen}]
# Who connects needs a certificate of the folder keys; `rhot keys` makes them and switches this on.
tls = false
# Several rigs on one network: give each its own namespace, such as "desk1".
namespace = ""
# Let Zenoh look for others by multicast; not needed with `connect`.
multicast = false

[hand]
# From the wrist crease to the tip of the middle finger, straightened; used until hand.json holds a calibration.
length_m = {length_m}
"""

_CAMERA: Final = """
[cameras.{name}]
# picamera2 (a Pi's own), v4l2 (USB), webcam (USB on Windows, macOS), images (a folder), video (a file) or simulated.
source = "{source}"
{device}
width = {width}
height = {height}
rate_hz = {rate_hz:g}
# Locked, never automatic: a short exposure keeps fast fingers sharp; then as much light as you can get, then gain.
exposure_s = {exposure_s:g}
gain = 4.0
# Red and blue gain.
white_balance = [1.6, 1.6]
# Of the picture, where the camera can set them; 1, 1 and 0 leave it alone.
saturation = 1.0
contrast = 1.0
brightness = 0.0
# Time from the first to the last row (rolling shutter); camera v2 at 640x480: about 0.012.
readout_s = {readout_s:g}
# Used until cameras.json holds a calibration: horizontal field of view, and where the camera stands. The cameras look
# along +z, x points right and y down in the picture; the first camera is the origin.
fov_deg = 62.2
position_m = [{x:g}, 0.0, 0.0]
{controls}"""

_ANY_DEVICE: Final = """\
# Which one, where a machine has several: 0, 1, … of a Pi; of USB cameras the name that stays after unplugging, as
# `ls /dev/v4l/by-id` lists it: "/dev/v4l/by-id/usb-…-video-index0".
# device = 0"""

_FOUND_DEVICE: Final = """\
# {label}. {locks}
device = {device}"""

_CONTROLS: Final = """
# Where this camera's automatic settings came to rest, in its driver's units (v4l2-ctl --list-ctrls).
[cameras.{name}.v4l2_controls]
{values}
"""

_MARKERS: Final = """
# What is painted. `joint` is OpenXR's name; `patch` is a flat rectangle of known size (across the hand, along it).
"""

_TIP: Final = """[markers.{name}]
hand = "{side}"
joint = "{finger}_tip"
{paint}
"""

_SHARED: Final = """\
# Twelve paints are too many to tell apart: the second hand wears the first one's, each on another finger, so that those
# that touch differ. `paint_of` names the marker with the same paint; the patches differ and tell the hands apart.
"""

_BASE: Final = """[markers.{name}]
hand = "{side}"
joint = "wrist"
kind = "patch"
size_m = [0.04, 0.03]

"""

_TAIL: Final = """\
[fusion]
# Each view at its own time through the lens models, and the shape of painted fingertips.
method = "filter"
# Where a marker can be: lowest and highest x, y, z in the frame of the first camera.
volume_m = [[-0.8, -0.6, 0.3], [0.8, 0.6, 1.4]]
"""

_OBJECTS: Final = """
# Objects with a Vive tracker; the serial number stands on the tracker and in SteamVR.
# [objects.mug]
# source = "steamvr"
# serial = "LHR-12345678"
# What fingers meet; the pose is that of its middle, z its axis. Or { kind = "box", size = [0.1, 0.06, 0.065] }, or
# { kind = "sphere", radius = 0.04 }, or { kind = "mesh", file = "mug.glb" }, see docs/hand.md.
# shape = { kind = "cylinder", radius = 0.04, height = 0.1 }
"""

_BRIDGES: Final = """
# Other programs that `rhot up` sends everything to: vmc (avatars), vrchat, vmt (SteamVR), json, lsl, ros2.
# See docs/bridges.md.
# [bridges.avatar]
# target = "vmc"
# host = "127.0.0.1"
"""

_SIM_OBJECT: Final = """
[objects.{name}]
source = "simulated"
rate_hz = 60.0
# The one shape that the simulated world draws.
shape = {{ kind = "box", size = [0.1, 0.06, 0.065] }}
"""

_SIM: Final = """
# The simulated world, the same for every process: with the time, the seed determines everything.
[sim]
seed = {seed}
# What moves: script (gestures and grasps), still, crossing (two hands), board, desk_board, touch.
# motion = "script"
"""


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A USB camera as `rhot init --webcams` found it.

    Attributes:
        source, device: as in `rig.toml`.
        label: the driver's name for people.
        rate_hz: frames a second that it delivers.
        controls: `v4l2_controls`.
        unlocked: what its driver does not lock, as text; empty if nothing.
    """

    source: str
    device: str
    label: str
    rate_hz: float
    controls: Mapping[str, int]
    unlocked: str


FINGERS: Final = ("thumb", "index", "middle", "ring", "little")
_PAINT_SHIFT: Final = 2
"""How many fingers further the second hand wears a paint: neither the same finger nor its neighbour, which hands that
meet bring together."""


def rig_template(
    *,
    folder: str,
    name: str,
    connect: Sequence[str] = ("tcp/127.0.0.1:7447",),
    listen: Sequence[str] = ("tcp/127.0.0.1:7447",),
    cameras: Sequence[str] = ("left", "right"),
    camera_xs_m: Sequence[float] = (0.0, 0.075),
    source: str = "picamera2",
    rate_hz: float = 60.0,
    exposure_s: float = 0.004,
    readout_s: float = 0.012,
    sides: Sequence[Side] = ("right",),
    length_m: float = 0.189,
    share_paints: bool = True,
    simulated_objects: Sequence[str] = (),
    seed: int | None = None,
    found: Sequence[FoundCamera] = (),
) -> str:
    """Return the text of a `rig.toml`.

    Args:
        folder: the rig folder, as the comments name it.
        name: of the rig.
        connect, listen: Zenoh endpoints.
        cameras, camera_xs_m: names and nominal positions along x, metres.
        source, rate_hz, exposure_s, readout_s: of all cameras.
        sides: hands that wear markers; with two, the second hand's markers carry its side's name.
        share_paints: the second hand's fingertips wear the paints of the first.
        length_m: of the hand.
        simulated_objects: names of simulated objects; without any, an example of a real one stands as comment.
        seed: of the simulated world; None for a real rig.
        found: what the cameras are, in their order; without them they are of the kind `source`.
    """
    parts = [
        _HEAD.format(
            folder=printable(folder),
            name=_string(name),
            connect=_quoted(connect),
            listen=_quoted(listen),
            length_m=length_m,
        )
    ]
    same = {"width": 640, "height": 480, "exposure_s": exposure_s, "readout_s": readout_s}
    for index, (camera, x) in enumerate(zip(cameras, camera_xs_m, strict=True)):
        own: dict[str, object] = {"source": source, "rate_hz": rate_hz, "device": _ANY_DEVICE, "controls": ""}
        if found:
            own = _as_found(camera, found[index])
        parts.append(_CAMERA.format(name=camera, x=x, **same, **own))
    parts.append(_MARKERS)
    for number, side in enumerate(sides):
        prefix, shared = "" if number == 0 else f"{side}_", number > 0 and share_paints
        parts += [_SHARED] if shared else []
        for index, finger in enumerate(FINGERS):
            other = FINGERS[(index + _PAINT_SHIFT) % len(FINGERS)]
            paint = f'paint_of = "{other}"\n' if shared else ""
            parts.append(_TIP.format(name=f"{prefix}{finger}", side=side, finger=finger, paint=paint))
        parts.append(_BASE.format(name=f"{prefix}base", side=side))
    parts.append(_TAIL)
    parts += [_SIM_OBJECT.format(name=name) for name in simulated_objects] or [_OBJECTS]
    parts.append(_BRIDGES)
    if seed is not None:
        parts.append(_SIM.format(seed=seed))
    return "".join(parts)


def _as_found(name: str, camera: FoundCamera) -> dict[str, object]:
    locks = f"Not locked: {camera.unlocked}." if camera.unlocked else "Its driver locks everything."
    label, locks = (printable(text).replace("\n", " ") for text in (camera.label, locks))
    device = _FOUND_DEVICE.format(label=label, locks=locks, device=_string(camera.device))
    values = "\n".join(f"{key} = {value}" for key, value in camera.controls.items())
    controls = _CONTROLS.format(name=name, values=values) if values else ""
    return {"source": camera.source, "rate_hz": camera.rate_hz, "device": device, "controls": controls}


def _string(text: str) -> str:
    """Return any text, such as a folder's name, as a string of TOML."""
    return tomlkit.string(printable(text)).as_string()


def _quoted(words: Sequence[str]) -> str:
    return ", ".join(map(_string, words))
