"""The options of `rhot calibrate objects --touch`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import click

from rhot.errors import ConfigError
from rhot.rig import BusConfig
from rhot_calibration.objects.touch.streams import TOUCHES_A_FACE

_Command = TypeVar("_Command", bound=Callable[..., Any])

_OPTIONS: Final = (
    click.option(
        "--touch",
        "touched",
        metavar="ID",
        help="Find where this object sits on its tracker: touch its faces with a tracked fingertip.",
    ),
    click.option("--finger", default="index", show_default=True, help="With --touch: whose tip touches."),
    click.option("--hand", "side", type=click.Choice(["left", "right"]), help="With --touch; else the rig's first."),
    click.option(
        "--faces", metavar="A,B,…", default="", help="With --touch: the faces in this order; else all but the bottom."
    ),
    click.option(
        "--per-face",
        type=click.IntRange(1, 30),
        default=TOUCHES_A_FACE,
        show_default=True,
        help="With --touch: how often each face is touched, three times that all round.",
    ),
)


def touch_options(command: _Command) -> _Command:
    """Add the options to a command, in their order."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def source_of(table: Path | None, live: bool, bus: BusConfig) -> BusConfig | Path:
    """Return where touches come from: the running rig unless a recording is named.

    Raises:
        ConfigError: both are named, or the file is not there.
    """
    if table is None:
        return bus
    if live:
        raise ConfigError("--touch takes a recording or --live, not both")
    if not table.exists():
        raise ConfigError(f"{table} is not there; name a recording of `rhot record`, or none for the running rig")
    return table
