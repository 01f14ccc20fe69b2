"""`rhot keys`: certificates for a secured bus."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, get_args

import click

from rhot.cli.options import rig_option
from rhot.errors import ConfigError
from rhot.keys import KEYS_FOLDER, Holder, RoleKind, load_roles
from rhot_tools.keys.bundle import MAX_BUNDLE_BYTES, install_bundle

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
