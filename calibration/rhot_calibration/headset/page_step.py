"""The page's step that finds where the feet's camera sits, over the functions of `rhot calibrate headset --live`."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Final

import numpy as np

from rhot.calibration_step import Button, Field, Figures, Remark, StepContext, StepView, typed_metres
from rhot.errors import ConfigError
from rhot.rig import HeadsetFile, load_rig
from rhot.rig.folder import HEADSET_FILE
from rhot_calibration.headset.fit import Judged, headset_file, judged, report_lines
from rhot_calibration.headset.streams import MOTIONS, ViewCollector, collect_views
from rhot_calibration.page_step import PageStep, trial_buttons

_PATIENCE_S: Final = 30.0
_SMALLEST_M, _LARGEST_M = 0.005, 0.5


class HeadsetStep(PageStep[HeadsetFile]):
    """Watches a marker on the floor while the head moves."""

    about = (
        "Only for rigs that track feet. Lay one of the feet's markers flat on the floor, half a metre before you; "
        "nobody may wear it. Put the headset on and look at the marker from all sides for half a minute: nod, turn and "
        "tilt your head, lean to all sides, bend your knees. Try the result, then save."
    )
    buttons = (
        Button("start", "start looking", "Press again to start over."),
        Button("solve", "finish and fit", "Use what was seen so far."),
        *trial_buttons(HEADSET_FILE, "pose of the camera"),
    )

    def __init__(self, context: StepContext) -> None:
        super().__init__(context, context.rig_path / HEADSET_FILE, HeadsetFile)
        feet = load_rig(context.rig_path).config.feet
        self._has_feet = feet is not None
        if feet is not None:
            marker_id = next(iter(feet.feet.values())).marker_id
            self.fields = (
                Field("marker", "marker", f"{marker_id}", (), "Its number."),
                Field(
                    "size_mm", "size, mm", f"{1e3 * feet.marker_size_m:g}", (), "Side of its black square, measured."
                ),
            )
        self._collector: ViewCollector | None = None
        self._hint = ""
        self._fitted: Judged | None = None

    def view(self) -> StepView:
        """Return how many views there are, and what came of them."""
        own: set[str] = set()
        if self._can_stop:
            own = {"solve"}
        elif not self._doing and self._has_feet:
            own = {"start"}
        collector, fitted = self._collector, self._fitted
        remarks: tuple[Remark, ...] = ()
        tables: tuple[Figures, ...] = ()
        if self._can_stop and collector is not None:
            remarks = (Remark(f"{len(collector.views)} of {collector.wanted} views taken.", "good"),)
            remarks += (Remark(self._hint, "warning"),) if self._hint else ()
            tables = (_motion(collector),)
        elif fitted is not None:
            remarks = tuple(Remark(note, "warning") for note in fitted.notes)
            rows = tuple((line[:10].strip(), line[10:].strip()) for line in report_lines(fitted))
            tables = (Figures("Camera on the headset", ("", ""), rows),)
        if self._kept.on_trial:
            remarks = (Remark("The feet stand where the new pose has them. Save or undo.", "good"), *remarks)
        absent = ("as typed into rig.toml", False)
        if not self._has_feet:
            absent = ("rig.toml names no feet; nothing to do", True)
        return self._view(
            self._standing(absent, "a new pose on trial", lambda stored: (f"found {stored.date}", True)),
            actions=own,
            share=0.0 if collector is None else collector.share,
            remarks=remarks,
            tables=tables,
        )

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        """Look, fit, try, save or undo.

        Raises:
            RhotError: it cannot be done.
        """
        if button == "start" and not self._doing:
            await self._look(values)
        elif button == "solve":
            self._stop()  # whoever pressed start goes on from here
        else:
            await super().press(button, values)

    async def _look(self, values: Mapping[str, str]) -> None:
        rig = load_rig(self._context.rig_path)
        if rig.config.feet is None:
            raise ConfigError("rig.toml names no feet; add [feet.left] or [feet.right] with marker_id")
        size_m = typed_metres("size", values["size_mm"], "60")
        if not _SMALLEST_M <= size_m <= _LARGEST_M:
            raise ConfigError(f"size {1e3 * size_m:g} mm: must be {1e3 * _SMALLEST_M:g} to {1e3 * _LARGEST_M:g} mm")
        if not values["marker"].strip().isdecimal():
            raise ConfigError(f"marker '{values['marker']}': write its number, such as 1")
        self._found, self._fitted, self._hint = None, None, ""
        self._collector = collector = ViewCollector(rig.config.feet, int(values["marker"]))
        with self._busy("looking at the marker"):
            await self._stoppable(
                collect_views(
                    self._context.bus, collector, patience_s=_PATIENCE_S, taken=lambda: None, hint=self._hinted
                )
            )
            self._doing = "fitting"
            found = await asyncio.to_thread(judged, rig, collector, size_m)
        self._fitted, self._found = found, headset_file(found)

    def _hinted(self, text: str) -> None:
        self._hint = text


def _motion(collector: ViewCollector) -> Figures:
    degrees = np.degrees(collector.spread_rad)
    rows = tuple((name, f"± {value:.0f}°") for name, value in zip(MOTIONS, degrees, strict=True))
    return Figures("Motion of the head", ("", ""), rows)
