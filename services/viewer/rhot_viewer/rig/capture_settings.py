"""Reading and changing the settings of running capture services, through `rhot/config/capture/<camera>`."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from rhot.bus import Bus
from rhot.errors import BusError

# The sliders of one camera: what each moves in the capture service's settings, and within which limits.

_PER_MARKER: Final = ("tolerances", "bounds")
"""Fields of `CameraSettings` that hold a value for each marker."""


@dataclass(frozen=True, slots=True)
class CameraSlider:
    """One slider.

    Attributes:
        label: for people, with its unit.
        field: of `CameraSettings`.
        part: within the field: an index in a pair, or a marker's name; None = the field itself.
        factor: slider value = factor · setting.
        low, high, step: of the slider.
        hint: what it does, one sentence.
    """

    label: str
    field: str
    part: int | str | None
    factor: float
    low: float
    high: float
    step: float
    hint: str

    def value_in(self, settings: Mapping[str, Any]) -> float | None:
        """Return where the slider stands for some settings, within its limits; None when they do not hold it."""
        value: Any = settings.get(self.field)
        try:
            value = value if self.part is None else value[self.part]
            return min(max(self.factor * float(value), self.low), self.high)
        except (TypeError, ValueError, KeyError, IndexError):
            return None

    def change_to(self, value: float, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the change of settings that a slider's new value asks for."""
        setting = value / self.factor
        if isinstance(self.part, str):
            return {self.field: {self.part: setting}}
        if self.part is None:
            return {self.field: setting}
        pair = list(settings[self.field])
        pair[self.part] = setting
        return {self.field: pair}


def camera_sliders(markers: Iterable[str]) -> tuple[CameraSlider, ...]:
    """Return the sliders of a camera that looks for some markers."""
    optics = (
        CameraSlider(
            "exposure ms",
            "exposure_s",
            None,
            1e3,
            0.1,
            30.0,
            0.1,
            "How long each row is exposed. Short keeps fast fingers sharp; no longer than one frame.",
        ),
        CameraSlider("gain", "gain", None, 1.0, 1.0, 16.0, 0.1, "Amplifies the picture and its noise."),
        CameraSlider("white: red", "white_balance", 0, 1.0, 0.5, 4.0, 0.02, "Red gain; locked, never automatic."),
        CameraSlider("white: blue", "white_balance", 1, 1.0, 0.5, 4.0, 0.02, "Blue gain; locked, never automatic."),
        CameraSlider(
            "saturation",
            "saturation",
            None,
            1.0,
            0.0,
            4.0,
            0.05,
            "Of the picture, where the camera can set it: 1 is its own, 0 is grey. More sets paints further apart.",
        ),
        CameraSlider("contrast", "contrast", None, 1.0, 0.1, 4.0, 0.05, "Of the picture: 1 is the camera's own."),
        CameraSlider("brightness", "brightness", None, 1.0, -1.0, 1.0, 0.01, "Added to the picture: 0 adds nothing."),
    )
    thresholds = tuple(
        CameraSlider(
            name,
            "tolerances",
            name,
            1.0,
            0.1,
            4.0,
            0.05,
            f"Threshold of the colour of {name}: above 1 takes in more colours, below 1 fewer.",
        )
        for name in markers
    )
    return (*optics, *thresholds)


def merged_change(first: Mapping[str, Any], then: Mapping[str, Any]) -> dict[str, Any]:
    """Return two changes of settings as one; the later wins, thresholds and bounds marker by marker."""
    merged = {**first, **then}
    for name in _PER_MARKER:
        if name in first and name in then:
            merged[name] = {**first[name], **then[name]}
    return merged


_TIMEOUT_S: Final = 0.8
_KEEP_S: Final = 3.0


@dataclass(frozen=True, slots=True)
class CameraState:
    """The known settings of one camera.

    Attributes:
        settings: fields of `CameraSettings`; empty before the first answer.
        refusal: why the last change was refused; empty otherwise.
        version: number of answers.
        unread: the last reading failed, and the settings may be others by now.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    refusal: str = ""
    version: int = 0
    unread: bool = False


class CaptureSettings:
    """Settings of all cameras; changes are merged until the camera answers."""

    def __init__(self, cameras: Iterable[str]) -> None:
        self.cameras = {name: CameraState() for name in cameras}
        self._pending: dict[str, dict[str, Any]] = {}
        self._keeping: set[str] = set()
        self._wake = asyncio.Event()

    def ask(self, camera: str, change: Mapping[str, Any]) -> None:
        """Change a camera's settings; an empty change reads them."""
        self._pending[camera] = merged_change(self._pending.get(camera, {}), change)
        self._wake.set()

    def keep_bounds(self, camera: str) -> None:
        """Have a camera write the colour bounds that are in force into its colors.json."""
        self._keeping.add(camera)
        self.ask(camera, {})

    def is_asked(self, camera: str) -> bool:
        """Return whether an answer is awaited."""
        return camera in self._pending

    async def run(self, bus: Bus) -> None:
        """Send what is asked, until cancelled."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            for camera, change in list(self._pending.items()):
                kept = await self._keep(bus, camera) if camera in self._keeping else ""
                answered = await self._answer(bus, camera, change)
                if kept:
                    answered = replace(answered, refusal=kept)
                if self._pending.get(camera) is change:
                    del self._pending[camera]
                self.cameras[camera] = answered

    async def _keep(self, bus: Bus, camera: str) -> str:
        """Return why the bounds were not kept; empty when they were."""
        self._keeping.discard(camera)
        try:
            replies = await bus.get(f"rhot/keep/capture/{camera}?do=save_bounds", timeout_s=_KEEP_S)
        except BusError as error:
            return str(error)
        return replies[0].error if replies else _silent(camera)

    async def _answer(self, bus: Bus, camera: str, change: Mapping[str, Any]) -> CameraState:
        before = self.cameras[camera]
        key = f"rhot/config/capture/{camera}?format=json"
        failure, settings = "", None
        try:
            replies = await bus.get(key, json.dumps(change).encode() if change else b"", timeout_s=_TIMEOUT_S)
            failure = replies[0].error if replies else _silent(camera)
            settings = None if failure else json.loads(replies[0].payload)
        except BusError as error:
            failure = str(error)
        except (ValueError, RecursionError):
            pass
        if failure or not isinstance(settings, dict):
            failure = failure or "the answer is not a map of settings"
            return replace(before, refusal=failure, version=before.version + 1, unread=before.unread or not change)
        # A mere reading does not take away the reason why the last change was refused.
        refusal = "" if change or before.unread else before.refusal
        return CameraState(settings, refusal, before.version + 1)


def _silent(camera: str) -> str:
    return f"no answer; is `rhot capture --camera {camera}` running?"
