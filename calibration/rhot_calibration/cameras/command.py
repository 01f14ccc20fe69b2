"""`rhot calibrate cameras`."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Final

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import CalibrationError, ConfigError
from rhot.report.html import figures_table
from rhot.rig import CamerasFile, Rig, load_rig, read_json_model
from rhot.rig.folder import CAMERAS_FILE, nominal_camera
from rhot.text import as_argument
from rhot_calibration.cameras.board.options import board_options, stated_board
from rhot_calibration.cameras.calibration import Calibrated, bow_mm, calibrate_rig, cameras_file, refuse_other_board
from rhot_calibration.cameras.figures import MARKER_SIGMA_PX
from rhot_calibration.cameras.interchange.interchange import export_opencv_yaml, import_cameras
from rhot_calibration.cameras.live.live import collect
from rhot_calibration.cameras.pictures import PictureReading, read_pictures
from rhot_calibration.cameras.solve.views import Board
from rhot_calibration.options import dry_run_option, live_option
from rhot_calibration.writing import write_found

# What `rhot calibrate cameras` prints.


def print_report(console: Console, calibrated: Calibrated) -> None:
    """Print what was found, what was left out, and what to expect."""
    console.print(_cameras(calibrated))
    console.print(_pairs(calibrated))
    console.print(_errors(calibrated))
    adjusted = calibrated.solution.adjusted
    if adjusted.released:
        console.print(
            f"the board is not flat: its corners lie within {bow_mm(adjusted):.1f} mm of depth. Its shape was "
            f"estimated together with the cameras: {adjusted.total_rms_px():.2f} px RMS instead of "
            f"{calibrated.solution.flat_rms_px:.2f} px"
        )
    if calibrated.left_out:
        console.print("left out:")
        for label, reason in calibrated.left_out.items():
            console.print(f"  {label}: {reason}")
    for warning in calibrated.warnings:
        console.print(f"warning: {warning}", style="yellow")


def print_problems(console: Console, problems: Mapping[str, str]) -> None:
    """Print which pictures could not be used, by reason."""
    by_reason: dict[str, list[str]] = {}
    for label, reason in problems.items():
        by_reason.setdefault(reason, []).append(label)
    for reason, labels in by_reason.items():
        console.print(f"{reason}, {len(labels)} picture(s): {', '.join(labels)}")


def _cameras(calibrated: Calibrated) -> Table:
    table = figures_table(
        "camera",
        "pictures",
        "RMS px",
        "p95 px",
        "fx px",
        "fy px",
        "cx px",
        "cy px",
        "position mm",
        "± mm",
        "± deg",
        title="Cameras",
    )
    for name, figures in calibrated.cameras.items():
        model = calibrated.models[name]
        lens = zip((model.K[0, 0], model.K[1, 1], model.K[0, 2], model.K[1, 2]), figures.lens_sd[:4], strict=True)
        place = ", ".join(f"{1e3 * value:.1f}" for value in model.center)
        table.add_row(
            name,
            str(figures.pictures),
            f"{figures.rms_px:.3f}",
            f"{figures.p95_px:.3f}",
            *(f"{value:.1f} ±{sd:.1f}" for value, sd in lens),
            place,
            f"{figures.position_sd_mm:.2f}" if figures.position_sd_mm else "-",
            f"{figures.rotation_sd_deg:.3f}" if figures.rotation_sd_deg else "-",
        )
    return table


def _pairs(calibrated: Calibrated) -> Table:
    table = figures_table(
        "cameras",
        "pictures",
        "baseline mm",
        "angle deg",
        "epipolar RMS px",
        "p95 px",
        "p95 px held out",
        title="Pairs",
    )
    for (first, second), figures in calibrated.pairs.items():
        held_out = calibrated.held_out_px.get((first, second))
        table.add_row(
            f"{first}, {second}",
            str(figures.pictures),
            f"{figures.baseline_mm:.2f} ±{figures.baseline_sd_mm:.2f}",
            f"{figures.angle_deg:.2f}",
            f"{figures.epipolar_rms_px:.3f}",
            f"{figures.epipolar_p95_px:.3f}",
            "-" if held_out is None else f"{held_out:.3f}",
        )
    return table


def _errors(calibrated: Calibrated) -> Table:
    table = figures_table(
        "distance",
        "from the calibration mm",
        f"with {MARKER_SIGMA_PX:g} px of marker noise mm",
        "near the rim mm",
        title="Error to expect in space",
    )
    for error in calibrated.errors:
        table.add_row(
            f"{100 * error.distance_m:.0f} cm",
            f"{error.calibration_mm:.2f}",
            f"{error.total_mm:.2f}",
            f"{error.rim_mm:.2f}",
        )
    return table


_UNITS_M: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}


@click.command()
@click.argument("recording", required=False, type=click.Path(path_type=Path))
@board_options
@click.option("--baseline-mm", type=FiniteRange(min=1.0), help="Measured distance of the first two lenses; checked.")
@live_option()
@click.option("--pictures", "out", type=click.Path(path_type=Path), help="With --live: folder to keep the pictures in.")
@click.option("--enough", type=click.IntRange(min=5), help="With --live: stop after this many pictures.")
@dry_run_option
@click.option(
    "--import",
    "imported",
    multiple=True,
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Read another program's calibration: OpenCV YAML, ROS camera_info, Anipose or Caliscope TOML. Repeatable.",
)
@click.option(
    "--unit",
    type=click.Choice([*_UNITS_M, "square"]),
    help="With --import: unit of the file's lengths; square needs --square-mm.",
)
@click.option("--names", help="With --import: rig names of the file's cameras, in its order, such as left,right.")
@click.option(
    "--export",
    "exported",
    type=click.Path(path_type=Path),
    help="Write the rig's calibration as OpenCV YAML into this folder.",
)
@rig_option
@bus_options
def cameras(
    recording: Path | None,
    counts: str | None,
    square_mm: float | None,
    marker_mm: float | None,
    dictionary: str,
    baseline_mm: float | None,
    live: bool,
    out: Path | None,
    enough: int | None,
    dry_run: bool,
    imported: tuple[Path, ...],
    unit: str | None,
    names: str | None,
    exported: Path | None,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Calibrate the lenses and positions of all cameras from pictures of a board.

    \b
    rhot calibrate cameras pictures --rig myrig --board 9x6 --square-mm 25
    rhot calibrate cameras --live   --rig myrig --board 9x6 --square-mm 25
    rhot calibrate cameras --import intrinsics.yml --import extrinsics.yml --unit mm --rig myrig
    rhot calibrate cameras --export opencv --rig myrig

    The folder of pictures holds one folder per camera of the rig, with pictures such as left/000001.png and
    right/000001.png; those of the same number were taken together. Take 20 to 40: the board still, near and far, in
    every part of the picture, tilted by 20 to 40 degrees in all directions. `rhot calibrate board` draws one to print.

    Pictures that do not fit are excluded and listed. An implausible result is rejected, and nothing is written. The
    result is cameras.json in the rig folder, with its quality figures; the previous file is kept as
    cameras.previous.json.
    """
    rig = load_rig(rig_path)
    console = Console(soft_wrap=True, markup=False, highlight=False, width=max(Console().width, 118))
    asked = [recording is not None, live, bool(imported)]
    if sum(asked) > 1:
        raise ConfigError("give one of: a folder of pictures, --live, --import")
    if imported:
        _import(rig, imported, unit, square_mm, names, dry_run, console)
    elif recording is not None or live:
        board = stated_board(counts, square_mm, marker_mm, dictionary)
        if live:
            folder = out or Path(f"calibration-{datetime.now().astimezone():%Y%m%d-%H%M%S}")
            config = tool_bus(rig_path, connect, namespace)
            errors = Console(stderr=True)
            views = asyncio.run(collect(config, list(rig.cameras), board, folder, errors, enough=enough))
            reading = PictureReading(views)
            again = f"rhot calibrate cameras {as_argument(folder)} --board {counts} --square-mm {square_mm:g}"
            console.print(f"the pictures are in {folder}; to calibrate from them again: {again}")
        else:
            reading = _read(rig, recording or Path(), board)
        _calibrate(rig, reading, baseline_mm, dry_run, console)
    elif exported is None:
        raise ConfigError("nothing to calibrate from: give a folder of pictures, --live or --import; see --help")
    if exported is not None:
        _export(rig_path, exported, console)


