"""The page's step that registers a tracking system, over the functions of `rhot calibrate objects --live`."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Final

import numpy as np

from rhot.calibration_step import Button, Field, Figures, Remark, StepContext, StepView
from rhot.errors import ConfigError
from rhot.rig import RegistrationFile, load_rig
from rhot.rig.folder import REGISTRATION_FILE, registration_name
from rhot.rig.kept_file import KeptFile
from rhot_calibration.objects.checks import check_fit, check_places, lever_note, scale_note
from rhot_calibration.objects.fit import Places, RegistrationFit, first_prior, fit_registration
from rhot_calibration.objects.live import PlaceCollector, PosePair, collect_places
from rhot_calibration.objects.record import registration_file
from rhot_calibration.objects.touch.checks import judged
from rhot_calibration.objects.touch.collector import TouchCollector
from rhot_calibration.objects.touch.command import notes, report_lines, touch_rows
from rhot_calibration.objects.touch.live import collect_touches
from rhot_calibration.objects.touch.record import R_before, touched_registration
from rhot_calibration.objects.touch.streams import touch_task
from rhot_calibration.page_step import PageStep, trial_buttons

_WANTED: Final = 10
_PATIENCE_S: Final = 15.0
_UNKNOWN_LEVER_SD_M: Final = 0.05


class ObjectStep(PageStep[RegistrationFile]):
    """Collects positions of a tracked device with a marker."""

    about = (
        "Fix a painted marker to a tracked device, or touch the device with it, and hold both still before the cameras "
        "at ten places: the corners of the space where you work and its middle, near and far, turned by about 60° to "
        "all sides. A place is taken when both stand still. Try the result, then save. After that, touch the faces "
        "of an object with a shape with your index finger, as named: so the rig learns where it sits on its tracker."
    )
    buttons = (
        Button("start", "start taking places", "Press again to start over."),
        Button("touch", "touch its faces", "Finds where an object with a shape sits on its tracker."),
        Button("take", "take this touch", "The one that is held now, where it is not noticed by itself."),
        Button("back", "take back the last touch"),
        Button("solve", "finish and fit", "Use what was taken so far."),
        *trial_buttons("registration.SOURCE.json", "registration"),
    )

    def __init__(self, context: StepContext) -> None:
        config = load_rig(context.rig_path).config
        first = next((each.source for each in config.objects.values()), "steamvr")
        super().__init__(context, context.rig_path / registration_name(first), RegistrationFile)
        self._objects = tuple(config.objects)
        self._simulated = all(each.source == "simulated" for each in config.objects.values())
        markers = tuple(config.markers)
        self.fields = (
            *((Field("object", "device", self._objects[0], self._objects),) if self._objects else ()),
            Field("marker", "marker", markers[0], markers, "The one that is fixed to it."),
        )
        self._collector = PlaceCollector()
        self._touches: TouchCollector | None = None
        self._hint = ""
        self._fitted: tuple[tuple[Figures, ...], tuple[Remark, ...]] = ((), ())

    def view(self) -> StepView:
        """Return how many positions there are, and what came of them."""
        tables, remarks = self._fitted
        touches = self._touches
        share = len(self._collector.places) / _WANTED
        if touches is not None:
            share = len(touches.touches) / len(touches.plan)
        return self._view(
            self._stored(),
            actions=self._actions(),
            share=share,
            remarks=(*self._todo(), *remarks),
            tables=tables,
        )

    def _actions(self) -> set[str]:
        if self._can_stop:
            return {"solve"} if self._touches is None else {"solve", "take", "back"}
        return set() if self._doing or not self._objects else {"start", "touch"}

    def _stored(self) -> tuple[str, bool]:
        if not self._objects:
            return "rig.toml names no objects; nothing to do", True
        absent = ("not registered: objects stand in their own space", False)
        if (self._context.rig_path / REGISTRATION_FILE).exists():
            absent = (f"registered {load_rig(self._context.rig_path).registration.date}", True)
        if self._simulated:
            absent = ("simulated objects stand in the cameras' space; nothing to do", True)
        return self._standing(absent, "a new registration on trial", lambda stored: (f"registered {stored.date}", True))

    def _todo(self) -> tuple[Remark, ...]:
        if self._can_stop:
            touches = self._touches
            done = f"{len(self._collector.places)} of {_WANTED} places taken."
            if touches is not None:
                done = f"{len(touches.touches)} of {len(touches.plan)} touches taken."
            taken = Remark(done, "good")
            return (taken, Remark(self._hint, "warning")) if self._hint else (taken,)
        if self._kept.on_trial:
            text = "Objects stand where the new registration has them: move one, look at the tab Live. Save or undo."
            return (Remark(text, "good"),)
        return ()

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        """Start, fit, try, save or undo.

        Raises:
            RhotError: it cannot be done.
        """
        if button == "start" and not self._doing:
            await self._register(values)
        elif button == "touch" and not self._doing:
            await self._touch(values.get("object", ""))
        elif button == "take" and self._touches is not None:
            if self._touches.take_now() is None:
                self._hint = f"not taken: {self._touches.hint}"
        elif button == "back" and self._touches is not None:
            self._touches.take_back()
        elif button == "solve":
            self._stop()  # whoever pressed start goes on from here
        else:
            await super().press(button, values)

    async def _register(self, values: Mapping[str, str]) -> None:
        device, marker = values.get("object", ""), values["marker"]
        if not device:
            raise ConfigError("rig.toml names no objects; add [objects.NAME] with source and serial")
        self._start_over()
        rig = load_rig(self._context.rig_path)
        source = rig.config.objects[device].source
        self._keep_in(registration_name(source))
        with self._busy("taking places"):
            await self._stoppable(
                collect_places(
                    self._context.bus,
                    rig,
                    device,
                    marker,
                    self._collector,
                    wanted=_WANTED,
                    patience_s=_PATIENCE_S,
                    taken=self._taken,
                    hint=self._hinted,
                )
            )
            self._doing = "fitting"
            places = self._collector.to_places()
            fit = await asyncio.to_thread(_fitted, places)
            found = registration_file(
                fit, places, rig.registration_of(source), object_id=device, marker=marker, prior=None
            )
            self._fitted = _shown(places, fit)
            check_fit(fit)
        self._found = found

    async def _touch(self, device: str) -> None:
        rig = load_rig(self._context.rig_path)
        task = touch_task(rig, device)
        self._start_over()
        self._keep_in(registration_name(task.source))
        self._touches = touches = task.new_collector()
        with self._busy("taking touches"):
            await self._stoppable(
                collect_touches(
                    self._context.bus,
                    rig,
                    task,
                    touches,
                    patience_s=_PATIENCE_S,
                    taken=lambda _: None,
                    hint=self._hinted,
                )
            )
            self._doing = "fitting"
            taken = list(touches.touches)
            found = await asyncio.to_thread(judged, task.shape, taken, R_before(task))
        table = Figures("Touches", ("touch", "face", "off mm", ""), tuple(touch_rows(taken, found)))
        remarks = (
            *(Remark(line) for line in report_lines(task, found)),
            *(Remark(note, "warning") for note in notes(task, taken, found)),
        )
        self._fitted = (table,), remarks
        self._found = touched_registration(rig.registration_of(task.source), task, found, len(taken))

    def _keep_in(self, name: str) -> None:
        if self._kept.path.name != name:
            self._kept = KeptFile(self._context.rig_path / name, RegistrationFile)

    def _start_over(self) -> None:
        self._collector, self._touches = PlaceCollector(), None
        self._hint, self._found, self._fitted = "", None, ((), ())

    def _taken(self, _: PosePair) -> None:
        self._hint = "go to another place, and turn it"

    def _hinted(self, text: str) -> None:
        self._hint = text


def _fitted(places: Places) -> RegistrationFit:
    check_places(places)
    return fit_registration(places, first_prior(places, np.zeros(3), _UNKNOWN_LEVER_SD_M))


def _shown(places: Places, fit: RegistrationFit) -> tuple[tuple[Figures, ...], tuple[Remark, ...]]:
    rows = tuple(
        (name, f"{1e3 * off:.1f}", "" if kept else "left out: contradicts the others")
        for name, off, kept in zip(places.names, fit.residual_m, fit.kept, strict=True)
    )
    sd_mm = 1e3 * float(np.linalg.norm(fit.estimate.position_sd_m))
    turn_deg = float(np.degrees(fit.estimate.rotation_sd_rad))
    text = f"Residual {1e3 * fit.rms_m:.1f} mm RMS; position ± {sd_mm:.1f} mm, rotation ± {turn_deg:.2f}°."
    notes = (Remark(note, "warning") for note in (scale_note(places, fit), lever_note(fit)) if note)
    return (Figures("Places", ("place", "off mm", ""), rows),), (Remark(text), *notes)
