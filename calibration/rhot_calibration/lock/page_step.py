"""The page's first step: every camera runs, and is locked so that colours keep."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from rhot.bus import Bus
from rhot.calibration_step import Button, Field, Figures, Remark, StepContext, StepView
from rhot.errors import BusError, ConfigError, RhotError
from rhot.rig.folder import load_config
from rhot_calibration.colors.learning import decoded
from rhot_calibration.picture_light import PictureLight

MAX_GAIN_RATIO: Final = 1.25
"""Cameras whose gains differ by more see one paint in two colours."""
_INTERVAL_S: Final = 1.0
_CONNECT_S: Final = 0.5
_ANSWER_S: Final = 1.0
_KEEP_S: Final = 3.0


@dataclass(frozen=True, slots=True)
class CameraLook:
    """How one camera stands.

    Attributes:
        problem: why nothing is known of it; empty otherwise.
        exposure_s, gain, white_balance: its locked settings.
        light: how its picture is lit.
        unsaved: it is set otherwise than its `rig.toml` says.
        can_undo: there are values from before the last saving.
    """

    problem: str = ""
    exposure_s: float = 0.0
    gain: float = 1.0
    white_balance: tuple[float, float] = (1.0, 1.0)
    light: PictureLight = field(default=PictureLight(0.0, 0.0))
    unsaved: bool = False
    can_undo: bool = False


class LockStep:
    """Looks at all cameras once a second; see `rhot.calibration_step.CalibrationStep` for the seam."""

    about = (
        "Start `rhot capture` for every camera. It locks exposure, gain and white balance by itself; set them with the "
        "sliders of the tab Cameras: first the exposure, so short that fast fingers stay sharp (4 ms), then the gain, "
        "then the white balance, until a sheet of paper looks grey. Save when it looks right: the values are written "
        "to rig.toml on the camera's machine and hold after a restart."
    )
    fields: tuple[Field, ...] = ()
    buttons = (
        Button("save", "save", "Exposure, gain and white balance of all cameras, into rig.toml; comments stay."),
        Button("undo", "undo", "Bring back the values before the last save."),
    )

    def __init__(self, context: StepContext) -> None:
        self._context = context
        self._cameras = tuple(load_config(context.rig_path).cameras)
        self._looks: dict[str, CameraLook] = {}
        self._complete: dict[str, CameraLook] = {}
        self._looking = False
        self._presses = 0
        self._problem = ""

    def view(self) -> StepView:
        """Return how the cameras stood a moment ago; while another step is shown, when all answered last."""
        # Left while the rig was being restarted, the last look of all would have it that no camera is there.
        looks = self._looks if self._looking or not self._complete else self._complete
        remarks = [Remark(self._problem, "wrong")] if self._looking and self._problem else look_remarks(looks)
        answering = sum(not look.problem for look in looks.values())
        done = bool(looks) and all(remark.tone == "good" for remark in remarks)
        state = f"{answering} of {len(self._cameras)} cameras answer" if looks else "looking"
        return StepView(
            "all cameras run and are well exposed" if done else state,
            done,
            share=answering / len(self._cameras),
            remarks=tuple(remarks),
            enabled=frozenset(
                ({"save"} if any(look.unsaved for look in looks.values()) else set())
                | ({"undo"} if any(look.can_undo for look in looks.values()) else set())
            ),
            tables=(_table(looks),) if answering else (),
        )

    async def follow(self) -> None:
        """Look until cancelled."""
        self._looking = True
        try:
            await self._look_again_and_again()
        finally:
            self._looking = False

    async def _look_again_and_again(self) -> None:
        while True:
            try:
                async with await Bus.open(self._context.bus, timeout_s=_CONNECT_S) as bus:
                    self._problem = ""
                    while True:
                        presses = self._presses
                        looks = await asyncio.gather(*(_look(bus, name) for name in self._cameras))
                        if presses != self._presses:
                            continue  # what was seen before a button was pressed is not so any more
                        self._looks = dict(zip(self._cameras, looks, strict=True))
                        if not any(look.problem for look in looks):
                            self._complete = self._looks
                        await asyncio.sleep(_INTERVAL_S)
            except BusError as error:
                self._problem = str(error)
                await asyncio.sleep(_INTERVAL_S)

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        """Save or undo exposure, gain and white balance of every camera that answers.

        Raises:
            RhotError: no router, or a camera refuses; says which and why.
        """
        there = [name for name, look in self._looks.items() if not look.problem]
        refused = []
        async with await Bus.open(self._context.bus, timeout_s=_CONNECT_S) as bus:
            # One after the other: those on one machine share a file.
            for name in there:
                look = self._looks[name]
                if look.unsaved if button == "save" else look.can_undo:
                    replies = await bus.get(f"rhot/keep/capture/{name}?do={button}", timeout_s=_KEEP_S)
                    refused += [f"{name}: {reply.error}" for reply in replies if reply.error]
                    refused += [] if replies else [f"{name}: no capture service answers"]
            self._presses += 1
            self._looks |= {name: await _look(bus, name) for name in there}
        if refused:
            raise ConfigError("; ".join(refused))

    async def point(self, camera: str, u: float, v: float, values: Mapping[str, str]) -> None:
        """There is nothing to click at."""


def look_remarks(looks: Mapping[str, CameraLook]) -> list[Remark]:
    """Return what is wrong with the cameras and what to do; one good sentence when nothing is."""
    remarks = [Remark(f"{name}: {look.problem}", "wrong") for name, look in looks.items() if look.problem]
    there = {name: look for name, look in looks.items() if not look.problem}
    for name, look in there.items():
        if look.light.problem:
            remarks.append(Remark(f"{name}: {look.light.problem}", "warning"))
    gains = [np.array([look.gain * look.exposure_s, *look.white_balance]) for look in there.values()]
    if gains and (np.max(gains, axis=0) / np.min(gains, axis=0)).max() > MAX_GAIN_RATIO:
        remarks.append(
            Remark("the cameras are set differently: give all the same exposure, gain and white balance", "warning")
        )
    unsaved = [name for name, look in there.items() if look.unsaved]
    if unsaved:
        remarks.append(
            Remark(
                f"{', '.join(unsaved)}: set otherwise than rig.toml says; save, or it is gone after a restart",
                "warning",
            )
        )
    if looks and not remarks:
        remarks.append(Remark("all cameras run, are locked alike and well exposed; go on with the colours", "good"))
    return remarks


async def _look(bus: Bus, camera: str) -> CameraLook:
    try:
        settings = await bus.get(f"rhot/config/capture/{camera}?format=json", timeout_s=_ANSWER_S)
        image = decoded(camera, await bus.get(f"rhot/preview/{camera}", timeout_s=_ANSWER_S))
        found = json.loads(settings[0].payload)
        red, blue = found["white_balance"]
        kept = await bus.get(f"rhot/keep/capture/{camera}", timeout_s=_ANSWER_S)
        keep = json.loads(kept[0].payload) if kept and not kept[0].error else {}
        return CameraLook(
            exposure_s=float(found["exposure_s"]),
            gain=float(found["gain"]),
            white_balance=(float(red), float(blue)),
            light=PictureLight.of(image),
            unsaved=bool(keep.get("differs", False)),
            can_undo=bool(keep.get("can_undo", False)),
        )
    except RhotError as error:
        return CameraLook(str(error).removeprefix(f"camera {camera}: "))
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return CameraLook("its settings are not understood; do page and capture service have the same version?")


def _table(looks: Mapping[str, CameraLook]) -> Figures:
    rows = tuple(
        (
            name,
            f"{1e3 * look.exposure_s:.1f}",
            f"{look.gain:.1f}",
            f"{look.white_balance[0]:.2f}, {look.white_balance[1]:.2f}",
            f"{look.light.bright:.0f}",
            f"{100 * look.light.clipped:.1f}",
        )
        for name, look in looks.items()
        if not look.problem
    )
    return Figures("Locked at", ("camera", "exposure ms", "gain", "white balance", "brightest", "clipped %"), rows)
