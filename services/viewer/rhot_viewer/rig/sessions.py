"""Restarting the rig from the page, so that its services use the new calibration."""

from __future__ import annotations

import asyncio
from typing import Final

from rhot.bus import Bus
from rhot.calibration_step import StepContext
from rhot.operation.control import broadcast, new_session
from rhot.rig.folder import CAMERAS_FILE, HAND_FILE, HEADSET_FILE, OBJECT_SOURCES, REGISTRATION_FILE, registration_name
from rhot.rig.kept_file import file_stamp

_READ_AT_START: Final = (
    *(CAMERAS_FILE, HAND_FILE, HEADSET_FILE, REGISTRATION_FILE),
    *map(registration_name, OBJECT_SOURCES),
)
_CONNECT_S: Final = 2.0


class Sessions:
    """Restarts the session, and detects changed files that only a new session reads."""

    def __init__(self, context: StepContext) -> None:
        self._context = context
        self._stamps = self._now()
        self._begun = 0
        self._one_at_a_time = asyncio.Lock()

    def files_have_changed(self) -> bool:
        """Return whether a calibration file that is read at the start of a session has changed since the last look."""
        before, self._stamps = self._stamps, self._now()
        return self._stamps != before

    async def restart(self) -> str:
        """Start a new session and return its id.

        Raises:
            BusError: there is no router, or no service owns the rig clock.
        """
        async with self._one_at_a_time, await Bus.open(self._context.bus, timeout_s=_CONNECT_S) as bus:
            self._begun += 1
            # Distinguishes two sessions within a second, which would otherwise have the same id.
            name = f"{new_session()}-{self._begun}"
            clock_s = 2.0
            delay_s = 0.5
            control = await broadcast(bus, "start", name, delay_s, clock_s)
        return control.session

    def _now(self) -> tuple[tuple[int, int], ...]:
        return tuple(file_stamp(self._context.rig_path / name) for name in _READ_AT_START)
