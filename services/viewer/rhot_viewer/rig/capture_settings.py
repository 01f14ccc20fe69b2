"""Reading and changing the settings of running capture services, through `rhot/config/capture/<camera>`."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from rhot.bus import Bus
from rhot.errors import BusError
from rhot_viewer.rig.camera_sliders import merged_change

_TIMEOUT_S: Final = 0.8
_KEEP_S: Final = 3.0


@dataclass(frozen=True, slots=True)
class CameraState:
    """The known settings of one camera.

    Attributes:
        settings: fields of `CameraSettings`; empty before the first answer.
        refusal: why the last change was refused; empty otherwise.
        version: number of answers.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    refusal: str = ""
    version: int = 0


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
        try:
            replies = await bus.get(key, json.dumps(change).encode() if change else b"", timeout_s=_TIMEOUT_S)
        except BusError as error:
            return CameraState(before.settings, str(error), before.version + 1)
        if not replies:
            return CameraState(before.settings, _silent(camera), before.version + 1)
        if replies[0].error:
            return CameraState(before.settings, replies[0].error, before.version + 1)
        try:
            settings = json.loads(replies[0].payload)
        except (ValueError, RecursionError):
            settings = None
        if not isinstance(settings, dict):
            return CameraState(before.settings, "the answer is not a map of settings", before.version + 1)
        # A mere reading does not take away the reason why the last change was refused.
        return CameraState(settings, before.refusal if not change else "", before.version + 1)


def _silent(camera: str) -> str:
    return f"no answer; is `rhot capture --camera {camera}` running?"
