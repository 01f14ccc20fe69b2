"""The page's step that finds the floor, over the functions of `rhot calibrate stage`."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

import numpy as np

from rhot.bus import CONNECT_S, Bus
from rhot.calibration_step import Button, Field, Figures, Remark, StepContext, StepView, typed_metres
from rhot.errors import CalibrationError, ConfigError
from rhot.rig import StageFile, load_rig
from rhot.rig.calibration import HIGHEST_DESK_M, LOWEST_DESK_M
from rhot.rig.cameras import camera_models
from rhot.rig.folder import STAGE_FILE, registration_path
from rhot_calibration.cameras.board.grid import parse_board
from rhot_calibration.page_step import PageStep, trial_buttons
from rhot_calibration.stage.desk import DeskFit, fit_desk, residual_text
from rhot_calibration.stage.floor import FORWARDS, Forward, desk_file, look_at_desk, registration_stage


class StageStep(PageStep[StageFile]):
    """Finds the desk's plane from a board that lies on it, or takes the floor of a registered tracking system."""

    about = (
        "Other programs want to know where the floor is. Lay the calibration board flat on the desk, wholly in view of "
        "the cameras, type in how high the desk is over the floor, and look. Or take the floor from SteamVR's room "
        "setup, when its trackers are registered. Try the result, then save."
    )
    buttons = (
        Button("look", "look at the desk", "The board must lie still."),
        Button("registered", "take SteamVR's floor", "From its registration; nothing to measure."),
        *trial_buttons(STAGE_FILE, "floor"),
    )

    def __init__(self, context: StepContext) -> None:
        super().__init__(context, context.rig_path / STAGE_FILE, StageFile)
        sim = load_rig(context.rig_path).config.sim
        self.fields = (
            Field("board", "board", f"{sim.board_columns}x{sim.board_rows}", (), "Inner corners along and across."),
            Field("square_mm", "square, mm", f"{1e3 * sim.board_square_m:g}", (), "Side of a square, measured."),
            Field("desk_mm", "desk, mm", "", (), "Height of the desk's top over the floor, by a ruler, such as 740."),
            Field("thickness_mm", "board, mm", "0", (), "Thickness of the board."),
            Field(
                "forward",
                "you look",
                FORWARDS[0],
                FORWARDS,
                "Where you look, sitting at the desk, in the first camera's picture; your hands come in at the other "
                "edge.",
            ),
        )
        self._tables: tuple[Figures, ...] = ()

    def view(self) -> StepView:
        """Return where the floor is, and how well the board told it."""
        own = set() if self._doing else {"look"}
        if not self._doing and registration_path(self._context.rig_path, "steamvr") is not None:
            own.add("registered")
        trial = (Remark("The running rig publishes the new floor now. Save or undo.", "good"),)
        return self._view(
            self._standing(
                ("no floor: programs that want one get none", False),
                "a new floor on trial",
                lambda stored: (f"found {stored.date} by {stored.source}", True),
            ),
            actions=own,
            remarks=trial if self._kept.on_trial else (),
            tables=self._tables,
        )

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        """Look, take the registered floor, try, save or undo.

        Raises:
            RhotError: it cannot be done.
        """
        if button == "look" and not self._doing:
            await self._look(values)
        elif button == "registered" and not self._doing:
            registration = load_rig(self._context.rig_path).registration_of("steamvr")
            self._found, self._tables = registration_stage(registration, "steamvr"), ()
        else:
            await super().press(button, values)

    async def _look(self, values: Mapping[str, str]) -> None:
        self._found, self._tables = None, ()
        board = parse_board(values["board"], typed_metres("square", values["square_mm"], "25"))
        desk_m = typed_metres("desk", values["desk_mm"], "740")
        if not LOWEST_DESK_M <= desk_m <= HIGHEST_DESK_M:
            low, high = 1e3 * LOWEST_DESK_M, 1e3 * HIGHEST_DESK_M
            raise ConfigError(f"desk {1e3 * desk_m:g} mm: must be {low:g} to {high:g} mm over the floor")
        thickness_m = typed_metres("board", values["thickness_mm"], "5")
        rig = load_rig(self._context.rig_path)
        if not rig.calibrated:
            raise CalibrationError("the cameras are not calibrated; do that first")
        cameras = camera_models(rig.cameras)
        with self._busy("looking at the desk"):
            async with await Bus.open(self._context.bus, timeout_s=CONNECT_S) as bus:
                views = await look_at_desk(bus, list(cameras), board)
            fit = await asyncio.to_thread(fit_desk, cameras, views)
        self._tables = (_figures(fit),)
        forward: Forward = next((each for each in FORWARDS if each == values["forward"]), FORWARDS[0])
        self._found = desk_file(fit, next(iter(cameras.values())), desk_m, thickness_m, forward)


def _figures(fit: DeskFit) -> Figures:
    rows = (
        ("pictures of the board", f"{fit.boards}"),
        ("residual", f"{residual_text(fit)}, corners {fit.rms_px:.2f} px RMS"),
        ("plane", f"± {np.degrees(fit.tilt_sd_rad):.2f}°, ± {1e3 * fit.height_sd_m:.1f} mm"),
    )
    return Figures("Desk", ("", ""), rows)