def _read(rig: Rig, recording: Path, board: Board) -> PictureReading:
    sizes = {name: (camera.width, camera.height) for name, camera in rig.config.cameras.items()}
    count = MofNCompleteColumn(), TextColumn("pictures")
    columns = TextColumn("searching for the board"), BarColumn(), *count, TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("")
        return read_pictures(
            recording,
            board,
            list(rig.cameras),
            lambda done, total: progress.update(task, completed=done, total=total),
            sizes,
            lambda text: progress.console.print(f"warning: {text}", markup=False, highlight=False, soft_wrap=True),
        )


def _calibrate(rig: Rig, reading: PictureReading, baseline_mm: float | None, dry_run: bool, console: Console) -> None:
    print_problems(console, reading.problems)
    refuse_other_board(reading)
    baseline_m = None if baseline_mm is None else 1e-3 * baseline_mm
    with Console(stderr=True).status("calibrating") as status:
        found = calibrate_rig(rig, reading.views, baseline_m, lambda step: status.update(f"calibrating: {step}"))
    print_report(console, found)
    _write(rig.path, cameras_file(found, reading.views), dry_run, console)


def _import(
    rig: Rig,
    files: Sequence[Path],
    unit: str | None,
    square_mm: float | None,
    names: str | None,
    dry_run: bool,
    console: Console,
) -> None:
    if unit == "square" and square_mm is None:
        raise ConfigError("--unit square needs --square-mm, the side of a square")
    unit_m = 1e-3 * (square_mm or 0.0) if unit == "square" else _UNITS_M.get(unit or "")
    nominal = {name: nominal_camera(camera) for name, camera in rig.config.cameras.items()}
    chosen = None if names is None else [name.strip() for name in names.split(",")]
    file = import_cameras(files, nominal, unit_m=unit_m, names=chosen)
    for name, camera in file.cameras.items():
        place = ", ".join(f"{1e3 * row[3]:.1f}" for row in camera.T_rig_camera[:3])
        console.print(f"{name}: focal length {camera.K[0][0]:.1f} px, at ({place}) mm")
    _write(rig.path, file, dry_run, console)


def _write(rig_path: Path, file: CamerasFile, dry_run: bool, console: Console) -> None:
    then = "Running services read it when they start again."
    write_found(console, rig_path / CAMERAS_FILE, file, then, dry_run=dry_run)


def _export(rig_path: Path, folder: Path, console: Console) -> None:
    file = rig_path / CAMERAS_FILE
    if not file.exists():
        raise CalibrationError(f"{file} is not there: nothing to export; calibrate or import first")
    for written in export_opencv_yaml(read_json_model(file, CamerasFile), folder):
        console.print(f"{written} written")
