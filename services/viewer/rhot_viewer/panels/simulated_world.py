"""What stands before the cameras of a simulated rig: the one thing that no hand can do for them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import viser

from rhot.rig.config import RigConfig
from rhot.rig.toml_edit import change_rig_file
from rhot_viewer.browser.page import Page

_CHOICES: Final = {
    "a hand that moves and grasps": "script",
    "a hand held still": "still",
    "a chessboard": "board",
    "a chessboard that lies on the desk": "desk_board",
    "a finger that touches the faces of a box": "touch",
    "two hands that touch and cross": "crossing",
    "a marker on the floor, seen from the headset": "headset",
}
"""Label to `[sim] motion`; every motion has a label."""


def is_simulated(config: RigConfig) -> bool:
    """Return whether a rig has cameras and all of them are simulated."""
    return bool(config.cameras) and all(camera.source == "simulated" for camera in config.cameras.values())


class SimulatedWorld:
    """A list to choose from; a choice is written into `rig.toml`, and counts from the next session on."""

    def __init__(self, rig_path: Path, config: RigConfig) -> None:
        self._rig_path = rig_path
        self._motion: str = config.sim.motion

    def build(self, gui: viser.GuiApi, page: Page, chosen: Callable[[str], None]) -> None:
        """Add the list; `chosen` takes another motion, for `choose`."""
        label = next(label for label, motion in _CHOICES.items() if motion == self._motion)
        choice = gui.add_dropdown(
            "cameras see", tuple(_CHOICES), initial_value=label, hint="This rig is simulated: what its cameras look at."
        )

        def on_choice(event: viser.GuiEvent[Any]) -> None:
            motion = _CHOICES[str(event.target.value)]
            if motion != self._motion:
                chosen(motion)

        choice.on_update(page.on_loop(on_choice))

    def choose(self, motion: str) -> None:
        """Let another thing stand before the cameras.

        Raises:
            ConfigError: `rig.toml` cannot be changed.
        """
        change_rig_file(self._rig_path, {("sim",): {"motion": motion}})
        self._motion = motion
