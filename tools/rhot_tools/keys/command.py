"""`rhot keys`: certificates for a secured bus."""

from __future__ import annotations

import importlib
import io
import re
import ssl
import tarfile
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, get_args

import click
from pydantic import ValidationError

from rhot.cli.options import rig_option
from rhot.errors import ConfigError
from rhot.keys import AUTHORITY, KEYS_FOLDER, Holder, RoleKind, load_roles, write_private
from rhot.messages import first_problem
from rhot.rig.config import RigConfig
from rhot.rig.folder import COLORS_FILE, RIG_FILE, write_text_atomic
from rhot.rig.sections import BusConfig
from rhot.rig.toml_edit import change_rig_file
from rhot.text import parse_toml

# Taking over a bundle of certificates on another machine; needs no cryptography there.

MAX_BUNDLE_BYTES: Final = 16 << 20
"""Larger than any colours of a rig."""
_EXPECTED: Final = re.compile(
    rf"{re.escape(RIG_FILE)}|{re.escape(COLORS_FILE)}|{KEYS_FOLDER}/[A-Za-z0-9_.-]+\.(pem|key)"
)


def install_bundle(data: bytes, rig_path: Path) -> tuple[str, ...]:
    """Put a bundle of `rhot keys` into a rig folder and return the files written.

    A `rig.toml` that is there keeps everything but how it reaches the bus; colours that are there stay.

    Raises:
        ConfigError: it is no such bundle, or something cannot be written; nothing is written then but whole files.
    """
    content = _content(data)
    config = _rig_config(content[RIG_FILE])
    _check_certificates(content)
    keys = rig_path / KEYS_FOLDER
    try:
        keys.mkdir(mode=0o700, parents=True, exist_ok=True)
        keys.chmod(0o700)
    except OSError as error:
        raise ConfigError(f"{keys}: cannot be made: {error.strerror or error}") from error
    written = []
    for name, part in content.items():
        if name == RIG_FILE:
            _take_rig_file(rig_path, part, config.bus)
        elif name == COLORS_FILE and (rig_path / name).exists():
            continue
        else:
            write_private(rig_path / name, part)
        written.append(name)
    return tuple(written)


def _take_rig_file(rig_path: Path, text: bytes, bus: BusConfig) -> None:
    if not (rig_path / RIG_FILE).exists():
        write_text_atomic(rig_path / RIG_FILE, text.decode())
        return
    change_rig_file(
        rig_path,
        {
            ("bus",): {
                "mode": bus.mode,
                "connect": list(bus.connect),
                "listen": list(bus.listen),
                "namespace": bus.namespace,
                "tls": bus.tls,
                "identity": bus.identity,
            }
        },
    )


def _content(data: bytes) -> dict[str, bytes]:
    if len(data) > MAX_BUNDLE_BYTES:
        raise ConfigError(f"the bundle is over {MAX_BUNDLE_BYTES >> 20} MiB; it is none of `rhot keys`")
    content: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            for entry in archive:
                stream = archive.extractfile(entry) if entry.isreg() else None
                # Names decide where a file lands: only those that a bundle has.
                if stream is None or entry.issparse() or not _EXPECTED.fullmatch(entry.name):
                    raise ConfigError(f"the bundle holds {entry.name!r}, which belongs to none of `rhot keys`")
                if entry.size > len(data):
                    raise ConfigError(f"the bundle says that {entry.name} has {entry.size} bytes, more than itself")
                content[entry.name] = stream.read()
    except (tarfile.TarError, EOFError) as error:
        raise ConfigError(f"this is no bundle of `rhot keys`: {error}") from error
    if RIG_FILE not in content:
        raise ConfigError(f"the bundle holds no {RIG_FILE}")
    return content


def _check_certificates(content: Mapping[str, bytes]) -> None:
    """Refuse a bundle whose certificates are none, or whose keys are not theirs, before good files are replaced.

    Raises:
        ConfigError: names the file.
    """
    authority = f"{KEYS_FOLDER}/{AUTHORITY}.pem"
    certificates = [name for name in content if name.endswith(".pem") and name != authority]
    if authority not in content or not certificates:
        raise ConfigError("the bundle holds no certificates; make it again with `rhot keys`")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    name = authority
    try:
        context.load_verify_locations(cadata=content[authority].decode("ascii"))
        with tempfile.TemporaryDirectory(prefix="rhot-keys-") as folder:
            for name in certificates:
                certificate, key = Path(folder) / "part.pem", Path(folder) / "part.key"
                write_private(certificate, content[name])
                write_private(key, content[f"{name.removesuffix('.pem')}.key"])
                context.load_cert_chain(certificate, key, password="")
    except (ssl.SSLError, ValueError, KeyError) as error:
        raise ConfigError(
            f"the bundle's {name} is no certificate with its key; nothing was replaced. Make the bundle again with "
            "`rhot keys`"
        ) from error


