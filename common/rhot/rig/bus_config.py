"""What people write in `rig.toml` about the bus."""

from __future__ import annotations

import re
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, model_validator

from rhot.rig.file_model import FileModel

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
