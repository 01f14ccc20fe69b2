"""The page's step that measures a hand, over the functions of `rhot calibrate hand`."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

from rhot.calibration_step import Button, Field, Figures, Remark, StepContext, StepView, typed_metres
from rhot.errors import ConfigError
from rhot.messages import Side
from rhot.rig import HandFile, load_rig
from rhot.rig.calibration import today
from rhot.rig.folder import HAND_FILE
from rhot_calibration.hand.calibration import measure_hand, typed_hand
from rhot_calibration.hand.samples import LIVE_PHASES, LIVE_S, live_points, prompt_at
from rhot_calibration.page_step import PageStep, trial_buttons


class HandStep(PageStep[HandFile]):
    """Measures a hand by its movements or takes typed lengths."""

    about = (
        "Measure: follow three movements for half a minute, with the back of the hand to the cameras: hold it flat and "
        "still; bend straight fingers at the knuckles, three times; then bend everything freely. Or type what a ruler "
        "says: from the wrist crease to the tip of the middle finger, and across the knuckles. Try the hand, then save."
    )
    buttons = (
        Button("measure", "measure by movements", f"{LIVE_S:.0f} s; the page tells you what to do and when."),
        Button("stop", "stop"),
        Button("typed", "use the typed lengths"),
        *trial_buttons(HAND_FILE, "hand"),
    )

    def __init__(self, context: StepContext) -> None:
        super().__init__(context, context.rig_path / HAND_FILE, HandFile)
        self._sides = load_rig(context.rig_path).config.sides
        self.fields = (
            Field("length_mm", "length, mm", "", (), "Wrist crease to the tip of the middle finger; optional."),
            Field("width_mm", "width, mm", "", (), "Across the knuckles of the four fingers; optional."),
            *((Field("side", "hand", self._sides[0], self._sides),) if len(self._sides) > 1 else ()),
        )
        self._share = 0.0

    def view(self) -> StepView:
        """Return what to do now, or what was measured."""
        own = {"stop"} if self._can_stop else set() if self._doing else {"measure", "typed"}
        return self._view(
            self._standing(
                ("not measured: a hand of the length in rig.toml", False),
                "a new hand on trial",
                lambda stored: (f"{1e3 * stored.length_m:.0f} mm long, saved {stored.date}", True),
            ),
            actions=own,
            share=self._share if self._doing else 0.0,
            remarks=self._remarks(),
            tables=() if self._found is None else (_table(self._found),),
        )

    def _remarks(self) -> tuple[Remark, ...]:
        if self._doing:
            return (Remark(self._doing, "warning"),)
        if self._kept.on_trial:
            return (Remark("The rig tracks with the new hand now: look at the tab Live. Save or undo.", "good"),)
        if self._found is None:
            return ()
        said = [Remark("Measured. Look at the figures, then try the hand.", "good")]
        quality = self._found.quality
        if quality.get("source") != "typed in":
            if not quality["palm_from_corners"]:
                text = "The corners of the patch were not seen: lengths follow from reaches alone."
                said.append(Remark(text, "warning"))
            elif not quality["knuckles_s"]:
                text = "No straight fingers bent at the knuckles: knuckles follow from proportions. Measure once more."
                said.append(Remark(text, "warning"))
        return tuple(said)

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        """Measure, stop, take typed lengths, try, save or undo.

        Raises:
            RhotError: it cannot be done.
        """
        if button == "measure" and not self._doing:
            await self._measure(values)
        elif button == "stop":
            self._stop()
        elif button == "typed" and not self._doing:
            length_m, width_m = _typed(values)
            if length_m is None:
                raise ConfigError("type the length of the hand first, such as 189; the width may stay empty")
            self._found = typed_hand(length_m, width_m).model_copy(update={"date": today()})
        else:
            await super().press(button, values)

    async def _measure(self, values: Mapping[str, str]) -> None:
        length_m, _ = _typed(values)
        rig = load_rig(self._context.rig_path)
        side: Side = "left" if values.get("side", self._sides[0]) == "left" else "right"
        self._found, self._share = None, 0.0

        def on_time(passed_s: float, count: int) -> None:
            left_s, doing = prompt_at(passed_s)
            self._doing = f"{left_s:.0f} s: {doing} ({count} point sets)"
            self._share = passed_s / LIVE_S

        with self._busy("looking for the rig"):
            points = await self._stoppable(live_points(self._context.bus, LIVE_S, on_time))
            if points is None:
                return
            self._doing = "fitting the hand"
            found = await asyncio.to_thread(measure_hand, points, rig, side, LIVE_PHASES, length_m)
        self._found = found.model_copy(update={"date": today()})


def _typed(values: Mapping[str, str]) -> tuple[float | None, float | None]:
    """Return length and width as they were typed, metres; None where nothing was."""
    length_m, width_m = (_metres(name, values.get(f"{name}_mm", "")) for name in ("length", "width"))
    return length_m, width_m


def _metres(what: str, text: str) -> float | None:
    if not text.strip():
        return None
    return typed_metres(what, text, "189")


def _table(found: HandFile) -> Figures:
    quality = found.quality
    rows = {"wrist crease to middle tip": quality["length"], "across the knuckles": quality["width"]}
    rows |= {f"{finger}: knuckle to tip joint": figure for finger, figure in quality.get("fingers", {}).items()}
    return Figures(
        "The hand",
        ("length", "mm", "± mm", "source"),
        tuple(
            (
                name,
                f"{figure['mm']:.1f}",
                f"{2 * figure['sd_mm']:.1f}" if "sd_mm" in figure else "-",
                str(figure["source"]),
            )
            for name, figure in rows.items()
        ),
    )
