"""`rhot init`: a new rig folder."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import click
from rich.console import Console

from rhot.atomic_file import why
from rhot.errors import ConfigError
from rhot.plugins import load_plugin
from rhot.rig.folder import RIG_FILE, write_text_atomic
from rhot.rig.template import rig_template
from rhot.text import as_argument

CALIBRATING_HZ: Final = 30.0
"""Frames a second of a rig for trying the calibration: leaves room for a browser without a graphics card."""


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
        raise ConfigError(f"{path}: cannot be made: {why(error)}") from error


@click.command()
@click.argument("path", metavar="RIG", type=click.Path(path_type=Path))
@click.option(
    "--sim", "simulated", is_flag=True, help="Make a simulated rig, calibrated and ready to run on this machine."
)
@click.option(
    "--webcams", is_flag=True, help="Find the USB cameras of this machine, show each, and ask which is left and right."
)
@click.option("--uncalibrated", is_flag=True, help="With --sim: leave the rig uncalibrated, to try the calibration.")
@click.option(
    "--feet",
    is_flag=True,
    help="With --sim: a simulated person whose feet are tracked, in place of a hand and cameras.",
)
def init(path: Path, simulated: bool, webcams: bool, uncalibrated: bool, feet: bool) -> None:
    """Make a new rig folder RIG with a commented rig.toml for two cameras named left and right."""
    if uncalibrated and not simulated:
        raise ConfigError("--uncalibrated goes with --sim; a rig of your own begins without calibration anyway")
    if feet and (uncalibrated or not simulated):
        raise ConfigError("--feet goes with --sim alone; for feet of your own add [feet.camera], see docs/feet.md")
    if webcams and simulated:
        raise ConfigError("--webcams and --sim exclude each other: a rig has real cameras or simulated ones")
    with _new_folder(path):
        _write(path, simulated, webcams, uncalibrated, feet)


@contextlib.contextmanager
def _new_folder(path: Path) -> Iterator[None]:
    """Make a folder for a rig; what was written is removed again where the block does not end well."""
    before = set(path.iterdir()) if path.is_dir() else None
    make_folder(path)
    try:
        yield
    except BaseException:
        if before is None:
            shutil.rmtree(path, ignore_errors=True)
        else:
            for file in set(path.iterdir()) - before:
                file.unlink(missing_ok=True)
        raise


def _write(path: Path, simulated: bool, webcams: bool, uncalibrated: bool, feet: bool) -> None:
    if feet:
        load_plugin("rhot.simulated", "walker_folder", "--sim --feet", "sim")(path)
        click.echo(f"{path}: a simulated person. Run it with: rhot sim --rig {as_argument(path)}")
        return
    if simulated:
        write_simulated_rig = load_plugin("rhot.simulated", "rig_folder", "--sim", "sim")
        with Console(stderr=True).status("preparing the simulated rig: cameras, colours, hand"):
            write_simulated_rig(path, rate_hz=CALIBRATING_HZ if uncalibrated else 60.0, calibrated=not uncalibrated)
        what = "a simulated rig without calibration" if uncalibrated else "a simulated rig"
        click.echo(f"{path}: {what}. Run it with: rhot sim --rig {as_argument(path)}")
        return
    folder, name = as_argument(path), path.resolve().name
    if webcams:
        # Loaded here, because it loads OpenCV.
        from rhot_tools.operate.webcams import EXPOSURE_S, READOUT_S, choose_cameras  # noqa: PLC0415

        found = choose_cameras(Console())
        text = rig_template(folder=folder, name=name, exposure_s=EXPOSURE_S, readout_s=READOUT_S, found=found)
        write_text_atomic(path / RIG_FILE, text)
        click.echo(
            f"{path / RIG_FILE} written, with both cameras. Next:\n"
            f"  rhot up --rig {folder}          starts everything; its page is http://localhost:8080, whose tab\n"
            "                                   Calibrate leads through the rest"
        )
        return
    write_text_atomic(path / RIG_FILE, rig_template(folder=folder, name=name))
    click.echo(
        f"{path / RIG_FILE} written. Next: look through it, then\n"
        f"  rhot doctor --rig {as_argument(path)}      what is missing, and how to get it\n"
        f"  rhot up --rig {as_argument(path)}          starts everything on this machine; its page is\n"
        "                                   http://localhost:8080, whose tab Calibrate leads through the rest\n"
        "Cameras on other machines, such as Raspberry Pis, need a certificate each: docs/use.md, or rhot keys --help"
    )
