"""What each camera sees, large: with the markers drawn in, or what one marker's colour takes in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from html import escape
from typing import Any, Final

import numpy as np
import viser

from rhot.messages import MarkerFrame
from rhot.rig.calibration import CameraCalibration
from rhot.rig.feet_config import FeetConfig
from rhot_viewer.browser.camera_layer import dark_picture, show_jpeg
from rhot_viewer.browser.page import Page
from rhot_viewer.browser.rig_scene import RigScene
from rhot_viewer.browser.sentence import sentence_html
from rhot_viewer.rig.inbox import Inbox
from rhot_viewer.rig.picture_feed import FEET_CAMERA, Picture, PictureFeed

ALL_MARKERS: Final = "all markers"
_FRAME_AGE_S: Final = 1.0
_REACH_PX: Final = 14.0
"""A marker is also meant by a click this far outside it: fingers on a tablet are not sharp."""
_HELP: Final = (
    "<div style='padding:0.2em 0.8em;font-size:0.85em;opacity:0.75'>Look through a camera, then click a marker in its "
    "picture: its mask is shown, all pixels outside its colour go dark. A click outside all markers "
    "shows the markers again.</div>"
)
_FEET_HELP: Final = (
    "<div style='padding:0.2em 0.8em;font-size:0.85em;opacity:0.75'>The feet: markers that are believed have the "
    "foot's colour, others are red; a foot's shape in the depth picture is tinted; outside of its ellipse nothing is "
    "taken for it.</div>"
)


class PicturesPanel:
    """A picture per camera, a choice of masks, and a way to stand where a camera stands."""

    title = "Pictures"

    def __init__(
        self,
        page: Page,
        scene: RigScene,
        inbox: Inbox,
        cameras: Mapping[str, CameraCalibration],
        markers: Iterable[str],
        feet: FeetConfig | None = None,
    ) -> None:
        """Prepare the tab.

        Args:
            page: an open page.
            scene: shows the pictures, too.
            inbox: what the cameras have found.
            cameras: that look at hands.
            markers: of the hands.
            feet: `[feet]` of the rig; its camera moves with the head, so nobody can stand where it stands.
        """
        self._page = page
        self._scene = scene
        self._inbox = inbox
        self._cameras = cameras
        self._markers = tuple(markers)
        self._choice: viser.GuiDropdownHandle[Any] | None = None
        self._pictures: dict[str, viser.GuiImageHandle] = {}
        self._notes: dict[str, viser.GuiHtmlHandle] = {}
        self._sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
        if feet is not None:
            self._sizes[FEET_CAMERA] = (feet.camera.width, feet.camera.height)
        self.feed = PictureFeed(self._sizes, self.show)
        scene.on_picture_click(self._clicked)

    def build(self, gui: viser.GuiApi) -> None:
        """Add the choice, then picture after picture."""
        if self._cameras:
            self._choice = gui.add_dropdown(
                "show", (ALL_MARKERS, *self._markers), hint="All markers, or the mask of one marker."
            )
            self._choice.on_update(self._page.on_loop(self._chosen))
            gui.add_html(_HELP)
        for name, size in self._sizes.items():
            if name in self._cameras:
                look = gui.add_button(f"look through {name}", icon=viser.Icon.CAMERA)
                look.on_click(self._page.on_loop(self._fly_to(name)))
                self._page.for_everyone(look)
            else:
                gui.add_html(_FEET_HELP)
            self._pictures[name] = gui.add_image(dark_picture(*size), format="jpeg")
            self._notes[name] = gui.add_html("")

    def update(self) -> None:
        """Nothing: pictures come by themselves."""

    def show(self, camera: str, picture: Picture) -> None:
        """Show what a camera answered, here and in the scene."""
        self._notes[camera].content = (
            f"<div style='padding:0 0.8em;color:#e8590c'>{escape(camera)}: {sentence_html(picture.problem)}</div>"
            if picture.problem
            else ""
        )
        if picture.jpeg:
            show_jpeg(self._pictures[camera], picture.jpeg)
            if self._scene.shown.cameras and camera in self._cameras:
                self._scene.cameras.show_picture(camera, picture.jpeg)

    def select(self, marker: str | None) -> None:
        """Show the mask of a marker in all pictures, or the markers."""
        if self._choice is not None:
            self._choice.value = marker or ALL_MARKERS  # type: ignore[misc]  # viser's own setter
        self.feed.select(marker)

    def _chosen(self, event: viser.GuiEvent[Any]) -> None:
        value = event.target.value
        self.feed.select(None if value == ALL_MARKERS else str(value))

    def _clicked(self, camera: str, u: float, v: float) -> None:
        if self.feed.held:
            return  # a click in a picture that stands still is meant for whoever holds it
        frame = self._inbox.newest(f"rhot/markers/{camera}", MarkerFrame, _FRAME_AGE_S)
        self.select(None if frame is None else marker_at(frame, u, v))

    def _fly_to(self, camera: str) -> Callable[[viser.GuiEvent[Any]], None]:
        return lambda event: self._scene.fly(event.client, camera)


def marker_at(frame: MarkerFrame, u: float, v: float) -> str | None:
    """Return the marker at a raw pixel, the nearest of those within reach; None when none is there."""
    within = {
        name: distance
        for name, marker in frame.markers.items()
        if (distance := float(np.hypot(marker.u - u, marker.v - v))) <= np.sqrt(marker.area / np.pi) + _REACH_PX
    }
    return min(within, key=within.__getitem__) if within else None
