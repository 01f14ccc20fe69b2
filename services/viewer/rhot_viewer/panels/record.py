"""The tab that records the running rig and explains a moment of the last recording."""

from __future__ import annotations

import asyncio
from html import escape
from pathlib import Path
from typing import Any, Final

import viser

from rhot.errors import RhotError
from rhot_viewer.browser.page import Page
from rhot_viewer.browser.sentence import sentence_html
from rhot_viewer.rig.live_recording import LiveRecording, explain

_TEXT: Final = "<div style='padding:0.2em 0.8em;font-size:0.9em;overflow-wrap:anywhere;color:{color}'>{text}</div>"
_BAD: Final = "#ff6b6b"
_HELP: Final = (
    "Everything that the rig publishes, without its pictures; `rhot replay` plays it back, `rhot export` makes tables "
    "and animations of it."
)


class RecordPanel:
    """A button to start and stop, what is being written, and a button that explains."""

    title = "Record"

    def __init__(self, page: Page, recording: LiveRecording, rig_path: Path) -> None:
        self._page = page
        self._recording = recording
        self._rig_path = rig_path
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

    async def run(self) -> None:
        """Explain what is asked for, until cancelled."""
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
