"""Sections of `rig.toml`: bridges, the bus, shapes of objects, pictures, and what is painted on hands."""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from rhot.anatomy.markers import own_paints
from rhot.anatomy.skeleton import JOINTS
from rhot.messages import BoxShape, CylinderShape, Name, Side, SphereShape
from rhot.rig.file_model import FileModel, Positive

# What people write in `rig.toml` about bridges to other programs.

BridgeTarget = Literal["json", "vmc", "vrchat", "vmt", "lsl", "openxr", "ros2"]


def _resolvable(host: str) -> str:
    """Return a host as it is.

    Raises:
        ValueError: no name can be like this; a resolver would end in a UnicodeError.
    """
    try:
        host.encode("idna")
    except UnicodeError as error:
        raise ValueError("not the name or address of a machine: a part of it is empty or too long") from error
    return host


Host = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.:%-]{1,255}$"), AfterValidator(_resolvable)]


class BridgeConfig(FileModel):
    """One bridge: which program is sent what.

    Attributes:
        target: the kind of program.
        host: where it runs; for a WebSocket, the address on which this bridge listens.
        port: of it; the program's usual one when left out.
        rate_hz: most frames per second.
        predicted: what is predicted counts as tracked (`send`) or as `absent`.
        absent: what of something that is no longer tracked is sent: the last (`keep`), the last, which fades, then
            nothing (`fade`), or nothing (`stop`).
        absent_after_s: how long after its last sample something counts as absent.
        fade_s: how long it fades.
        axes: of `json`: the floor's, Unity's, or the rig's own, which need no floor.
        transport: of `json`.
        body: of `vmc`: `fingers` alone, or with `arms` from head and wrists, hips and feet.
        height_m: of `vmc` with `arms`: of the person, standing, without shoes; arms follow from it.
        allow_origins: web pages that may read `json` by WebSocket, such as `https://example.org`; those of this
            machine may, and no others.
        offset: of `openxr`: moves all hands in the stage by x, y, z, metres, after a turn about the vertical, degrees.
    """

    target: BridgeTarget
    host: Host = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    rate_hz: Annotated[float, Field(ge=1.0, le=200.0)] = 90.0
    predicted: Literal["send", "absent"] = "send"
    absent: Literal["keep", "fade", "stop"] = "fade"
    absent_after_s: Annotated[float, Field(gt=0.0, le=10.0)] = 0.25
    fade_s: Annotated[float, Field(gt=0.0, le=10.0)] = 0.5
    axes: Literal["stage", "unity", "rig"] = "stage"
    transport: Literal["websocket", "udp"] = "websocket"
    body: Literal["fingers", "arms"] = "fingers"
    height_m: Annotated[float, Field(ge=0.5, le=2.5)] = 1.70
    allow_origins: Annotated[tuple[str, ...], Field(max_length=16)] = ()
    offset: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


# What people write in `rig.toml` about the bus.

Endpoint = Annotated[str, Field(min_length=1, max_length=200)]
_ENCRYPTED = ("tls/", "quic/")
_NAMESPACE: Final = re.compile(r"([A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*)?")


def _namespace(text: str) -> str:
    """Return a namespace as it is.

    Raises:
        ValueError: it cannot stand before a key.
    """
    if not _NAMESPACE.fullmatch(text):
        raise ValueError("a namespace is made of letters, digits, _, . and -, with / between its parts, such as desk1")
    return text


class BusConfig(FileModel):
    """How services reach each other over Zenoh.

    Attributes:
        mode: `client` of a router (the default), `peer` without one, or `router`.
        connect: endpoints of the router or of peers.
        listen: endpoints that this process opens; a router needs at least one.
        namespace: prefix that keeps several rigs on one network apart.
        multicast: let Zenoh scout the local network; off unless asked for.
        tls: only who holds a certificate of the rig's own authority gets in, and may do what its role allows; see
            `rhot keys`.
        keys: folder of the certificates, relative to the rig folder.
        identity: name of the certificate that commands on this machine use; empty for the operator's, or else a
            reader's. Services use their own.
    """

    mode: Literal["client", "peer", "router"] = "client"
    connect: Annotated[tuple[Endpoint, ...], Field(max_length=16)] = ("tcp/127.0.0.1:7447",)
    listen: Annotated[tuple[Endpoint, ...], Field(max_length=16)] = ()
    namespace: Annotated[str, Field(max_length=64), AfterValidator(_namespace)] = ""
    multicast: bool = False
    tls: bool = False
    keys: Annotated[str, Field(min_length=1, max_length=4096)] = "keys"
    identity: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]*$", max_length=64)] = ""

    @model_validator(mode="after")
    def _reachable(self) -> BusConfig:
        if self.mode == "client" and not self.connect and not self.multicast:
            raise ValueError('a client needs `connect`, for example connect = ["tcp/192.168.1.10:7447"]')
        if self.mode == "router" and not self.listen:
            raise ValueError('a router needs `listen`, for example listen = ["tcp/127.0.0.1:7447"]')
        unsafe = [each for each in (*self.connect, *self.listen) if self.tls and not each.startswith(_ENCRYPTED)]
        if unsafe:
            raise ValueError(f"tls = true, but {unsafe[0]} is not encrypted; write tls/… instead")
        return self


