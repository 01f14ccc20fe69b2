"""The seam between a part's calibration and the page that leads through it.

Each service brings the steps that belong to it, by the entry points `rhot.page_steps`, over the very functions that its
command runs. A step is plain data to look at, buttons, and clicks in the cameras' pictures; it knows no page.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Final, Literal, Protocol

from rhot.errors import ConfigError
from rhot.plugins import install_hint
from rhot.rig.folder import load_config
from rhot.rig.sections import BusConfig

GROUP: Final = "rhot.page_steps"
ORDER: Final = {
    "lock": ("Lock the cameras", "capture"),
    "colors": ("Colours", "capture"),
    "cameras": ("Cameras", "pc"),
    "hand": ("Hand", "pc"),
    "objects": ("Objects", "objects"),
    "stage": ("Floor", "pc"),
    "headset": ("Headset", "feet"),
}
"""Entry point to the step's title and the extra to install when it is missing, in the order of the path."""
WITHOUT_CAMERAS: Final = ("headset",)
"""What is left of the path in a rig that tracks feet alone."""

Tone = Literal["plain", "good", "warning", "wrong"]


@dataclass(frozen=True, slots=True)
class StepContext:
    """Where a step works.

    Attributes:
        rig_path: the rig folder.
        bus: how the running rig is reached.
    """

    rig_path: Path
    bus: BusConfig


@dataclass(frozen=True, slots=True)
class Field:
    """Something to fill in.

    Attributes:
        name: under which `CalibrationStep.press` gets its text.
        label, hint: for people.
        value: at the start.
        choices: what may be chosen; empty = any text.
    """

    name: str
    label: str
    value: str
    choices: tuple[str, ...] = ()
    hint: str = ""


@dataclass(frozen=True, slots=True)
class Button:
    """Something to press: its name for `CalibrationStep.press`, and its label and hint for people."""

    name: str
    label: str
    hint: str = ""


@dataclass(frozen=True, slots=True)
class Remark:
    """A sentence for people."""

    text: str
    tone: Tone = "plain"


@dataclass(frozen=True, slots=True)
class Figures:
    """A small table: title, headings, and rows of as many cells."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class StepView:
    """What a step shows at this moment.

    Attributes:
        state: one line: where it stands.
        done: whether the rig folder holds what the step brings.
        share: of the work under way that is done, 0 to 1.
        remarks: what is missing, what is wrong and what to do, how good it is; the most urgent first.
        enabled: names of the buttons that can be pressed now.
        tables: figures.
        pictures: title to JPEG.
        held: camera to a JPEG that stands still in its place, to be clicked in; empty = the live pictures.
        values: fields that the step has set by itself, by name.
    """

    state: str
    done: bool
    share: float = 0.0
    remarks: tuple[Remark, ...] = ()
    enabled: frozenset[str] = frozenset()
    tables: tuple[Figures, ...] = ()
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    held: Mapping[str, bytes] = field(default_factory=dict)
    values: Mapping[str, str] = field(default_factory=dict)


class CalibrationStep(Protocol):
    """One step of the path; all of it runs on one event loop, heavy work on threads of its own."""

    @property
    def about(self) -> str:
        """What to do, a few sentences for people."""
        ...

    @property
    def fields(self) -> tuple[Field, ...]:
        """To fill in; the same all the time."""
        ...

    @property
    def buttons(self) -> tuple[Button, ...]:
        """To press, in the order of use; the same all the time."""
        ...

    def view(self) -> StepView:
        """Return what it shows now; called four times a second while a browser looks, so it must be quick."""
        ...

    async def follow(self) -> None:
        """Look at the running rig while the step is shown; cancelled when it is no longer."""
        ...

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        """Do what a button is for; returns when that is done, and other buttons may be pressed meanwhile.

        Raises:
            RhotError: it cannot be done; says why and what to do.
        """
        ...

    async def point(self, camera: str, u: float, v: float, values: Mapping[str, str]) -> None:
        """Take a click at a raw pixel of a camera's picture; see `press`."""
        ...


def typed_metres(what: str, text: str, example: str) -> float:
    """Return a length that was typed in millimetres, with a point or a comma, in metres.

    Raises:
        ConfigError: not a number; `example` shows one.
    """
    try:
        return 1e-3 * float(text.replace(",", "."))
    except ValueError as error:
        raise ConfigError(f"{what} '{text}': not a number; write millimetres, such as {example}") from error


class _Absent:
    """Stands for a step that is not installed here."""

    fields: tuple[Field, ...] = ()
    buttons: tuple[Button, ...] = ()

    def __init__(self, about: str) -> None:
        self.about = about

    def view(self) -> StepView:
        return StepView("not installed", False)

    async def follow(self) -> None:
        return

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        return

    async def point(self, camera: str, u: float, v: float, values: Mapping[str, str]) -> None:
        return


def load_steps(context: StepContext) -> dict[str, CalibrationStep]:
    """Return the steps of the path that a rig needs by title, in its order; importing them takes seconds.

    Raises:
        RhotError: the rig folder cannot be used.
    """
    found = {point.name: point.value for point in entry_points(group=GROUP)}
    cameras = load_config(context.rig_path).cameras
    return {
        title: _loaded(found.get(name, ""), extra, context)
        for name, (title, extra) in ORDER.items()
        if cameras or name in WITHOUT_CAMERAS
    }


def _loaded(target: str, extra: str, context: StepContext) -> CalibrationStep:
    hint = f"This step is not installed here: {install_hint(extra)}"
    module, _, attribute = target.partition(":")
    if not module:
        return _Absent(hint)
    try:
        make = getattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError as error:
        return _Absent(f"{hint} (it needs the Python module {error.name}).")
    step: CalibrationStep = make(context)
    return step
