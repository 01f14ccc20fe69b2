"""Sliders that act on the running capture services."""

from __future__ import annotations

import colorsys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import viser

from rhot.messages import ServiceStatus
from rhot_viewer.browser.page import Page
from rhot_viewer.browser.sentence import sentence_html
from rhot_viewer.rig.capture_settings import CameraSlider, CaptureSettings, camera_sliders
from rhot_viewer.rig.inbox import Inbox

# The bounds of one marker's colour as three sliders with two ends each, and back.

Ends = tuple[float, float]

HUE_LOW_DEG: Final = -180.0
"""The slider of hues begins here, so that red, which lies about 0, is one stretch and not two."""
HUE_HIGH_DEG: Final = 360.0
_TURN_DEG: Final = 360.0


@dataclass(frozen=True, slots=True)
class BoundsSliders:
    """Where the sliders stand.

    Attributes:
        hue_deg: from, to; from `HUE_LOW_DEG` to `HUE_HIGH_DEG`, the first not above the second.
        saturation, value: lowest and highest, 0 to 1.
        in_force: they decide in place of the learned colour.
    """

    hue_deg: Ends
    saturation: Ends
    value: Ends
    in_force: bool


def sliders_of(settings: Mapping[str, Any], marker: str) -> BoundsSliders | None:
    """Return where the sliders stand for a camera's settings; None where these hold no bounds of the marker."""
    try:
        bounds = settings["bounds"][marker]
        start, end = (float(each) for each in bounds["hue_deg"])
        saturation, value = (tuple(float(each) for each in bounds[name]) for name in ("saturation", "value"))
        if start > end:
            start -= _TURN_DEG
        if start < HUE_LOW_DEG:
            start, end = start + _TURN_DEG, end + _TURN_DEG
        return BoundsSliders(
            (start, min(end, HUE_HIGH_DEG)),
            (saturation[0], saturation[1]),
            (value[0], value[1]),
            bool(bounds["in_force"]),
        )
    except (KeyError, TypeError, ValueError, IndexError):
        return None


def bounds_html(sliders: BoundsSliders) -> str:
    """Return the bounds as numbers beside the colours that lie between them, HTML: the sliders show neither."""
    (start, end), (dull, pure), (dark, bright) = sliders.hue_deg, sliders.saturation, sliders.value
    stops = ", ".join(
        _css(start + share * (end - start), dull + share * (pure - dull), dark + share * (bright - dark))
        for share in (0.0, 0.25, 0.5, 0.75, 1.0)
    )
    return (
        "<div style='padding:0.2em 0.8em;font-size:0.85em'>"
        f"<div style='height:0.9em;border-radius:0.3em;background:linear-gradient(90deg, {stops})'></div>"
        f"hue {start:.0f} to {end:.0f}°, saturation {dull:.2f} to {pure:.2f}, value {dark:.2f} to {bright:.2f}</div>"
    )


def _css(hue_deg: float, saturation: float, value: float) -> str:
    rgb = colorsys.hsv_to_rgb(hue_deg % _TURN_DEG / _TURN_DEG, saturation, value)
    return f"rgb({', '.join(str(round(255 * part)) for part in rgb)})"


def change_to(marker: str, sliders: BoundsSliders) -> dict[str, Any]:
    """Return the change of a camera's settings that sliders ask for."""
    start, end = sliders.hue_deg
    whole = end - start >= _TURN_DEG
    hue = [0.0, _TURN_DEG] if whole else [start % _TURN_DEG, end % _TURN_DEG if end < 0.0 else min(end, _TURN_DEG)]
    bounds = {
        "hue_deg": hue,
        "saturation": list(sliders.saturation),
        "value": list(sliders.value),
        "in_force": sliders.in_force,
    }
    return {"bounds": {marker: bounds}}


# The bounds of one camera's colours, seen and moved.

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


_HELD_S: Final = 0.8
"""A slider that somebody has moved in this time is left alone: it would jump under their finger."""
_NOTE: Final = "<div style='padding:0.1em 0.8em;font-size:0.9em;color:{color};overflow-wrap:anywhere'>{text}</div>"


@dataclass(slots=True)
class _CameraFolder:
    sliders: dict[CameraSlider, viser.GuiSliderHandle[float]]
    bounds: ColorBoundsFolder
    note: viser.GuiHtmlHandle
    shown_version: int = 0
    moved_at: float = field(default=-_HELD_S)
    digest: str = ""


