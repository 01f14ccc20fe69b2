"""Certificates and roles on a secured bus: the folder beside `rig.toml`, and what a role may do.

A certificate's common name says who speaks; `keys/roles.json` says what role that name has. The router denies
whatever no rule allows. Rules look at keys and kinds of messages in both directions: what a client sends (`ingress`)
and what it is sent (`egress`), see Zenoh's manual, "Access Control".
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, model_validator

from rhot.errors import ConfigError
from rhot.messages import Name
from rhot.rig.file_model import FileModel
from rhot.rig.folder import read_json_model

RoleKind = Literal["router", "services", "camera", "objects", "feet", "operator", "tool"]
ROUTER: Final = "router"
SERVICES: Final = "services"
OPERATOR: Final = "operator"
TOOL: Final = "tool"
_EVERYTHING: Final = ("rhot/**", "rhot/@pictures/**", "rhot/@sensors/**")
"""The others are apart: `**` does not match chunks that begin with `@`."""
_FEET_INPUTS: Final = ("@pictures/feet", "@sensors/*")
"""What the feet service sends to who records."""
_DATA: Final = ("points", "hand/*", "object/*", "space/*", "head", "foot/*", "body", "truth")
_HEARD: Final = ("rhot/control",)
_ASKED: Final = ("rhot/control", "rhot/clock")


class Holder(FileModel):
    """Who holds a certificate.

    Attributes:
        role: what it may do.
        camera: name of the camera, for the role `camera`.
        expires: last day of the certificate, ISO 8601.
    """

    role: RoleKind
    camera: Name | None = None
    expires: str = ""

    @model_validator(mode="after")
    def _has_camera(self) -> Holder:
        if (self.role == "camera") != (self.camera is not None):
            raise ValueError("the role camera, and no other, needs the camera's name")
        return self


class RolesFile(FileModel):
    """`keys/roles.json`: every certificate that the router lets in, by its common name."""

    version: Literal[1] = 1
    holders: Annotated[dict[Name, Holder], Field(max_length=256)] = {}


@dataclass(frozen=True, slots=True)
class Allowance:
    """What one holder may do; key expressions without the rig's namespace.

    Attributes:
        publish: keys that it puts values on; it may answer questions for them, too.
        answer: further keys that it answers questions for.
        alive: its liveliness tokens.
        hear: keys that it may subscribe to.
        ask: keys that it may ask for.
        ask_not: of these, keys that it must not ask for by name.
        watch: whether it may see who is alive.
    """

    publish: tuple[str, ...] = ()
    answer: tuple[str, ...] = ()
    alive: tuple[str, ...] = ()
    hear: tuple[str, ...] = ()
    ask: tuple[str, ...] = ()
    ask_not: tuple[str, ...] = ()
    watch: bool = False


def allowance(holder: Holder) -> Allowance:
    """Return what a holder may do."""
    if holder.role == "camera":
        name = holder.camera
        own = (f"rhot/config/capture/{name}", f"rhot/keep/capture/{name}", f"rhot/preview/{name}")
        return Allowance(
            publish=(f"rhot/markers/{name}", f"rhot/@pictures/{name}", f"rhot/status/capture/{name}"),
            answer=own,
            alive=(f"rhot/alive/capture/{name}",),
            hear=(*_HEARD, own[0]),
            ask=_ASKED,
        )
    if holder.role in ("objects", "feet"):
        is_feet = holder.role == "feet"
        data = ("foot/*", "space/*", *_FEET_INPUTS) if is_feet else ("object/*", "head", "space/*")
        return Allowance(
            publish=(*(f"rhot/{key}" for key in data), f"rhot/status/{holder.role}/*"),
            answer=(f"rhot/config/{holder.role}/*", *(("rhot/preview/feet",) if is_feet else ())),
            alive=(f"rhot/alive/{holder.role}/*",),
            hear=(*_HEARD, f"rhot/config/{holder.role}/*", *(("rhot/head",) if is_feet else ())),
            ask=_ASKED,
        )
    if holder.role == SERVICES:
        return Allowance(
            publish=(*(f"rhot/{key}" for key in (*_DATA, *_FEET_INPUTS)), "rhot/status/*/*"),
            answer=("rhot/control", "rhot/clock", "rhot/rig", "rhot/config/*/*", "rhot/preview/feet"),
            alive=("rhot/alive/*/*",),
            hear=_EVERYTHING,
            ask=_ASKED,
            watch=True,
        )
    if holder.role == OPERATOR:
        return Allowance(
            publish=_EVERYTHING,
            alive=("rhot/alive/**",),
            hear=_EVERYTHING,
            ask=_EVERYTHING,
            watch=True,
        )
    if holder.role == TOOL:
        # A question with wildcards changes nothing (`rhot.bus.query`); one that names its key might.
        return Allowance(hear=_EVERYTHING, ask=_EVERYTHING, ask_not=("rhot/config/*/**", "rhot/keep/**"), watch=True)
    return Allowance()


def access_control(holders: Mapping[str, Holder], namespace: str = "") -> dict[str, Any]:
    """Return the `access_control` part of the router's configuration.

    Args:
        holders: common name to role.
        namespace: of the rig; the router sees keys with it.
    """
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    prefix = f"{namespace}/" if namespace else ""
    for name, holder in holders.items():
        made = [
            {**rule, "id": f"{name}-{number}", "key_exprs": [f"{prefix}{key}" for key in rule["key_exprs"]]}
            for number, rule in enumerate(_rules(allowance(holder)))
            if rule["key_exprs"]
        ]
        if made:
            rules += made
            subjects.append({"id": name, "cert_common_names": [name]})
            policies.append({"rules": [rule["id"] for rule in made], "subjects": [name]})
    # Zenoh refuses empty lists as ambiguous; without holders nobody gets in.
    parts = {"rules": rules, "subjects": subjects, "policies": policies} if rules else {}
    return {"enabled": True, "default_permission": "deny", **parts}


def _rules(allowed: Allowance) -> Iterable[dict[str, Any]]:
    def rule(flow: str, messages: tuple[str, ...], keys: tuple[str, ...], permission: str = "allow") -> dict[str, Any]:
        return {"permission": permission, "flows": [flow], "messages": list(messages), "key_exprs": list(keys)}

    yield rule("ingress", ("put", "delete"), allowed.publish)
    yield rule("ingress", ("declare_queryable", "reply"), (*allowed.publish, *allowed.answer))
    yield rule("ingress", ("liveliness_token",), allowed.alive)
    yield rule("ingress", ("declare_subscriber",), allowed.hear)
    yield rule("egress", ("put", "delete"), allowed.hear)
    yield rule("ingress", ("query",), allowed.ask)
    yield rule("ingress", ("query",), allowed.ask_not, "deny")
    yield rule("egress", ("declare_queryable", "reply"), allowed.ask)
    # What others ask of it was judged where they asked, and who listens is no secret to who publishes.
    yield rule("egress", ("query", "declare_subscriber"), _EVERYTHING if allowed.publish or allowed.answer else ())
    if allowed.watch:
        alive = ("rhot/alive/**",)
        yield rule("ingress", ("liveliness_query", "declare_liveliness_subscriber"), alive)
        yield rule("egress", ("liveliness_token",), alive)


KEYS_FOLDER: Final = "keys"
ROLES_FILE: Final = "roles.json"
AUTHORITY: Final = "authority"
IDENTITY_VARIABLE: Final = "RHOT_IDENTITY"
"""Names the certificate to use, such as `tool`; wins over rig.toml."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """Files that a process shows and trusts."""

    authority: Path
    certificate: Path
    key: Path


def certificate_file(folder: Path, name: str) -> Path:
    """Return where a certificate lies."""
    return folder / f"{name}.pem"


def key_file(folder: Path, name: str) -> Path:
    """Return where the private key of a certificate lies."""
    return folder / f"{name}.key"


def credentials(folder: Path, identity: str) -> Credentials:
    """Return the files of an identity; of a tool, where none is named, those of the operator or else a reader.

    Raises:
        ConfigError: they are not there, or this user may not read them.
    """
    authority = certificate_file(folder, AUTHORITY)
    if not authority.exists():
        raise ConfigError(
            f"[bus] tls is on, but {authority} is missing; make certificates with `rhot keys make`, or bring this "
            "machine's with `rhot keys install`"
        )
    wanted = os.environ.get(IDENTITY_VARIABLE) or identity
    names = (wanted,) if wanted else (OPERATOR, TOOL)
    for name in names:
        if os.access(key_file(folder, name), os.R_OK) and certificate_file(folder, name).exists():
            return Credentials(authority, certificate_file(folder, name), key_file(folder, name))
    raise ConfigError(
        f"{folder} holds no certificate {' or '.join(names)} that this user can read; `rhot keys add NAME` makes one "
        f"on the machine that made the others, and {IDENTITY_VARIABLE}=NAME chooses one"
    )


def load_roles(folder: Path) -> RolesFile:
    """Return who holds a certificate.

    Raises:
        ConfigError: the file is missing or not valid; the router then lets nobody in.
    """
    if not (folder / ROLES_FILE).exists():
        raise ConfigError(f"{folder} holds no {ROLES_FILE}; `rhot keys make`, on the router's machine, makes it")
    return read_json_model(folder / ROLES_FILE, RolesFile, ConfigError)


def write_private(file: Path, data: bytes) -> None:
    """Write a file that nobody else may read, from its first byte on.

    Raises:
        ConfigError: it cannot be written.
    """
    try:
        file.unlink(missing_ok=True)
        handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error.strerror or error}") from error
