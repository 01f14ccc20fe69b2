"""Small tabs of the page: recording, the last two minutes of each service, and where to look from."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from html import escape
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import viser
from pydantic import ValidationError
from viser import uplot

from rhot.bus import Bus
from rhot.errors import RhotError
from rhot.messages import first_problem
from rhot.operation.control import EventPublisher
from rhot_viewer.browser.page import Page
from rhot_viewer.browser.rig_scene import RigScene
from rhot_viewer.browser.sentence import sentence_html
from rhot_viewer.rig.inbox import SECONDS, Chart, History
from rhot_viewer.rig.live_recording import LiveRecording, explain

# The tab that records the running rig and explains a moment of the last recording.

_TEXT: Final = "<div style='padding:0.2em 0.8em;font-size:0.9em;overflow-wrap:anywhere;color:{color}'>{text}</div>"
_BAD: Final = "#ff6b6b"
_HELP: Final = (
    "Everything that the rig publishes, without its pictures; `rhot replay` plays it back, `rhot export` makes tables "
    "and animations of it."
)


class RecordPanel:
    """A button to start and stop, what is being written, marks, and a button that explains."""

    title = "Record"

    def __init__(self, page: Page, recording: LiveRecording, rig_path: Path) -> None:
        self._page = page
        self._recording = recording
        self._rig_path = rig_path
        self._marks = Marks(page)
        self._asked: asyncio.Queue[tuple[Path, str]] = asyncio.Queue()
        self._explained = ""

    def build(self, gui: viser.GuiApi) -> None:
        """Add the elements."""
        gui.add_html(_TEXT.format(color="inherit", text=sentence_html(_HELP)))
        where = f"Below {self._recording.folder.resolve()} on the machine that runs this page; may be empty."
        self._folder = gui.add_text("folder", "", hint=where)
        self._start = gui.add_button("start recording", icon=viser.Icon.PLAYER_RECORD)
        self._start.on_click(self._page.on_loop(lambda _: self._recording.start(self._folder.value)))
        self._stop = gui.add_button("stop recording", icon=viser.Icon.PLAYER_STOP, disabled=True)
        self._stop.on_click(self._page.on_loop(lambda _: self._recording.stop()))
        self._state = gui.add_html("")
        with gui.add_folder("Mark a moment"):
            self._marks.build(gui)
        with gui.add_folder("Explain a moment of the last recording"):
            self._at = gui.add_text("at, s", "1", hint="Seconds after the first picture of the recording.")
            self._explain = gui.add_button("explain", disabled=True)
            self._explain.on_click(self._page.on_loop(self._ask))
            self._note = gui.add_html("")

    def update(self) -> None:
        """Show what is written."""
        recording = self._recording
        self._start.disabled = recording.running
        self._stop.disabled = not recording.running
        self._explain.disabled = recording.running or recording.file is None
        self._state.content = _state_html(recording)
        self._note.content = self._explained
        self._marks.update()

    async def run(self, bus: Bus) -> None:
        """Publish what is marked, and explain what is asked for, until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._marks.run(bus))
            tasks.create_task(self._explain_all())

    async def _explain_all(self) -> None:
        while True:
            file, at = await self._asked.get()
            self._explained = _TEXT.format(color="inherit", text="tracking the seconds before …")
            try:
                page = await explain(file, at, self._rig_path)
            except RhotError as error:
                self._explained = _TEXT.format(color=_BAD, text=sentence_html(str(error)))
            else:
                text = f"Written, to open in a browser or to attach to a report: {page.resolve()}"
                self._explained = _TEXT.format(color="inherit", text=escape(text))

    def _ask(self, _: viser.GuiEvent[Any]) -> None:
        if self._recording.file is not None and not self._recording.running:
            self._asked.put_nowait((self._recording.file, self._at.value.strip()))


def _state_html(recording: LiveRecording) -> str:
    said = []
    if recording.problem:
        said.append(_TEXT.format(color=_BAD, text=sentence_html(recording.problem)))
    if recording.file is not None:
        figures = (
            f"{recording.file.resolve()}: {recording.seconds:.0f} s, {recording.megabytes:.1f} MB, "
            f"{recording.tally.messages} messages, {recording.rate_hz:.0f} a second, {recording.tally.lost} lost"
        )
        said.append(_TEXT.format(color="#69db7c" if recording.running else "inherit", text=escape(figures)))
    return "".join(said)


# The marks of the tab that records: a moment gets a label by a key or a click.

