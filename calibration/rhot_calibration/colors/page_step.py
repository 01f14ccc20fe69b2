"""The page's step that learns colours from clicks, over the functions of `rhot calibrate colors`."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Final

from rhot.calibration_step import Button, Field, Remark, StepContext, StepView
from rhot.errors import CalibrationError, RhotError
from rhot.rig.colors import ColorsFile
from rhot.rig.config import MarkerConfig
from rhot.rig.folder import COLORS_FILE, load_rig
from rhot_calibration.colors.learning import Learnt, learn, live_pictures
from rhot_calibration.colors.picking.clicks import Clicks
from rhot_calibration.page_step import PageStep, trial_buttons

MAX_ROUNDS: Final = 4
"""So many looks at all cameras are learnt from together; each makes the fit slower."""
_MARKER: Final = "marker"


class ColorStep(PageStep[ColorsFile]):
    """Clicks set colours."""

    about = (
        "Hold the painted hand so that both cameras see all markers, and take the pictures; they do not move then. "
        "Look through a camera, choose a marker and click its paint in the picture; the next one is chosen for you. "
        "Do it for every camera. Masks, and how well the colours can be told apart, appear at once. More pictures, in "
        "another light, make the colours robust. Try them on the running cameras, then save."
    )
    buttons = (
        Button("take", "take pictures", "One of each camera; hold still. Press again for more; your clicks stay."),
        Button("unclick", "undo last click"),
        Button("start_over", "start over", "Forget all pictures and clicks."),
        *trial_buttons(COLORS_FILE, "colours", "The running cameras use the colours; nothing is saved yet."),
    )

    def __init__(self, context: StepContext) -> None:
        rig = load_rig(context.rig_path)
        super().__init__(context, rig.colors_path, ColorsFile)
        self._markers: dict[str, MarkerConfig] = dict(rig.config.markers)
        self._cameras = tuple(rig.config.cameras)
        self._remote = any(camera.source != "simulated" for camera in rig.config.cameras.values())
        self.fields = (
            Field(_MARKER, "marker", next(iter(self._markers)), tuple(self._markers), "The marker to click next."),
        )
        self._clicks = Clicks(self._markers)
        self._learnt: Learnt | None = None
        self._next = next(iter(self._markers))
        self._shown: Mapping[str, bytes] = {}
        self._held: dict[str, bytes] = {}
        self._problem = ""
        self._clicked = asyncio.Event()

    def view(self) -> StepView:
        """Return pictures, figures and what is missing."""
        pictures, missing, learnt = self._clicks.pictures, self._clicks.missing, self._learnt
        enabled = {"take"} if len(pictures) < MAX_ROUNDS * len(self._cameras) else set()
        enabled |= {"start_over"} if pictures else set()
        enabled |= {"unclick"} if self._clicks.can_take_back else set()
        enabled |= self._trial_actions()
        return StepView(
            self._state(),
            self._is_done(),
            share=1.0 - len(missing) / len(self._markers),
            remarks=(
                *([Remark(self._problem, "wrong")] if self._problem else self._todo(missing)),
                *(learnt.remarks if learnt is not None else ()),
            ),
            enabled=frozenset(enabled),
            tables=() if learnt is None else (learnt.table,),
            pictures=dict(self._shown),
            held=dict(self._held),
            values={_MARKER: self._next},
        )

    async def follow(self) -> None:
        """Learn from the clicks whenever there are new ones; those that come meanwhile are learnt from together."""
        while True:
            await self._clicked.wait()
            self._clicked.clear()
            try:
                await self._learn()
            except asyncio.CancelledError:
                # Another step was chosen meanwhile: whoever comes back wants to know what was clicked.
                self._clicked.set()
                raise

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
        if not self._clicks.pictures:
            return [Remark("Take pictures first.")]
        if missing:
            return [Remark(f"Not clicked yet: {', '.join(missing)}. Next: {self._next}.")]
        unseen = self._clicks.cameras_without
        if unseen:
            return [Remark(f"Nothing clicked in {', '.join(unseen)} yet; one paint looks different in each camera.")]
        learnt = "try the colours" if self._learnt is not None else "the colours are being learnt"
        return [Remark(f"Every marker is clicked; {learnt}.", "good")]

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        """Take pictures, start over, try, save or undo.

        Raises:
            RhotError: it cannot be done.
        """
        if button == "take" and not self._doing:
            await self._take_picture()
        elif button == "unclick" and self._clicks.can_take_back:
            self._changed(self._clicks.take_back())
        elif button == "start_over":
            self._clicks = Clicks(self._markers)
            self._changed(next(iter(self._markers)))
        else:
            await super().press(button, values)
            if button == "try" and self._found is not None:
                self._held = {}
            elif button == "undo":
                self._hold()

    async def point(self, camera: str, u: float, v: float, values: Mapping[str, str]) -> None:
        """Take the place of a marker in the newest picture of a camera; the next marker is chosen at once.

        Raises:
            CalibrationError: there is no picture to click in.
        """
        if not self._held:
            raise CalibrationError("take pictures first: colours are learnt from pictures that stand still")
        self._changed(self._clicks.click(camera, values[_MARKER], (u, v)))

    def _changed(self, marker: str) -> None:
        """Go on with a marker; what was learnt before the change does not count any more."""
        self._next = marker
        self._learnt, self._found, self._problem = None, None, ""
        self._hold()
        self._clicked.set()

    async def _take_picture(self) -> None:
        with self._busy("taking pictures"):
            found = await live_pictures(self._context.bus, self._cameras)
        self._clicks.add(found)
        self._next = next(iter(self._markers))
        self._hold()

    def _hold(self) -> None:
        """Let the newest pictures stand still, with what was clicked in them."""
        self._held = self._clicks.held()

    async def _learn(self) -> None:
        clicked = [each for each in self._clicks.pictures if each.places]
        if not clicked:
            self._shown = {}
            return
        places = [dict(each.places) for each in clicked]
        try:
            with self._busy("learning the colours"):
                learnt = await asyncio.to_thread(learn, clicked, places, self._markers)
        except RhotError as error:
            self._problem = f"{error}. Click that marker again, or undo the last click"
            self._shown = {}
        else:
            if not self._clicked.is_set():
                self._learnt, self._found, self._shown = learnt, learnt.colors, learnt.pictures
