"""The page's step that learns colours from clicks, over the functions of `rhot calibrate colors`."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.calibration_step import Button, Field, Figures, Remark, Room, StepView
from rhot.errors import CalibrationError, RhotError
from rhot.rig.colors import ColorsFile
from rhot.rig.config import MarkerConfig
from rhot.rig.folder import load_rig
from rhot.rig.kept_file import KeptFile
from rhot_capture.color_calibration import ColorCalibration, calibrate
from rhot_capture.color_console import suggestions, warnings
from rhot_capture.color_live import live_pictures
from rhot_capture.color_picks import Place
from rhot_capture.color_report import overlay_picture
from rhot_capture.color_table import ColorTable, ImageArray, build_color_table
from rhot_capture.detector import Detection, MarkerDetector
from rhot_capture.preview import preview_jpeg

MAX_ROUNDS: Final = 4
"""So many looks at all cameras are learnt from together; each makes the fit slower."""
_MARKER: Final = "marker"
_OVERLAY_WIDTH: Final = 480


@dataclass(frozen=True, slots=True)
class _Learnt:
    """What the clicks so far give."""

    result: ColorCalibration
    table: ColorTable
    detections: list[dict[str, Detection]]
    remarks: tuple[Remark, ...]


@dataclass(frozen=True, slots=True)
class _Picture:
    """One picture to click in: whose it is, its pixels, and what was clicked so far."""

    camera: str
    image: ImageArray
    places: dict[str, Place]


class ColorStep:
    """Clicks set colours; see `rhot.calibration_step.CalibrationStep` for the seam."""

    about = (
        "Hold the painted hand so that both cameras see all markers, and take the pictures; they stand still then. "
        "Look through a camera, choose a marker and click its paint in the picture; the next one is chosen for you. "
        "Do it for every camera. Masks, and how well the colours can be told apart, appear at once. More pictures, in "
        "another light, make the colours robust. Try them on the running cameras, then save."
    )
    buttons = (
        Button("take", "take pictures", "One of each camera; hold still. Again = more pictures, the clicks are kept."),
        Button("unclick", "take the last click back"),
        Button("anew", "begin anew", "Forget pictures and clicks."),
        Button("try", "try", "The running cameras take the colours over; nothing is final."),
        Button("save", "save", "Keep what is tried."),
        Button("undo", "undo", "Bring the former colours back."),
    )

    def __init__(self, room: Room) -> None:
        self._room = room
        rig = load_rig(room.rig_path)
        self._markers: dict[str, MarkerConfig] = dict(rig.config.markers)
        self._cameras = tuple(rig.config.cameras)
        self._remote = any(camera.source != "simulated" for camera in rig.config.cameras.values())
        self._kept = KeptFile(rig.colors_path, ColorsFile)
        self.fields = (
            Field(_MARKER, "marker", next(iter(self._markers)), tuple(self._markers), "The marker to click next."),
        )
        self._pictures: list[_Picture] = []
        self._clicks: list[tuple[_Picture, str]] = []
        self._learnt: _Learnt | None = None
        self._next = next(iter(self._markers))
        self._doing = ""
        self._shown: dict[str, bytes] = {}
        self._held: dict[str, bytes] = {}
        self._problem = ""
        self._clicked = asyncio.Event()

    def view(self) -> StepView:
        """Return pictures, figures and what is missing."""
        picked = {name for each in self._pictures for name in each.places}
        missing = [name for name in self._markers if name not in picked]
        enabled = {"take"} if len(self._pictures) < MAX_ROUNDS * len(self._cameras) else set()
        enabled |= {"anew"} if self._pictures else set()
        enabled |= {"unclick"} if self._clicks else set()
        enabled |= {"try"} if self._learnt is not None else set()
        enabled |= {"save"} if self._kept.on_trial else set()
        enabled |= {"undo"} if self._kept.can_undo else set()
        learnt = self._learnt
        return StepView(
            self._state(),
            self._is_done(),
            share=len(picked) / len(self._markers),
            remarks=(
                *([Remark(self._problem, "wrong")] if self._problem else self._todo(missing)),
                *(learnt.remarks if learnt is not None else ()),
            ),
            enabled=frozenset(enabled),
            tables=() if learnt is None else (_table(learnt),),
            pictures=dict(self._shown),
            held=dict(self._held),
            values={_MARKER: self._next},
        )

    async def follow(self) -> None:
        """Learn from the clicks whenever there are new ones; those that come meanwhile are learnt from together."""
        while True:
            await self._clicked.wait()
            self._clicked.clear()
            await self._learn()

    def _state(self) -> str:
        if self._doing:
            return self._doing
        try:
            stored = self._kept.content
        except RhotError as error:
            return str(error)
        if stored is None or not stored.markers:
            return "no colours yet"
        missing = [name for name in self._markers if name not in stored.markers]
        text = f"{len(self._markers) - len(missing)} of {len(self._markers)} markers have a colour"
        return f"{text}, on trial" if self._kept.on_trial else f"{text}, saved {stored.date}"

    def _is_done(self) -> bool:
        try:
            stored = self._kept.content
        except RhotError:
            return False
        return stored is not None and not self._kept.on_trial and set(self._markers) <= set(stored.markers)

    def _todo(self, missing: list[str]) -> list[Remark]:
        if self._kept.on_trial:
            text = "The running cameras use the new colours now: move the hand, look at the tab Pictures. Save or undo."
            said = [Remark(text, "good")]
            if self._remote:
                said.append(
                    Remark(f"Cameras on other machines need {self._kept.path.name} in the rig folder there.", "warning")
                )
            return said
        if not self._pictures:
            return [Remark("Take pictures first.")]
        if missing:
            return [Remark(f"Not clicked yet: {', '.join(missing)}. Next: {self._next}.")]
        unseen = [
            camera
            for camera in self._cameras
            if not any(each.places for each in self._pictures if each.camera == camera)
        ]
        if unseen:
            return [Remark(f"Nothing clicked in {', '.join(unseen)} yet; one paint looks different in each camera.")]
        learnt = "try the colours" if self._learnt is not None else "the colours are being learnt"
        return [Remark(f"Every marker is clicked; {learnt}.", "good")]

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        """Take pictures, begin anew, try, save or undo.

        Raises:
            RhotError: it cannot be done.
        """
        if button == "take" and not self._doing:
            await self._take()
        elif button == "unclick" and self._clicks:
            picture, marker = self._clicks.pop()
            del picture.places[marker]
            self._changed(marker)
        elif button == "anew":
            self._pictures, self._clicks = [], []
            self._changed(next(iter(self._markers)))
        elif button == "try" and self._learnt is not None:
            self._kept.try_out(self._learnt.result.colors)
            self._held = {}
        elif button == "save":
            self._kept.save()
        elif button == "undo":
            self._kept.undo()
            self._hold()

    async def point(self, camera: str, u: float, v: float, values: Mapping[str, str]) -> None:
        """Take the place of a marker in the newest picture of a camera; the next marker is chosen at once.

        Raises:
            CalibrationError: there is no picture to click in.
        """
        if not self._held:
            raise CalibrationError("take pictures first: colours are learnt from pictures that stand still")
        picture = next(each for each in reversed(self._pictures) if each.camera == camera)
        marker = values[_MARKER]
        if marker not in picture.places:
            self._clicks.append((picture, marker))
        picture.places[marker] = (u, v)
        # The rest of this picture first, then those of the other cameras.
        newest = [picture, *{each.camera: each for each in self._pictures}.values()]
        rest = [name for each in newest for name in self._markers if name not in each.places]
        self._changed(rest[0] if rest else marker)

    def _changed(self, marker: str) -> None:
        """Go on with a marker; what was learnt before the change does not count any more."""
        self._next = marker
        self._learnt, self._problem = None, ""
        self._hold()
        self._clicked.set()

    async def _take(self) -> None:
        self._doing = "taking pictures"
        try:
            found = await live_pictures(self._room.bus, self._cameras)
        finally:
            self._doing = ""
        self._pictures += [_Picture(camera, image, {}) for camera, image in found.items()]
        self._next = next(iter(self._markers))
        self._hold()

    def _hold(self) -> None:
        """Let the newest pictures stand still, with what was clicked in them."""
        newest = {each.camera: each for each in self._pictures}
        self._held = {camera: preview_jpeg(_clicked_at(each)) for camera, each in newest.items()}

    async def _learn(self) -> None:
        shown = [_Picture(each.camera, each.image, dict(each.places)) for each in self._pictures if each.places]
        if not shown:
            self._shown = {}
            return
        self._doing = "learning the colours"
        try:
            learnt = await asyncio.to_thread(_learn, shown, self._markers)
            pictures = await asyncio.to_thread(_show, shown, learnt)
        except RhotError as error:
            self._problem = f"{error}. Click that marker again, or take the last click back"
            self._shown = {}
        else:
            if not self._clicked.is_set():
                self._learnt, self._shown = learnt, pictures
        finally:
            self._doing = ""


def _learn(pictures: list[_Picture], markers: Mapping[str, MarkerConfig]) -> _Learnt:
    images = [each.image for each in pictures]
    result = calibrate(images, [each.places for each in pictures], markers)
    table = build_color_table(result.colors, list(markers))
    detections = [
        MarkerDetector(dict(markers), table, image.shape[1], image.shape[0]).detect(image) for image in images
    ]
    remarks = [Remark(line.removeprefix("warning: "), "warning") for line in warnings(result)]
    remarks += [Remark(line) for line in suggestions(result)]
    if not remarks:
        remarks = [Remark("The colours can be told apart.", "good")]
    for each, found in zip(pictures, detections, strict=True):
        unseen = [name for name in each.places if name not in found]
        if unseen:
            remarks.insert(
                0,
                Remark(
                    f"{each.camera}: {', '.join(unseen)} clicked but not found by the tracker: is the paint large "
                    "enough in the picture, and evenly lit?",
                    "warning",
                ),
            )
    return _Learnt(result, table, detections, tuple(remarks))


def _show(pictures: list[_Picture], learnt: _Learnt) -> dict[str, bytes]:
    """Return pictures with what is found, and what all colours together take in, by title."""
    shown = {}
    for number, each in enumerate(pictures):
        title = (
            each.camera if number < len({one.camera for one in pictures}) else f"{each.camera}, picture {number + 1}"
        )
        found = overlay_picture(each.image, learnt.result, number, learnt.detections[number], _OVERLAY_WIDTH)
        shown[f"{title}: white = learnt from, green = found"] = preview_jpeg(found)
        mask = np.where(learnt.table.classify(each.image)[0] > 0, 255, 0).astype(np.uint8)
        shown[f"{title}: what the colours take in"] = preview_jpeg(each.image, None, mask)
    return shown


def _clicked_at(picture: _Picture) -> ImageArray:
    canvas = picture.image.copy()
    for name, place in picture.places.items():
        u, v = place if isinstance(place, tuple) else place.middle
        at = (round(u), round(v))
        for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.drawMarker(canvas, at, color, cv2.MARKER_CROSS, 11, thickness)
            cv2.putText(
                canvas, name, (at[0] + 8, at[1] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.4, color, thickness, cv2.LINE_AA
            )
    return canvas


def _table(learnt: _Learnt) -> Figures:
    apart = learnt.result.separability
    rows = []
    for name, quality in learnt.result.markers.items():
        nearest, mixed = apart.nearest(name)
        found = sum(name in each for each in learnt.detections)
        rows.append(
            (
                name,
                f"{found} of {len(learnt.detections)}",
                f"{100 * quality.recovered:.0f} %",
                nearest or "-",
                f"{100 * mixed:.1f} %" if nearest else "-",
            )
        )
    return Figures("How well they can be told apart", ("marker", "found", "kept", "most like", "mixed up"), tuple(rows))
