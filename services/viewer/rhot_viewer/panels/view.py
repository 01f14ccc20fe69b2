"""Where to look from, and what to show."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import viser

from rhot_viewer.browser.page import Page
from rhot_viewer.browser.rig_scene import RigScene

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
