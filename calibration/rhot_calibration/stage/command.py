"""`rhot calibrate stage`."""

from __future__ import annotations

import asyncio
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from rhot.bus import CONNECT_S, Bus
from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import CalibrationError, ConfigError
from rhot.rig import Rig, StageFile, load_rig
from rhot.rig.calibration import HIGHEST_DESK_M, LOWEST_DESK_M
from rhot.rig.cameras import camera_models
from rhot.rig.folder import STAGE_FILE, registration_name, registration_path
from rhot_calibration.cameras.board.options import board_options, stated_board
from rhot_calibration.cameras.pictures import read_pictures
from rhot_calibration.cameras.solve.views import Board, ViewSet
from rhot_calibration.options import dry_run_option, live_option
from rhot_calibration.stage.desk import DeskFit, fit_desk, residual_text
from rhot_calibration.stage.floor import FORWARDS, Forward, desk_file, look_at_desk, registration_stage
from rhot_calibration.writing import write_found


@click.command()
@click.argument("recording", metavar="[PICTURES]", required=False, type=click.Path(path_type=Path))
@live_option()
@click.option("--registration", is_flag=True, help="Take the floor of the registered tracking system (SteamVR).")
@board_options
@click.option(
    "--desk-mm",
    type=FiniteRange(1e3 * LOWEST_DESK_M, 1e3 * HIGHEST_DESK_M),
    help="Height of the desk over the floor, by a ruler.",
)
@click.option(
    "--thickness-mm",
    type=FiniteRange(0, 100),
    default=0.0,
    show_default=True,
    help="Of the board: how far its printed face lies above the desk.",
)
@click.option(
    "--forward",
    type=click.Choice(FORWARDS),
    default="down",
    show_default=True,
    help="Where the person looks who sits at the desk, in the first camera's picture; hands come in at the other edge.",
)
@dry_run_option
@rig_option
@bus_options
def stage(
    recording: Path | None,
    live: bool,
    registration: bool,
    counts: str | None,
    square_mm: float | None,
    marker_mm: float | None,
    dictionary: str,
    desk_mm: float | None,
    thickness_mm: float,
    forward: Forward,
    dry_run: bool,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Find the floor: define a frame with y up and its origin on the floor, as games, avatars and lab software expect.

    Lay the calibration board flat on the desk, in view of the cameras, and measure how high the desk is:

    \b
    rhot calibrate stage --live --board 9x6 --square-mm 25 --desk-mm 740 --rig RIG
    rhot calibrate stage pictures --board 9x6 --square-mm 25 --desk-mm 740 --rig RIG
    rhot calibrate stage --registration --rig RIG

    PICTURES is a folder as `rhot calibrate cameras` reads it; boards that do not lie on the desk are left out, so its
    own pictures will do when the board lay on the desk in two of them or more. With --registration the floor is that
    of SteamVR's room setup, and nothing needs to be measured.

    Writes stage.json; the previous file is kept as stage.previous.json. The running rig publishes it on
    rhot/space/stage.
    """
    rig = load_rig(rig_path)
    if sum((recording is not None, live, registration)) != 1:
        raise ConfigError("give one of: a folder of pictures, --live, --registration; see --help")
    console = Console(soft_wrap=True, markup=False, highlight=False)
    if registration:
        if registration_path(rig.path, "steamvr") is None:
            raise CalibrationError(
                f"{rig.path / registration_name('steamvr')} is not there: SteamVR is not registered; `rhot calibrate "
                "objects` does that, or use a board on the desk"
            )
        found = registration_stage(rig.registration_of("steamvr"), "steamvr")
    else:
        if desk_mm is None:
            raise ConfigError(
                "give --desk-mm (height of the desk over the floor, such as 740) beside --board and --square-mm"
            )
        board = stated_board(counts, square_mm, marker_mm, dictionary)
        if not rig.calibrated:
            raise CalibrationError(f"{rig.path}: the cameras are not calibrated; run `rhot calibrate cameras` first")
        if live:
            views = asyncio.run(_look(rig_path, connect, namespace, rig, board))
        else:
            sizes = {name: (camera.width, camera.height) for name, camera in rig.config.cameras.items()}
            views = read_pictures(recording or Path(), board, list(rig.cameras), None, sizes).views
        cameras = camera_models(rig.cameras)
        fit = fit_desk(cameras, views)
        _print_fit(console, fit)
        first = next(iter(cameras.values()))
        found = desk_file(fit, first, 1e-3 * desk_mm, 1e-3 * thickness_mm, forward)
    _print_stage(console, rig, found)
    file = rig.path / STAGE_FILE
    then = "A running rig publishes it on rhot/space/stage within a second."
    write_found(console, file, found, then, dry_run=dry_run)


async def _look(rig_path: Path, connect: tuple[str, ...], namespace: str | None, rig: Rig, board: Board) -> ViewSet:
    async with await Bus.open(tool_bus(rig_path, connect, namespace), timeout_s=CONNECT_S) as bus:
        return await look_at_desk(bus, list(rig.cameras), board)


def _print_fit(console: Console, fit: DeskFit) -> None:
    left_out = f"; {len(fit.left_out)} left out, not in the desk's plane" if fit.left_out else ""
    console.print(f"boards on the desk  {fit.boards}{left_out}")
    console.print(f"residual            {residual_text(fit)}, corners {fit.rms_px:.2f} px (RMS)")
    console.print(
        f"plane               ± {np.degrees(fit.tilt_sd_rad):.2f}° and ± {1e3 * fit.height_sd_m:.1f} mm, from the "
        "corners' scatter alone (one standard deviation)"
    )


def _print_stage(console: Console, rig: Rig, found: StageFile) -> None:
    T_stage_rig = np.linalg.inv(found.T_rig_stage.matrix)
    for name, camera in rig.cameras.items():
        x, y, z = 1e3 * (T_stage_rig[:3, :3] @ np.array(camera.T_rig_camera)[:3, 3] + T_stage_rig[:3, 3])
        console.print(
            f"camera {name:12s} {y:.0f} mm over the floor, {x:.0f} to the right, {-z:.0f} forward of the origin"
        )
