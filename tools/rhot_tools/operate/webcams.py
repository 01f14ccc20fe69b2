"""`rhot init --webcams`: finds USB cameras, shows each, and asks which is which."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Final

import click
import cv2
from rich.console import Console
from rich.text import Text

from rhot.arrays import ImageArray
from rhot.errors import ConfigError, DeviceError
from rhot.rig.config import CameraConfig
from rhot.rig.template import FoundCamera
from rhot_capture.sources.plugged import Looked, Plugged, locked, look, plugged_in

EXPOSURE_S: Final = 0.008
"""Of webcams at first: their sensors are smaller than a Pi's, so that 4 ms are too dark for most rooms."""
READOUT_S: Final = 0.02
"""Of webcams, which do not state it: between half and all of the period of 30 Hz."""
_COLUMNS = 48
"""Width of a picture: two stand below each other in a window of 40 lines."""
_AGAIN = "again"


def choose_cameras(console: Console) -> list[FoundCamera]:
    """Ask which camera is left and which right; try what each lets itself be locked to.

    Raises:
        ConfigError: there are fewer than two.
        DeviceError: a chosen one cannot be opened any more.
    """
    cameras = plugged_in()
    if len(cameras) < 2:
        raise ConfigError(
            f"two USB cameras are needed, and this machine has {cameras[0].label if cameras else 'none'}"
            f"{' alone' if cameras else ''}; plug them in, each into a port of its own, and call this again"
        )
    while True:
        looks = _show(console, cameras)
        if len(looks) < 2:
            raise ConfigError("fewer than two cameras deliver pictures; see what each one says above")
        left = _ask("Which is the left one, seen from behind them", list(looks))
        if left != _AGAIN:
            break
    others = [number for number in looks if number != left]
    right = others[0] if len(others) == 1 else _ask("And the right one", others, again=False)
    return [
        _tried(console, name, cameras[int(number) - 1], looks[number])
        for name, number in (("left", left), ("right", right))
    ]


def _show(console: Console, cameras: Sequence[Plugged]) -> dict[str, Looked]:
    """Show what each camera sees; return that of those that deliver, by the number that a person types."""
    looks = {}
    for number, camera in enumerate(cameras, 1):
        try:
            with console.status(f"looking through {camera.label}"):
                looks[str(number)] = look(camera)
        except DeviceError as error:
            console.print(f"{number}  {error}", style="yellow", markup=False)
            continue
        rate_hz = looks[str(number)].rate_hz
        console.print(f"{number}  {camera.label}, {rate_hz:.0f} pictures a second, {camera.device}", markup=False)
        if console.is_terminal and console.color_system is not None:
            console.print(_as_text(looks[str(number)].image))
    return looks


def _as_text(image: ImageArray) -> Text:
    picture = Text()
    for line in half_blocks(image, _COLUMNS):
        for upper, lower in line:
            picture.append("\N{UPPER HALF BLOCK}", style=f"{upper} on {lower}")
        picture.append("\n")
    return picture


def half_blocks(image: ImageArray, columns: int) -> Sequence[Sequence[tuple[str, str]]]:
    """Return a picture for a terminal: lines of upper half blocks, each with the colours of its two pixels.

    Args:
        image: (H, W, 3) BGR.
        columns: width in characters; a character is about twice as high as wide.

    Returns:
        Lines of (upper colour, lower colour), as `#rrggbb`.
    """
    rows = 2 * round(0.5 * columns * image.shape[0] / image.shape[1])
    small = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    colours = [[f"#{red:02x}{green:02x}{blue:02x}" for blue, green, red in line] for line in small.tolist()]
    return [list(zip(upper, lower, strict=True)) for upper, lower in zip(colours[::2], colours[1::2], strict=True)]


def _ask(question: str, numbers: Sequence[str], *, again: bool = True) -> str:
    hint = " (again: new pictures; hold a hand before one)" if again else ""
    kinds = click.Choice([*numbers, _AGAIN] if again else list(numbers))
    answer: str = click.prompt(f"{question}?{hint}", type=kinds, show_choices=True)
    return answer


def _tried(console: Console, name: str, camera: Plugged, looked: Looked) -> FoundCamera:
    """Lock a camera as its capture service will, and say what could not be."""
    config = CameraConfig(
        source=camera.source,
        device=camera.device,
        rate_hz=looked.rate_hz,
        exposure_s=EXPOSURE_S,
        readout_s=READOUT_S,
        v4l2_controls=dict(looked.held),
    )
    # What the driver refuses is printed here, in a line.
    drivers = logging.getLogger("rhot_capture.sources")
    level = drivers.level
    drivers.setLevel(logging.ERROR)
    try:
        unlocked = ", ".join(locked(name, config))
    finally:
        drivers.setLevel(level)
    console.print(f"{name}: {camera.label}", markup=False)
    text = f"  not locked: {unlocked}" if unlocked else "  exposure, gain, white balance and focus are locked"
    console.print(text, style="yellow" if unlocked else "green", markup=False)
    return FoundCamera(camera.source, camera.device, camera.label, looked.rate_hz, looked.held, unlocked)