_KEYS: Final = ("1", "2", "3", "4", "5", "6", "7", "8", "9")
_FIRST_LABELS: Final = "start, grasp, release, end"
_LATE_S: Final = 0.15
"""Between the press of a key and its message here, at most, seconds: of 40 in a Chromium that drew without a GPU, the
median was 0.045 and the last 0.12. viser sends no time of its own.
"""
_HELD_NS: Final = 100_000_000
"""A key that is held repeats 15 to 60 times a second; nobody presses one again so soon."""


class Marks:
    """Labels, a button for each, and the keys 1 to 9; publishes `rhot/event` with the moment of the press."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._pressed: asyncio.Queue[tuple[str, int]] = asyncio.Queue()
        self._said = ""

    def build(self, gui: viser.GuiApi) -> None:
        """Add the elements."""
        hint = f"Up to {len(_KEYS)}, with commas between them; the keys 1 to {len(_KEYS)} mark them, too."
        self._text = gui.add_text("labels", _FIRST_LABELS, hint=hint)
        self._text.on_update(self._page.on_loop(lambda _: self._rename()))
        self._buttons = gui.add_button_group("mark", _labels(_FIRST_LABELS))
        self._buttons.on_click(self._page.with_moment(self._clicked))
        self._commands = [gui.add_command(f"mark {key}", hotkey=key) for key in _KEYS]
        for number, command in enumerate(self._commands):
            command.on_trigger(self._page.with_moment(self._key(number)))
        self._state = gui.add_html("")
        self._rename()

    def update(self) -> None:
        """Show what was marked last."""
        self._state.content = self._said

    async def run(self, bus: Bus) -> None:
        """Publish what is marked, until cancelled."""
        events = EventPublisher(bus)
        while True:
            label, at_ns = await self._pressed.get()
            try:
                event = await events.put(label, "page", at_ns=at_ns, late_s=_LATE_S)
            except ValidationError as error:
                self._said = _TEXT.format(color=_BAD, text=sentence_html(first_problem(error)))
            except RhotError as error:
                self._said = _TEXT.format(color=_BAD, text=sentence_html(f"{label} is not marked: {error}"))
            else:
                when = time.strftime("%H:%M:%S", time.localtime(at_ns // 10**9))
                self._said = _TEXT.format(color="inherit", text=escape(f"marked at {when}: {event.label}"))

    def _rename(self) -> None:
        self._buttons.options = labels = _labels(self._text.value)
        for command, label in zip_longest(self._commands, labels):
            command.disabled, command.label = label is None, f"mark {label or 'nothing'}"

    def _clicked(self, event: viser.GuiEvent[Any], at_ns: int) -> None:
        self._pressed.put_nowait((event.target.value, at_ns))

    def _key(self, number: int) -> Callable[[object, int], None]:
        last_ns = 0

        def pressed(_: object, at_ns: int) -> None:
            nonlocal last_ns
            labels, before_ns, last_ns = self._buttons.options, last_ns, at_ns
            if number < len(labels) and at_ns - before_ns > _HELD_NS:
                self._pressed.put_nowait((labels[number], at_ns))

        return pressed


def _labels(text: str) -> tuple[str, ...]:
    """Return the labels in a user's text; there is always one."""
    return tuple(filter(None, map(str.strip, text.split(","))))[: len(_KEYS)] or ("mark",)


# The last two minutes: rate, latency, losses and error, a line per service.

_CHARTS: Final = {
    "rate": "messages per second",
    "latency": "latency p99, ms",
    "lost": "lost per second (late, missed, invalid, overwritten)",
    "error": "error, mm",
}
_COLORS: Final = ("#4dabf7", "#ffa94d", "#69db7c", "#f783ac", "#b197fc", "#ffe066", "#63e6be", "#ff8787", "#ced4da")
_AXIS: Final = uplot.Axis(stroke="#adb5bd", grid={"stroke": "#373a40"}, ticks={"stroke": "#373a40"})
_NOTHING: Final = "nothing yet"


