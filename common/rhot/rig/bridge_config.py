"""What people write in `rig.toml` about bridges to other programs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from rhot.rig.file_model import FileModel

BridgeTarget = Literal["json", "vmc", "vrchat", "vmt", "lsl", "ros2"]


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