class CamerasPanel:
    """Exposure, gain, white balance, picture and colours of every camera."""

    title = "Cameras"

    def __init__(
        self,
        page: Page,
        settings: CaptureSettings,
        inbox: Inbox,
        markers: Sequence[str],
        choose: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._page = page
        self._markers = tuple(markers)
        self._choose = choose
        self._settings = settings
        self._inbox = inbox
        self._sliders = camera_sliders(markers)
        self._folders: dict[str, _CameraFolder] = {}

    def build(self, gui: viser.GuiApi) -> None:
        """Add a folder per camera; the sliders stay grey until the camera has sent its settings."""
        text = (
            "The sliders act at once, until the service restarts. To keep exposure, gain, white balance and picture, "
            "save them in the first step of the tab Calibrate."
        )
        gui.add_html(_NOTE.format(color="inherit", text=text))
        for index, camera in enumerate(self._settings.cameras):
            with gui.add_folder(f"Camera {camera}", expand_by_default=index == 0):
                note = gui.add_html("")
                optics = [slider for slider in self._sliders if not isinstance(slider.part, str)]
                handles = {slider: self._add(gui, camera, slider) for slider in optics}
                with gui.add_folder("Colour thresholds"):
                    thresholds = [slider for slider in self._sliders if isinstance(slider.part, str)]
                    handles |= {slider: self._add(gui, camera, slider) for slider in thresholds}
                with gui.add_folder("Colour bounds", expand_by_default=False):
                    bounds = self._bounds(camera)
                    bounds.build(gui)
            self._folders[camera] = _CameraFolder(handles, bounds, note)

    def _bounds(self, camera: str) -> ColorBoundsFolder:
        def ask(change: Mapping[str, Any]) -> None:
            self._folders[camera].moved_at = time.monotonic()
            self._settings.ask(camera, change)

        return ColorBoundsFolder(
            self._page, self._markers, ask, lambda: self._settings.keep_bounds(camera), self._choose
        )

    def _add(self, gui: viser.GuiApi, camera: str, slider: CameraSlider) -> viser.GuiSliderHandle[float]:
        handle = gui.add_slider(
            slider.label, slider.low, slider.high, slider.step, slider.low, hint=slider.hint, disabled=True
        )
        handle.on_update(self._page.on_loop(self._moved(camera, slider)))
        return handle

    def _moved(self, camera: str, slider: CameraSlider) -> Callable[[viser.GuiEvent[Any]], None]:
        def moved(event: viser.GuiEvent[Any]) -> None:
            settings = self._settings.cameras[camera].settings
            # Without a browser it was moved by us, to where the camera says it stands.
            if event.client_id is None or slider.value_in(settings) is None:
                return
            self._folders[camera].moved_at = time.monotonic()
            self._settings.ask(camera, slider.change_to(float(event.target.value), settings))

        return moved

    def update(self) -> None:
        """Bring sliders to where the cameras stand; a refused one goes back and says why."""
        for camera, folder in self._folders.items():
            self._read_again(camera, folder)
            state = self._settings.cameras[camera]
            held = time.monotonic() - folder.moved_at < _HELD_S or self._settings.is_asked(camera)
            if held or state.version == folder.shown_version:
                continue
            folder.shown_version = state.version
            folder.note.content = (
                _NOTE.format(color="#ff6b6b", text=sentence_html(state.refusal)) if state.refusal else ""
            )
            folder.bounds.show(state.settings)
            for slider, handle in folder.sliders.items():
                value = slider.value_in(state.settings)
                handle.disabled = value is None
                if value is not None:
                    handle.value = value  # type: ignore[misc]  # viser's own setter

    def _read_again(self, camera: str, folder: _CameraFolder) -> None:
        """Ask for the settings when the camera appears and when its status says that they changed, until it answers."""
        status_age_s = 5.0
        status = self._inbox.newest(f"rhot/status/capture/{camera}", ServiceStatus, status_age_s)
        digest = "" if status is None else status.config_digest
        unread = self._settings.cameras[camera].unread and not self._settings.is_asked(camera)
        if digest and (digest != folder.digest or unread):
            self._settings.ask(camera, {})
        folder.digest = digest
