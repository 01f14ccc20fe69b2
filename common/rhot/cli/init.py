"""`rhot init`: a new rig folder."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from rhot.errors import ConfigError
from rhot.rig.folder import RIG_FILE, write_text_atomic
from rhot.rig.template import rig_template


def make_folder(path: Path) -> None:
    """Make a folder for a rig.

    Raises:
        ConfigError: there is a rig already, or the folder cannot be made.
    """
    if (path / RIG_FILE).exists():
        raise ConfigError(f"{path / RIG_FILE} is there already and stays as it is; name another folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made: {error.strerror or error}") from error


@click.command()
@click.argument("path", metavar="RIG", type=click.Path(path_type=Path))
@click.option("--sim", "simulated", is_flag=True, help="A simulated rig, calibrated and ready to run on this machine.")
def init(path: Path, simulated: bool) -> None:
    """Make a new rig folder RIG with a commented rig.toml for two cameras named left and right."""
    make_folder(path)
    if simulated:
        from rhot.sim.folder import write_simulated_rig  # noqa: PLC0415  # only this needs the simulator's packages

        with Console(stderr=True).status("preparing the simulated rig: cameras, colours, hand"):
            write_simulated_rig(path)
        click.echo(f"{path}: a simulated rig. Run it with: rhot sim --rig {path}")
        return
    write_text_atomic(path / RIG_FILE, rig_template(folder=str(path), name=path.resolve().name))
    click.echo(
        f"{path / RIG_FILE} written. Next: look through it, then\n"
        f"  rhot calibrate colors PICTURE --pick thumb=U,V … --rig {path}\n"
        f"  rhot doctor --rig {path}"
    )
