"""Messages from a browser: a frame was received, how fast it wants and draws them, where the headset is; pure."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from rhot.arrays import FloatArray
from rhot.errors import WireError
from rhot.geometry.rotations import quaternion_from_rotation, rigid, rotation_from_quaternion
from rhot.messages import HeadPose, ObjectPose, ObjectShape, first_problem
from rhot.messages.base import Position, Quaternion, unit_quaternion, wire_position, wire_quaternion

MOST_BYTES: Final = 2048
"""Of a message from a browser; a head and two controllers take 500, a second of waits 1,500."""
_MOST_WAITS: Final = 240
"""Pictures of a second, on the quickest screen there is."""
WEBXR: Final = "webxr"
HEAD: Final = "head"
CONTROLLER: Final = "controller"


class _BrowserMessage(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class FrameReceived(_BrowserMessage):
    """A frame has been received."""

    type: Literal["taken"]


class Preferences(_BrowserMessage):
    """What a browser wants.

    Attributes:
        rate_hz: most frames per second.
        truth: also the simulated world's truth.
        ahead: most frames under way that it has not taken.
    """

    type: Literal["wish"]
    rate_hz: Annotated[float, Field(ge=1.0, le=120.0)] = 90.0
    truth: bool = False
    ahead: Annotated[int, Field(ge=1, le=2)] = 2


class DrawingFigures(_BrowserMessage):
    """What a browser has drawn in the last second.

    Attributes:
        pictures_hz: pictures per second.
        waits_ms: of each picture with a new pose: from the moment the bus handed the pose over to the moment the
            browser began to draw it.
        clock_ms: how far its idea of the rig's clock may be wrong.
        graphics: whether a graphics card draws; otherwise the processor does.
    """

    type: Literal["shown"]
    pictures_hz: Annotated[float, Field(ge=0.0, le=1000.0)]
    waits_ms: Annotated[list[Annotated[float, Field(ge=-1e4, le=1e4)]], Field(max_length=_MOST_WAITS)]
    clock_ms: Annotated[float, Field(ge=0.0, le=1e6)]
    graphics: bool


class ClockQuestion(_BrowserMessage):
    """A question for the rig's time.

    Attributes:
        at_ms: the browser's own time, handed back.
    """

    type: Literal["time"]
    at_ms: float


class DevicePose(_BrowserMessage):
    """Where a device is in the headset's space: metres, quaternion x, y, z, w."""

    position: Annotated[Position, Field(strict=False)]
    orientation: Annotated[Quaternion, Field(strict=False)]

    @field_validator("orientation")
    @classmethod
    def _norm(cls, value: Quaternion) -> Quaternion:
        return unit_quaternion(value)


class Devices(_BrowserMessage):
    """Where headset and controller are, in WebXR's `local-floor` space.

    Attributes:
        t_ms: the moment for which the headset says so, rig clock.
        head, controller: absent when not tracked.
    """

    type: Literal["devices"]
    t_ms: Annotated[float, Field(ge=0.0, lt=4e12)]
    head: DevicePose | None = None
    controller: DevicePose | None = None


class Moved(_BrowserMessage):
    """The headset's space has been moved by its owner: what was registered is not true any more."""

    type: Literal["moved"]


class Left(_BrowserMessage):
    """The headset has been taken off."""

    type: Literal["left"]


AnyBrowserMessage = FrameReceived | Preferences | DrawingFigures | ClockQuestion | Devices | Moved | Left
_ADAPTER: Final[TypeAdapter[AnyBrowserMessage]] = TypeAdapter(Annotated[AnyBrowserMessage, Field(discriminator="type")])


def parse_message(text: str | bytes) -> AnyBrowserMessage:
    """Return a message of a browser.

    Raises:
        WireError: it is none of the above.
    """
    try:
        return _ADAPTER.validate_json(text)
    except ValidationError as error:
        raise WireError(f"not a message of the page: {first_problem(error)}") from error


def head_pose(device: DevicePose, t_ms: float, T_rig_webxr: FloatArray) -> HeadPose:
    """Return the headset in the rig frame; T_rig_webxr (4, 4) maps the headset's space to it."""
    position, orientation = _to_rig(device, T_rig_webxr)
    return HeadPose(t_ns=round(t_ms * 1e6), frame="rig", position=position, orientation=orientation, state="measured")


def controller_pose(
    device: DevicePose,
    t_ms: float,
    T_rig_webxr: FloatArray,
    T_device_object: FloatArray | None = None,
    shape: ObjectShape | None = None,
) -> ObjectPose:
    """Return the controller in the rig frame.

    Args:
        device: its grip, in the headset's space.
        t_ms: the moment, rig clock.
        T_rig_webxr: (4, 4) from the headset's space to the rig frame.
        T_device_object: (4, 4) of an object that is fixed to it, whose pose is then returned.
        shape: of that object.
    """
    position, orientation = _to_rig(device, T_rig_webxr, T_device_object)
    t_ns = round(t_ms * 1e6)
    return ObjectPose(t_ns=t_ns, frame="rig", position=position, orientation=orientation, state="measured", shape=shape)


def _to_rig(
    device: DevicePose, T_rig_webxr: FloatArray, T_device_object: FloatArray | None = None
) -> tuple[Position, Quaternion]:
    q = np.array(device.orientation)
    T_webxr_device = rigid(rotation_from_quaternion(q / np.linalg.norm(q)), np.array(device.position))
    T = T_rig_webxr @ T_webxr_device
    if T_device_object is not None:
        T = T @ T_device_object
    return wire_position(T[:3, 3]), wire_quaternion(quaternion_from_rotation(T[:3, :3]))