# Shapes of objects as `rig.toml` states them: those of the messages, with unknown fields refused, or a file.

_FILE = ConfigDict(frozen=True, extra="forbid", strict=False, allow_inf_nan=False)


class BoxConfig(BoxShape):
    """See `BoxShape`."""

    model_config = _FILE


class CylinderConfig(CylinderShape):
    """See `CylinderShape`."""

    model_config = _FILE


class SphereConfig(SphereShape):
    """See `SphereShape`."""

    model_config = _FILE


class MeshConfig(FileModel):
    """A surface in a file; `rhot.object_mesh` reads it.

    Attributes:
        kind: which shape.
        file: glTF in its binary form (`.glb`), relative to the rig folder.
        scale: metres per unit of the file. glTF's unit is the metre, but not every program keeps to that.
    """

    kind: Literal["mesh"] = "mesh"
    file: Annotated[str, Field(min_length=1, max_length=1024)]
    scale: Annotated[float, Field(gt=0.0, le=1000.0)] = 1.0


ShapeConfig = Annotated[BoxConfig | CylinderConfig | SphereConfig | MeshConfig, Field(discriminator="kind")]

# Saturation, contrast and brightness of a camera's picture: their units, and what leaves a picture alone; V4L2's own.
#
# The units are libcamera's (`Saturation`, `Contrast`, `Brightness` of its control list): 1 is the camera's own colour
# and contrast, 0 its own brightness. A driver with units of its own (V4L2) is set in proportion; see
# `PICTURE_NEUTRAL`.

Saturation = Annotated[float, Field(ge=0.0, le=4.0)]
"""Factor on the distance of colours from grey; 0 is a grey picture."""
Contrast = Annotated[float, Field(ge=0.1, le=4.0)]
"""Factor on the distance of levels from the middle of their range."""
Brightness = Annotated[float, Field(ge=-1.0, le=1.0)]
"""What is added to all levels, as a share of their range."""

PICTURE_NEUTRAL: Final[Mapping[str, float]] = MappingProxyType({"saturation": 1.0, "contrast": 1.0, "brightness": 0.0})
"""Fields of a camera's picture and the values that leave it as the camera makes it."""

V4l2Control = Literal[
    "gain",
    "focus_absolute",
    "white_balance_temperature",
    "brightness",
    "contrast",
    "saturation",
    "sharpness",
    "gamma",
    "backlight_compensation",
]
"""Names of the V4L2 controls that a rig may set, as `v4l2-ctl --list-ctrls` shows them."""

# What is painted on hands: markers, and which of them wear the same paint.


class MarkerConfig(FileModel):
    """What a marker's name stands for.

    Attributes:
        hand: side of the hand that wears it.
        joint: OpenXR joint that it marks (`index_tip`, …; `wrist` or `palm` for the patch on the back).
        kind: a painted fingertip (`cap`), a flat rectangle (`patch`), or a ball or dot whose middle is what a camera
            sees (`ball`).
        size_m: of a patch, its extent across the hand and along it, metres.
        min_area_px, max_area_px: size gate, square pixels.
        paint_of: a marker of the other hand that wears the same paint; without it, the paint is this marker's own.
    """

    hand: Side = "right"
    joint: str
    paint_of: Name | None = None
    kind: Literal["cap", "patch", "ball"] = "cap"
    size_m: tuple[Positive, Positive] | None = None
    min_area_px: Positive = 12.0
    max_area_px: Positive = 40_000.0

    @model_validator(mode="after")
    def _consistent(self) -> MarkerConfig:
        if self.joint not in JOINTS:
            raise ValueError(f'joint = "{self.joint}" is not an OpenXR hand joint; one of: {", ".join(JOINTS)}')
        if self.kind == "patch" and self.size_m is None:
            raise ValueError('kind = "patch" needs `size_m = [width, length]` in metres')
        if self.min_area_px >= self.max_area_px:
            raise ValueError(f"min_area_px {self.min_area_px} must be below max_area_px {self.max_area_px}")
        return self


def check_shared_paints(markers: Mapping[str, MarkerConfig]) -> None:
    """Check that hands whose markers share paints can be told apart.

    Raises:
        ValueError: a paint is shared by more than two markers, within one hand or from hand to hand, or a hand has no
            patch with a paint of its own.
    """
    own, shared = own_paints(markers), [m for m in markers.items() if m[1].paint_of is not None]
    worn = [marker.paint_of for _, marker in shared]
    for name, marker in shared:
        owner = own.get(marker.paint_of or "")
        if owner is None or owner.hand == marker.hand or worn.count(marker.paint_of) > 1:
            raise ValueError(f"markers.{name}: paint_of must name a marker of the other hand, each of them once")
    patches = {marker.hand for name, marker in own.items() if marker.kind == "patch" and name not in worn}
    if shared and len(patches) < 2:
        raise ValueError("paint_of needs a patch of a paint of its own on each hand: it tells the hands apart")