class TimelinePanel:
    """Four charts."""

    title = "Timeline"

    def __init__(self, history: History) -> None:
        self._history = history
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._drawn: dict[str, tuple[str, ...]] = {}
        self._colors: dict[str, str] = {}

    def build(self, gui: viser.GuiApi) -> None:
        """Add the charts, empty."""
        for kind, title in _CHARTS.items():
            data, names = self._data(self._history.chart(kind))
            self._drawn[kind] = names
            height_px = 190
            self._plots[kind] = gui.add_uplot(
                data,
                self._series(names),
                title=title,
                height=height_px,
                axes=(_AXIS, _AXIS),
                scales={"x": uplot.Scale(time=False, range=(-float(SECONDS), 0.0))},
                legend=uplot.Legend(show=True, live=False),
            )

    def update(self) -> None:
        """Draw what has been added."""
        for kind, plot in self._plots.items():
            data, names = self._data(self._history.chart(kind))
            if names != self._drawn[kind]:
                self._drawn[kind] = names
                plot.series = self._series(names)
            plot.data = data

    def _data(
        self, chart: Chart
    ) -> tuple[tuple[np.ndarray[tuple[int, ...], np.dtype[np.float64]], ...], tuple[str, ...]]:
        rows = chart.rows or {_NOTHING: np.zeros(len(chart.x_s))}
        return (chart.x_s, *rows.values()), tuple(rows)

    def _series(self, names: tuple[str, ...]) -> tuple[uplot.Series, ...]:
        for name in names:
            self._colors.setdefault(name, _COLORS[len(self._colors) % len(_COLORS)])
        lines = [
            uplot.Series(label=name, stroke=self._colors[name], width=1.5, points={"show": False}) for name in names
        ]
        return (uplot.Series(label="s"), *lines)


# What a tab of the page's panel is.


class Panel(Protocol):
    """One tab; made once, for all browsers.

    viser calls back on threads of its own: a panel wraps its callbacks in `Page.on_loop`, so that everything of ours
    runs on one event loop.
    """

    @property
    def title(self) -> str:
        """Label of the tab, one word."""
        ...

    def build(self, gui: viser.GuiApi) -> None:
        """Add the tab's elements; called inside the tab."""
        ...

    def update(self) -> None:
        """Bring the elements up to date; called four times a second while a browser is connected."""
        ...


# Where to look from, and what to show.

_SWITCHES: Final = {
    "ghost": ("truth as a ghost", "In simulation: where the hand truly is at this moment."),
    "markers": ("marker points", "Where fusion sees the markers, in their colours; small = predicted."),
    "trails": ("trails", "The fingertips' paths of the last two seconds."),
    "cameras": ("cameras", "Their views and live pictures."),
    "limits": ("joint limits", "How far each joint may bend: what the tracker obeys."),
    "volume": ("volume", "The box in which fusion believes points."),
}
_KEY: Final = (
    "<div style='padding:0.2em 0.8em;font-size:0.9em;line-height:1.6'>"
    "<span style='color:#e2b896'>●</span> right hand, <span style='color:#c4b0d0'>●</span> left hand<br>"
    "<span style='color:#96beeb'>●</span> predicted, not seen at this moment<br>"
    "<span style='color:#78cd8c'>●</span> truth (simulation only)<br>"
    "<span style='color:#f0c85a'>●</span> how far each joint may bend (<i>joint limits</i>)</div>"
)


class ViewPanel:
    """Buttons that fly, switches, and what the colours mean."""

    title = "View"

    def __init__(self, page: Page, scene: RigScene) -> None:
        self._page = page
        self._scene = scene

    def build(self, gui: viser.GuiApi) -> None:
        """Add buttons, switches and the key."""
        for label, where in (("whole rig", "overview"), ("hand", "hand")):
            self._add(gui, label, where)
        for camera in self._scene.cameras.planes:
            self._add(gui, f"through camera {camera}", camera)
        for name, (label, hint) in _SWITCHES.items():
            switch = gui.add_checkbox(label, initial_value=getattr(self._scene.shown, name), hint=hint)
            switch.on_update(self._page.on_loop(self._set(name)))
        gui.add_html(_KEY)

    def _add(self, gui: viser.GuiApi, label: str, where: str) -> None:
        button = gui.add_button(label)
        button.on_click(self._page.on_loop(self._fly_to(where)))
        self._page.for_everyone(button)

    def update(self) -> None:
        """Nothing changes by itself."""

    def _fly_to(self, where: str) -> Callable[[viser.GuiEvent[Any]], None]:
        return lambda event: self._scene.fly(event.client, where)

    def _set(self, name: str) -> Callable[[viser.GuiEvent[Any]], None]:
        def switched(event: viser.GuiEvent[Any]) -> None:
            setattr(self._scene.shown, name, bool(event.target.value))
            self._scene.set_visible()

        return switched