def _rig_config(text: bytes) -> RigConfig:
    try:
        return RigConfig.model_validate(parse_toml(text.decode()))
    except ValidationError as error:
        raise ConfigError(f"the bundle's {RIG_FILE}: {first_problem(error)}") from error
    except ValueError as error:
        raise ConfigError(f"the bundle's {RIG_FILE} is not TOML: {error}") from error


_GIVEN = tuple(role for role in get_args(RoleKind) if role != "router")


def _making() -> Any:
    try:
        return importlib.import_module("rhot_tools.keys.making")
    except ModuleNotFoundError as error:
        raise ConfigError(f"making certificates needs {error.name}; pip install 'rhot[keys]'") from error


@click.group()
def keys() -> None:
    """Secure the bus: a certificate for each machine, and what its role may do.

    \b
    rhot keys make --address 192.168.1.10          on the PC, whose address this is
    ssh pi@left rhot keys install - --rig rig < rig/keys/camera-left.tar

    That secures a rig of two machines; docs/security.md says what it protects from.
    """


@keys.command()
@click.option(
    "--address",
    "addresses",
    multiple=True,
    required=True,
    metavar="ADDRESS",
    help="Host name or IP address by which the other machines reach this one. May be repeated; the first is used.",
)
@click.option(
    "--port", type=click.IntRange(1, 65535), help="Port of the router.  [default: that of rig.toml, as a rule 7447]"
)
@rig_option
def make(addresses: tuple[str, ...], port: int | None, rig_path: Path) -> None:
    """Make the rig's authority and certificates, and switch TLS on in rig.toml."""
    bundles = _making().make_keys(rig_path, addresses, port)
    click.echo(f"{rig_path / KEYS_FOLDER} written, TLS is on in rig.toml. Start router and services again.")
    if bundles:
        click.echo("Then bring")
        for bundle in bundles:
            click.echo(f"  {bundle}  to its machine: rhot keys install FILE --rig RIG")
        click.echo("Each of these files is a key: send it through ssh, and delete it afterwards.")


@keys.command()
@click.argument("name")
@click.option("--role", type=click.Choice(_GIVEN), default="tool", show_default=True, help="What the holder may do.")
@click.option("--camera", help="With --role camera: the camera's name in rig.toml.")
@rig_option
def add(name: str, role: RoleKind, camera: str | None, rig_path: Path) -> None:
    """Make one more certificate, for the holder NAME.

    \b
    tool      reads everything, changes nothing
    operator  may do everything: start, stop, configure, replay
    camera    publishes one camera's markers, pictures and status
    objects   publishes objects and head
    feet      publishes feet
    services  publishes everything that is tracked, owns the clock

    The router accepts the new name after a restart.
    """
    try:
        holder = Holder(role=role, camera=camera)
    except ValueError as error:
        raise ConfigError("--role camera, and no other, goes with --camera NAME") from error
    click.echo(f"{_making().add_holder(rig_path, name, holder)} written; start the router again")


@keys.command()
@click.argument("name")
@rig_option
def remove(name: str, rig_path: Path) -> None:
    """Revoke the certificate of the holder NAME, such as that of a stolen Pi."""
    _making().remove_holder(rig_path, name)
    click.echo(f"{name} removed; start the router again")


@keys.command()
@click.argument("bundle", type=click.File("rb"))
@rig_option
def install(bundle: Any, rig_path: Path) -> None:
    """Install the BUNDLE that `rhot keys` made for this machine; - reads it from standard input."""
    written = install_bundle(bundle.read(MAX_BUNDLE_BYTES + 1), rig_path)
    click.echo(f"{rig_path}: {', '.join(written)} written; start the services of this machine again")


@keys.command(name="list")
@rig_option
def list_holders(rig_path: Path) -> None:
    """List certificates, with their holders and expiry dates."""
    for name, holder in load_roles(rig_path / KEYS_FOLDER).holders.items():
        camera = f" {holder.camera}" if holder.camera else ""
        click.echo(f"{name:24} {holder.role}{camera}, until {holder.expires}")
