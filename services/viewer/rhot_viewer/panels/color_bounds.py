"""The bounds of one camera's colours, seen and moved."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import viser

from rhot_viewer.browser.page import Page
from rhot_viewer.rig.color_bounds import HUE_HIGH_DEG, HUE_LOW_DEG, BoundsSliders, bounds_html, change_to, sliders_of

_ABOUT: Final = (
    "<div style='padding:0.1em 0.8em;font-size:0.85em;opacity:0.75'>Colour bounds of a marker. Move an end, and "
    "these bounds replace the learned colour; the tab Pictures shows the selected pixels. Untick "
    "<i>in force</i> to return to the learned colour. <i>save bounds</i> writes colors.json for all cameras that "
    "share the rig folder.</div>"
)


class ColorBoundsFolder:
    """A marker, three sliders with two ends, whether they are in force, and a button that keeps them.

    Args:
        page: whose loop runs the callbacks.
        ask: changes the camera's settings.
        save: keeps the bounds in force.
        choose: called with the marker that somebody looks at.
    """

    def __init__(
        self,
        page: Page,
        markers: Sequence[str],
        ask: Callable[[Mapping[str, Any]], None],
        save: Callable[[], None],
        choose: Callable[[str], None],
    ) -> None:
        self._page = page
        self._markers = tuple(markers)
        self._ask = ask
        self._save = save
        self._choose = choose
        self._settings: Mapping[str, Any] = {}

    def build(self, gui: viser.GuiApi) -> None:
        """Add the elements; all stay grey until the camera has sent its settings."""
        gui.add_html(_ABOUT)
        self._marker = gui.add_dropdown("marker", self._markers, hint="Whose colour.")
        self._hue = self._slider(gui, "hue °", HUE_LOW_DEG, HUE_HIGH_DEG, 1.0, "0 is red, 120 green, 240 blue.")
        self._saturation = self._slider(gui, "saturation", 0.0, 1.0, 0.01, "0 is grey, 1 is pure.")
        self._value = self._slider(gui, "value", 0.0, 1.0, 0.01, "0 is black, 1 is bright.")
        self._shown_bounds = gui.add_html("")
        self._in_force = gui.add_checkbox("in force", False, disabled=True, hint="Off: the learned colour decides.")
        keep = gui.add_button("save bounds", icon=viser.Icon.DEVICE_FLOPPY)
        self._marker.on_update(self._page.on_loop(self._chosen))
        for slider in self._sliders:
            slider.on_update(self._page.on_loop(lambda event: self._moved(event, True)))
        self._in_force.on_update(self._page.on_loop(lambda event: self._moved(event, bool(event.target.value))))
        keep.on_click(self._page.on_loop(lambda _: self._save()))

    def show(self, settings: Mapping[str, Any]) -> None:
        """Bring the elements to where a camera's settings stand."""
        self._settings = settings
        where = sliders_of(settings, self._marker.value)
        for element in (*self._sliders, self._in_force):
            element.disabled = where is None
        if where is not None:
            for slider, ends in zip(self._sliders, (where.hue_deg, where.saturation, where.value), strict=True):
                slider.value = ends  # type: ignore[misc]  # viser's own setter
            self._shown_bounds.content = bounds_html(where)
            self._in_force.value = where.in_force  # type: ignore[misc]  # viser's own setter

    @property
    def _sliders(self) -> tuple[viser.GuiMultiSliderHandle[float], ...]:
        return self._hue, self._saturation, self._value

    def _slider(
        self, gui: viser.GuiApi, label: str, low: float, high: float, step: float, hint: str
    ) -> viser.GuiMultiSliderHandle[float]:
        return gui.add_multi_slider(label, low, high, step, (low, high), hint=hint, disabled=True)

    def _chosen(self, event: viser.GuiEvent[Any]) -> None:
        self.show(self._settings)
        if event.client_id is not None:
            self._choose(self._marker.value)

    def _moved(self, event: viser.GuiEvent[Any], in_force: bool) -> None:
        # Without a browser it was moved by us, to where the camera says it stands.
        if event.client_id is None or sliders_of(self._settings, self._marker.value) is None:
            return
        ends = [(float(slider.value[0]), float(slider.value[1])) for slider in self._sliders]
        self._ask(change_to(self._marker.value, BoundsSliders(ends[0], ends[1], ends[2], in_force)))
