"""The folder of certificates beside `rig.toml`: which one a process uses, and who holds one."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rhot.errors import ConfigError
from rhot.keys.roles import OPERATOR, TOOL, RolesFile
from rhot.rig.folder import read_json_model

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
