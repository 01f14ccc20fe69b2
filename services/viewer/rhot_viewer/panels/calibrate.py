"""The tab that leads through the calibration, step by step."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, Final

import viser

from rhot.bus import CONNECT_S, Bus
from rhot.calibration_step import CalibrationStep, Figures, Remark, StepContext, StepView, load_steps
from rhot.errors import RhotError
from rhot.operation.control import broadcast, new_session
from rhot.rig.config import RigConfig
from rhot.rig.folder import CAMERAS_FILE, HAND_FILE, HEADSET_FILE, OBJECT_SOURCES, REGISTRATION_FILE, registration_name
from rhot.rig.kept_file import file_stamp
from rhot.rig.toml_edit import change_rig_file
from rhot_viewer.browser.camera_layer import dark_picture, show_jpeg
from rhot_viewer.browser.page import Page
from rhot_viewer.browser.rig_scene import RigScene
from rhot_viewer.browser.sentence import sentence_html
from rhot_viewer.rig.picture_feed import PictureFeed

# Steps of the calibration as text for the page.

_COLORS: Final = {"plain": "inherit", "good": "#69db7c", "warning": "#ffa94d", "wrong": "#ff6b6b"}
_BLOCK: Final = "<div style='padding:0.15em 0.8em;font-size:0.9em;overflow-wrap:anywhere'>{}</div>"


def path_html(views: Mapping[str, StepView], current: str) -> str:
    """Return the whole path, a line a step: its number, whether it is done, and where it stands."""
    rows = []
    for number, (title, view) in enumerate(views.items(), start=1):
        mark = "<span style='color:#69db7c'>✓</span>" if view.done else str(number)
        name = escape(title)
        name = f"<b>{name}</b>" if title == current else name
        rows.append(
            f"<tr><td style='padding-right:0.6em'>{mark}</td><td style='padding-right:0.6em;white-space:nowrap'>{name}"
            f"</td><td style='opacity:0.75'>{sentence_html(view.state)}</td></tr>"
        )
    return _BLOCK.format(f"<table>{''.join(rows)}</table>")


def about_html(about: str) -> str:
    """Return what a step asks for."""
    return _BLOCK.format(f"<span style='opacity:0.75'>{sentence_html(about)}</span>")


def bar_html(share: float) -> str:
    """Return how much of the work under way is done, as a bar."""
    percent = 100.0 * min(max(share, 0.0), 1.0)
    return _BLOCK.format(
        "<div style='background:#343a40;border-radius:3px;height:6px'>"
        f"<div style='background:#4dabf7;border-radius:3px;height:6px;width:{percent:.0f}%'></div></div>"
    )


def remarks_html(problem: str, remarks: Sequence[Remark]) -> str:
    """Return what is missing or wrong, a paragraph each; a problem of the last press first."""
    said = [Remark(problem, "wrong"), *remarks] if problem else remarks
    return "".join(
        _BLOCK.format(f"<span style='color:{_COLORS[remark.tone]}'>{sentence_html(remark.text)}</span>")
        for remark in said
    )


def tables_html(tables: Sequence[Figures]) -> str:
    """Return figures as tables."""
    return "".join(_BLOCK.format(_table(table)) for table in tables)


def _table(table: Figures) -> str:
    cell = "<{0} style='text-align:left;overflow-wrap:normal;padding-right:0.7em;font-weight:{1}'>{2}</{0}>"
    head = "".join(cell.format("th", "normal;opacity:0.6", escape(text)) for text in table.headings)
    rows = ["".join(cell.format("td", "normal", escape(text)) for text in row) for row in table.rows]
    body = "".join(f"<tr>{row}</tr>" for row in (head, *rows))
    return f"<div style='font-weight:bold'>{escape(table.title)}</div><table>{body}</table>"


# Restarting the rig from the page, so that its services use the new calibration.

_READ_AT_START: Final = (
    *(CAMERAS_FILE, HAND_FILE, HEADSET_FILE, REGISTRATION_FILE),
    *map(registration_name, OBJECT_SOURCES),
)


class Sessions:
    """Restarts the session, and detects changed files that only a new session reads."""

    def __init__(self, context: StepContext) -> None:
        self._context = context
        self._stamps = self._now()
        self._begun = 0
        self._one_at_a_time = asyncio.Lock()

    def files_have_changed(self) -> bool:
        """Return whether a calibration file that is read at the start of a session has changed since the last look."""
        before, self._stamps = self._stamps, self._now()
        return self._stamps != before

    async def restart(self) -> str:
        """Start a new session and return its id.

        Raises:
            BusError: there is no router, or no service owns the rig clock.
        """
        async with self._one_at_a_time, await Bus.open(self._context.bus, timeout_s=CONNECT_S) as bus:
            self._begun += 1
            # Distinguishes two sessions within a second, which would otherwise have the same id.
            name = f"{new_session()}-{self._begun}"
            clock_s = 2.0
            delay_s = 0.5
            control = await broadcast(bus, "start", name, delay_s, clock_s)
        return control.session

    def _now(self) -> tuple[tuple[int, int], ...]:
        return tuple(file_stamp(self._context.rig_path / name) for name in _READ_AT_START)


# What stands before the cameras of a simulated rig: the one thing that no hand can do for them.

_CHOICES: Final = {
    "a hand that moves and grasps": "script",
    "a hand held still": "still",
    "a chessboard": "board",
    "a chessboard that lies on the desk": "desk_board",
    "a finger that touches the faces of a box": "touch",
    "two hands that touch and cross": "crossing",
    "a marker on the floor, seen from the headset": "headset",
}
"""Label to `[sim] motion`; every motion has a label."""


def is_simulated(config: RigConfig) -> bool:
    """Return whether a rig has cameras and all of them are simulated."""
    return bool(config.cameras) and all(camera.source == "simulated" for camera in config.cameras.values())


class SimulatedWorld:
    """A list to choose from; a choice is written into `rig.toml`, and counts from the next session on."""

    def __init__(self, rig_path: Path, config: RigConfig) -> None:
        self._rig_path = rig_path
        self._motion: str = config.sim.motion

    def build(self, gui: viser.GuiApi, page: Page, chosen: Callable[[str], None]) -> None:
        """Add the list; `chosen` takes another motion, for `choose`."""
        label = next(label for label, motion in _CHOICES.items() if motion == self._motion)
        choice = gui.add_dropdown(
            "cameras see", tuple(_CHOICES), initial_value=label, hint="This rig is simulated: what its cameras look at."
        )

        def on_choice(event: viser.GuiEvent[Any]) -> None:
            motion = _CHOICES[str(event.target.value)]
            if motion != self._motion:
                chosen(motion)

        choice.on_update(page.on_loop(on_choice))

    def choose(self, motion: str) -> None:
        """Let another thing stand before the cameras.

        Raises:
            ConfigError: `rig.toml` cannot be changed.
        """
        change_rig_file(self._rig_path, {("sim",): {"motion": motion}})
        self._motion = motion


logger = logging.getLogger(__name__)

_REMARKS_HEIGHT: Final = "5.5em"
_RESTART: Final = "restart the rig"
_RESTART_HINT: Final = "Begin a new session. Trying, saving and undoing cameras, hand and objects do so by themselves."

_FieldHandle = viser.GuiDropdownHandle[str] | viser.GuiTextHandle


@dataclass(slots=True)
class _StepParts:
    """The elements of one step; all are hidden while another step is shown."""

    step: CalibrationStep
    about: viser.GuiHtmlHandle
    remarks: viser.GuiHtmlHandle
    fields: dict[str, _FieldHandle]
    buttons: dict[str, viser.GuiButtonHandle]
    tables: viser.GuiHtmlHandle
    looks: tuple[viser.GuiButtonHandle, ...]
    folder: viser.GuiFolderHandle
    pictures: dict[str, viser.GuiImageHandle] = field(default_factory=dict)
    shown: dict[str, bytes] = field(default_factory=dict)
    values: Mapping[str, str] = field(default_factory=dict)
    problem: str = ""


class CalibratePanel:
    """A line per step, and below it the step that is chosen."""

    title = "Calibrate"

    def __init__(self, page: Page, scene: RigScene, feed: PictureFeed, context: StepContext, config: RigConfig) -> None:
        """Prepare the tab.

        Args:
            page: an open page.
            scene: its pictures can be clicked in.
            feed: of the pictures; a step may let them stand still.
            context: where the steps work.
            config: of the rig.
        """
        self._page = page
        self._scene = scene
        self._feed = feed
        self._context = context
        self._steps: dict[str, _StepParts] = {}
        self._current = ""
        self._chosen = asyncio.Event()
        self._work: asyncio.Queue[Callable[[], Any]] = asyncio.Queue()
        self._sessions = Sessions(context)
        self._world = SimulatedWorld(context.rig_path, config) if is_simulated(config) else None
        self._gui: viser.GuiApi | None = None
        scene.on_picture_click(self._clicked)

    def build(self, gui: viser.GuiApi) -> None:
        """Make the tab; the steps follow as soon as they are loaded."""
        self._gui = gui
        self._path = gui.add_html(about_html("The steps are being loaded …"))
        self._place = gui.add_folder(None)

    async def run(self) -> None:
        """Load the steps once somebody looks, then do what is pressed, until cancelled."""
        await self._page.looked_at()
        try:
            steps = await asyncio.to_thread(load_steps, self._context)
        except RhotError as error:
            self._path.content = remarks_html(str(error), ())
            return
        self._add_steps(steps)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._follow())
            while True:
                work = await self._work.get()
                tasks.create_task(work())

    def _add_steps(self, steps: Mapping[str, CalibrationStep]) -> None:
        gui = self._gui
        if gui is None:
            raise RuntimeError("run before build")
        with self._place:
            choice = gui.add_dropdown("step", tuple(steps), hint="One after the other; each may be done again.")
            choice.on_update(self._page.on_loop(lambda event: self._choose(str(event.target.value))))
            for title, step in steps.items():
                self._steps[title] = self._built(gui, title, step)
            if self._world is not None:
                self._world.build(
                    gui, self._page, lambda motion: self._work.put_nowait(partial(self._show_world, motion))
                )
            restart = gui.add_button(_RESTART, hint=_RESTART_HINT, icon=viser.Icon.REFRESH)
            restart.on_click(self._page.on_loop(lambda _: self._work.put_nowait(self._restart)))
            self._restarted = gui.add_html("")
        self._choose(next(iter(steps)))

    def _built(self, gui: viser.GuiApi, title: str, step: CalibrationStep) -> _StepParts:
        about = gui.add_html(about_html(step.about))
        remarks = gui.add_html("")
        looks = tuple(self._look_button(gui, camera) for camera in self._scene.cameras.planes)
        fields: dict[str, _FieldHandle] = {
            each.name: (
                gui.add_dropdown(each.label, each.choices, initial_value=each.value, hint=each.hint)
                if each.choices
                else gui.add_text(each.label, each.value, hint=each.hint)
            )
            for each in step.fields
        }
        buttons = {}
        for each in step.buttons:
            buttons[each.name] = gui.add_button(each.label, hint=each.hint or None, disabled=True)
            buttons[each.name].on_click(self._page.on_loop(partial(self._pressed, title, each.name)))
        tables = gui.add_html("")
        return _StepParts(step, about, remarks, fields, buttons, tables, looks, gui.add_folder(None))

    def _look_button(self, gui: viser.GuiApi, camera: str) -> viser.GuiButtonHandle:
        button = gui.add_button(f"look through {camera}", icon=viser.Icon.CAMERA)
        button.on_click(self._page.on_loop(lambda event: self._scene.fly(event.client, camera)))
        return button

    def _choose(self, title: str) -> None:
        self._current = title
        self._chosen.set()
        for name, parts in self._steps.items():
            shown = name == title
            for part in (parts.about, parts.remarks, parts.tables, parts.folder):
                part.visible = shown
            for handle in (*parts.fields.values(), *parts.buttons.values()):
                handle.visible = shown
            for look in parts.looks:
                look.visible = False
        self.update()

    def update(self) -> None:
        """Bring the path and the chosen step up to date."""
        if not self._steps:
            return
        views = {title: parts.step.view() for title, parts in self._steps.items()}
        self._path.content = path_html(views, self._current)
        view = views[self._current]
        self._show(self._steps[self._current], view)
        self._feed.hold(view.held)

    def _show(self, parts: _StepParts, view: StepView) -> None:
        # Room for some lines at all times: the buttons below would jump away under the pointer with each sentence.
        remarks = f"<div style='min-height:{_REMARKS_HEIGHT}'>{remarks_html(parts.problem, view.remarks)}</div>"
        parts.remarks.content = bar_html(view.share) + remarks
        parts.tables.content = tables_html(view.tables)
        for name, button in parts.buttons.items():
            button.disabled = name not in view.enabled
        for look in parts.looks:
            look.visible = bool(view.held)
        if view.values != parts.values:
            parts.values = dict(view.values)
            for name, value in view.values.items():
                parts.fields[name].value = value  # type: ignore[misc]  # viser's own setter
        self._show_pictures(parts, view.pictures)

    def _show_pictures(self, parts: _StepParts, pictures: Mapping[str, bytes]) -> None:
        if self._gui is None:
            return
        for title in [title for title in parts.pictures if title not in pictures]:
            parts.pictures.pop(title).remove()
            parts.shown.pop(title, None)
        for title, jpeg in pictures.items():
            if title not in parts.pictures:
                with parts.folder:
                    parts.pictures[title] = self._gui.add_image(dark_picture(4, 3), label=title, format="jpeg")
            if parts.shown.get(title) != jpeg:
                parts.shown[title] = jpeg
                show_jpeg(parts.pictures[title], jpeg)

    def _pressed(self, title: str, button: str, _: viser.GuiEvent[Any]) -> None:
        step = self._steps[title].step
        self._work.put_nowait(partial(self._do, title, lambda values: step.press(button, values)))

    def _clicked(self, camera: str, u: float, v: float) -> None:
        if self._feed.held:
            step = self._steps[self._current].step
            self._work.put_nowait(partial(self._do, self._current, lambda values: step.point(camera, u, v, values)))

    async def _do(self, title: str, work: Callable[[Mapping[str, str]], Any]) -> None:
        parts = self._steps[title]
        parts.problem = ""
        with self._telling(title):
            await work({name: str(handle.value) for name, handle in parts.fields.items()})
        if self._sessions.files_have_changed():
            await self._restart()
        parts.values = {}  # what the step has chosen is shown again, also where somebody had chosen otherwise
        self.update()

    @contextlib.contextmanager
    def _telling(self, title: str) -> Iterator[None]:
        """Show what goes wrong in a step: a fault of one step never costs the page that others look at."""
        try:
            yield
        except RhotError as error:
            self._steps[title].problem = str(error)
        except Exception as error:
            logger.exception("calibration step %s", title)
            said = f"{type(error).__name__}: {error}; this is a fault of the program, its log says more"
            self._steps[title].problem = said

    async def _look(self, title: str) -> None:
        with self._telling(title):
            await self._steps[title].step.follow()

    async def _follow(self) -> None:
        """Let the step that is chosen look at the rig, while somebody looks at the page."""
        while True:
            self._chosen.clear()
            await self._page.looked_at()
            looking = asyncio.create_task(self._look(self._current))
            try:
                await self._chosen.wait()
            finally:
                looking.cancel()
                await asyncio.gather(looking, return_exceptions=True)

    async def _show_world(self, motion: str) -> None:
        if self._world is None:
            return
        try:
            self._world.choose(motion)
        except RhotError as error:
            self._restarted.content = remarks_html(str(error), ())
        else:
            await self._restart()

    async def _restart(self) -> None:
        self._restarted.content = about_html("The rig restarts …")
        try:
            session = await self._sessions.restart()
        except RhotError as error:
            self._restarted.content = remarks_html(str(error), ())
        else:
            self._restarted.content = about_html(f"Session {session} runs with what the rig folder holds now.")
