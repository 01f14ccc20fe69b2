"""`rhot calibrate objects`."""

from __future__ import annotations

import asyncio
import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from rhot.arrays import FloatArray
from rhot.atomic_file import why_unread
from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import CalibrationError, ConfigError
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.report.html import figures_table
from rhot.rig import BusConfig, RegistrationFile, Rig, load_rig
from rhot.rig.config import ObjectSource
from rhot.rig.folder import registration_name, registration_path
from rhot_calibration.objects.checks import check_fit, check_places, lever_note, scale_note
from rhot_calibration.objects.fit import Estimate, Places, RegistrationFit, first_prior, fit_registration
from rhot_calibration.objects.live import PlaceCollector, PosePair, collect_places
from rhot_calibration.objects.record import (
    RegistrationQuality,
    change,
    check_change,
    prior_of,
    read_quality,
    registration_file,
)
from rhot_calibration.objects.touch.command import calibrate_by_touch
from rhot_calibration.objects.touch.streams import TOUCHES_A_FACE, touch_task
from rhot_calibration.options import dry_run_option, live_option
from rhot_calibration.writing import write_found

# The options of `rhot calibrate objects --touch`.

_Command = TypeVar("_Command", bound=Callable[..., Any])

_OPTIONS: Final = (
    click.option(
        "--touch",
        "touched",
        metavar="ID",
        help="Find where this object sits on its tracker: touch its faces with a tracked fingertip.",
    ),
    click.option("--finger", default="index", show_default=True, help="With --touch: whose tip touches."),
    click.option("--hand", "side", type=click.Choice(["left", "right"]), help="With --touch; else the rig's first."),
    click.option(
        "--faces", metavar="A,B,…", default="", help="With --touch: the faces in this order; else all but the bottom."
    ),
    click.option(
        "--per-face",
        type=click.IntRange(1, 30),
        default=TOUCHES_A_FACE,
        show_default=True,
        help="With --touch: how often each face is touched, three times that all round.",
    ),
)


def touch_options(command: _Command) -> _Command:
    """Add the options to a command, in their order."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def source_of(table: Path | None, live: bool, bus: BusConfig) -> BusConfig | Path:
    """Return where touches come from: the running rig unless a recording is named.

    Raises:
        ConfigError: both are named, or the file is not there.
    """
    if table is None:
        return bus
    if live:
        raise ConfigError("--touch takes a recording or --live, not both")
    if not table.exists():
        raise ConfigError(f"{table} is not there; name a recording of `rhot record`, or none for the running rig")
    return table


# Places in a CSV table.

COLUMNS: Final = (
    *("rig_x_m", "rig_y_m", "rig_z_m"),
    *("tracker_x_m", "tracker_y_m", "tracker_z_m"),
    *("tracker_qx", "tracker_qy", "tracker_qz", "tracker_qw"),
)
SIGMA_COLUMN: Final = "sigma_m"
STATED_SIGMA_M: Final = 1e-3
"""Noise of each coordinate of a place where the table states none; the fit finds the true one from the residuals."""
_LARGEST_M: Final = 100.0
_NORM_TOLERANCE: Final = 0.01


def read_places(file: Path) -> Places:
    """Return the places of a CSV table.

    The header names the columns, in any order: `rig_x_m`, `rig_y_m`, `rig_z_m` (the marker, metres, rig frame),
    `tracker_x_m`, `tracker_y_m`, `tracker_z_m` (the device, metres, tracker space), `tracker_qx`, `tracker_qy`,
    `tracker_qz`, `tracker_qw` (its orientation, unit quaternion), and where it is known `sigma_m` (standard deviation
    of each coordinate). Others are ignored.

    Raises:
        CalibrationError: unreadable, a column is missing, or a value cannot be; names line and column.
    """
    names: list[str] = []
    rows: list[list[float]] = []
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            header = reader.fieldnames or []
            missing = [name for name in COLUMNS if name not in header]
            if missing:
                raise CalibrationError(f"{file}:1: no column {missing[0]}; the header needs {', '.join(COLUMNS)}")
            wanted = [*COLUMNS, *([SIGMA_COLUMN] if SIGMA_COLUMN in header else [])]
            for row in reader:
                values = [_number(file, reader.line_num, name, row[name]) for name in wanted]
                rows.append([*values, STATED_SIGMA_M][: len(COLUMNS) + 1])
                names.append(f"{file.name}:{reader.line_num}")
                _check(file, reader.line_num, rows[-1])
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{file}: cannot be read: {why_unread(error)}") from error
    table = np.array(rows, dtype=np.float64).reshape(-1, len(COLUMNS) + 1)
    return Places(
        names=tuple(names),
        x_rig=table[:, 0:3],
        sigma_m=table[:, 10],
        R_space_device=rotation_from_quaternion(table[:, 6:10]),
        p_space_device=table[:, 3:6],
    )


def _check(file: Path, line: int, values: list[float]) -> None:
    for name, value in zip(COLUMNS[:6], values[:6], strict=True):
        if abs(value) > _LARGEST_M:
            raise CalibrationError(f"{file}:{line}: {name} is {value:g} m; are the columns in millimetres?")
    norm = math.hypot(*values[6:10])
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise CalibrationError(
            f"{file}:{line}: tracker_qx … tracker_qw has norm {norm:.4g}, must be 1; are the columns mixed up?"
        )
    if not 0.0 < values[10] < 1.0:
        raise CalibrationError(f"{file}:{line}: {SIGMA_COLUMN} is {values[10]:g} m; it must lie between 0 and 1")


def _number(file: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError as error:
        raise CalibrationError(f"{file}:{line}: {name} is '{(text or '')[:40]}', not a number") from error
    if not math.isfinite(value):
        raise CalibrationError(f"{file}:{line}: {name} is {value}; it must be finite")
    return value


# A registration in a table and lines for people.


def places_table(places: Places, fit: RegistrationFit) -> Table:
    """Return each place with what it is off."""
    table = figures_table("place", "x mm", "y mm", "z mm", "off mm")
    table.add_column("")
    for name, x, off, kept in zip(places.names, places.x_rig, fit.residual_m, fit.kept, strict=True):
        cells = [f"{1e3 * value:.1f}" for value in (*x, off)]
        table.add_row(name, *cells, "" if kept else "left out: contradicts the others")
    return table


def report(console: Console, fit: RegistrationFit, prior: Estimate | None) -> None:
    """Print how good a registration is, and what a correction of `prior` changed."""
    estimate = fit.estimate
    if prior is not None:
        moved_m, turned_rad = change(prior, estimate)
        console.print(f"changed by {1e3 * moved_m:.2f} mm amid the places and by {np.degrees(turned_rad):.3f}°")
    sd = 1e3 * float(np.linalg.norm(estimate.position_sd_m))
    x, y, z = 1e3 * estimate.lever_m
    sd_x, sd_y, sd_z = 1e3 * estimate.lever_sd_m
    console.print(f"residual       {1e3 * fit.rms_m:.2f} mm RMS over {np.count_nonzero(fit.kept)} places")
    console.print(f"position       ± {sd:.2f} mm amid the places (one standard deviation)")
    console.print(f"rotation       ± {np.degrees(estimate.rotation_sd_rad):.3f}° about its least certain axis")
    console.print(
        f"marker on the device at {x:.1f} ± {sd_x:.1f}, {y:.1f} ± {sd_y:.1f}, {z:.1f} ± {sd_z:.1f} mm, device axes"
    )


_UNKNOWN_LEVER_SD_M: Final = 0.05
"""A marker sits on a tracker of 10 cm, somewhere."""
_PATIENCE_S: Final = 15.0


def _lever(ctx: click.Context, param: click.Parameter, text: str | None) -> FloatArray | None:
    """Return a lever arm (3,), metres, of three numbers in millimetres."""
    if text is None:
        return None
    try:
        lever_mm = np.array([float(part) for part in text.split(",")])
    except ValueError as error:
        raise click.BadParameter(f"{text!r} is not three numbers, such as 0,-12.5,30") from error
    if lever_mm.shape != (3,) or not np.isfinite(lever_mm).all() or np.abs(lever_mm).max() > 1000.0:
        raise click.BadParameter(f"{text!r} is not three lengths in mm, such as 0,-12.5,30")
    return np.asarray(1e-3 * lever_mm, np.float64)


@dataclass(frozen=True, slots=True)
class _Shown:
    """What was held before the cameras; empty where a table does not say it."""

    object_id: str = ""
    marker: str = ""


@dataclass(frozen=True, slots=True)
class _Earlier:
    """The registration that is there, and its record where it has one."""

    file: RegistrationFile
    record: RegistrationQuality | None


@click.command()
@click.argument("table", metavar="[PLACES.csv]", required=False, type=click.Path(path_type=Path, dir_okay=False))
@live_option("Take the places from the running rig; needs --object and --marker.")
@click.option("--object", "object_id", metavar="ID", help="The tracked device, as in [objects.ID] of rig.toml.")
@click.option("--marker", metavar="NAME", help="The marker that is fixed to it (or touched with it).")
@click.option(
    "--places", "wanted", type=click.IntRange(1, 100), default=10, show_default=True, help="Places to take, live."
)
@click.option(
    "--lever",
    metavar="X,Y,Z",
    callback=_lever,
    help="Where the marker sits on the device, mm in the device's own axes; found out when the tracker is turned.",
)
@click.option(
    "--lever-sd-mm",
    type=FiniteRange(min=0.01, max=100),
    default=2.0,
    show_default=True,
    help="How well --lever is known, mm (standard deviation).",
)
@click.option("--realign", is_flag=True, help="Correct the existing registration, with a few places or even one.")
@click.option(
    "--drift-mm",
    type=FiniteRange(min=0.01, max=1000),
    default=5.0,
    show_default=True,
    help="With --realign: by how much it has probably moved since.",
)
@click.option(
    "--drift-deg",
    type=FiniteRange(min=0.001, max=90),
    default=0.2,
    show_default=True,
    help="With --realign: by how much it has probably turned since.",
)
@touch_options
@dry_run_option
@rig_option
@bus_options
def objects(
    table: Path | None,
    live: bool,
    object_id: str | None,
    marker: str | None,
    wanted: int,
    lever: FloatArray | None,
    lever_sd_mm: float,
    realign: bool,
    drift_mm: float,
    drift_deg: float,
    touched: str | None,
    finger: str,
    side: str | None,
    faces: str,
    per_face: int,
    dry_run: bool,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Register the tracking system's space (SteamVR) to the rig, so that objects and hand share one frame.

    Fix a painted marker to a tracker (or touch a marker with it) and hold it still before the cameras at ten places:
    the corners of the space where you work and its middle, near and far, turned by about 60° to all sides. From that
    follow the registration and where the marker sits on the tracker.

    \b
    rhot calibrate objects --live --object cup --marker index --rig RIG
    rhot calibrate objects places.csv --rig RIG
    rhot calibrate objects --live --object cup --marker index --realign --places 1 --rig RIG

    PLACES.csv has one row a place and a header: rig_x_m, rig_y_m, rig_z_m (the marker, metres, rig frame),
    tracker_x_m, tracker_y_m, tracker_z_m, tracker_qx, tracker_qy, tracker_qz, tracker_qw (the device in the tracking
    system's space) and, where known, sigma_m (noise of each coordinate).

    Once that is done, --touch finds where an object with a `shape` in rig.toml sits on its tracker. Touch the named
    faces with a tracked fingertip and hold still; each touch is recorded automatically. Faces of a box: top (+y),
    bottom, front (+z), back, right (+x), left; of a cylinder: top (+z), bottom, side; a sphere: anywhere.

    \b
    rhot calibrate objects --touch cup --rig RIG
    rhot calibrate objects --touch cup TOUCHES.mcap --rig RIG

    Writes registration.SOURCE.json, such as registration.steamvr.json; the previous file is kept as
    registration.SOURCE.previous.json.
    """
    rig = load_rig(rig_path)
    if touched:
        origin = source_of(table, live, tool_bus(rig_path, connect, namespace))
        task = touch_task(rig, touched, side=side or "", finger=finger, faces=faces, per_face=per_face)
        calibrate_by_touch(rig, task, origin, dry_run=dry_run)
        return
    shown = _Shown(object_id or "", marker or "")
    source = _source_of(rig, shown)
    file = rig_path / registration_name(source)
    held, before = registration_path(rig_path, source), rig.registration_of(source)
    earlier = _Earlier(before, read_quality(held or file, before))
    if realign and held is None:
        raise ConfigError(f"{file} is not there; --realign corrects one, so register once without it")
    if live:
        if table is not None or not object_id or not marker:
            raise ConfigError("--live needs --object ID and --marker NAME, and no table")
        _check_names(rig, shown)
        places = _live_places(rig, tool_bus(rig_path, connect, namespace), shown, wanted)
    elif table is None:
        raise ConfigError("give a table of places (PLACES.csv), or --live with --object and --marker")
    else:
        places = read_places(table)
    console = Console(soft_wrap=True, markup=False, highlight=False)
    lever_sd_m = _UNKNOWN_LEVER_SD_M if lever is None else 1e-3 * lever_sd_mm
    if realign:
        drift = 1e-3 * drift_mm, float(np.radians(drift_deg))
        prior = _realign_prior(earlier, places, shown, lever, lever_sd_m, drift)
        fit = fit_registration(places, prior)
        check_change(prior, fit.estimate)
    else:
        check_places(places)
        prior = None
        fit = fit_registration(places, first_prior(places, np.zeros(3) if lever is None else lever, lever_sd_m))
    _tell(console, places, fit, prior)
    written = registration_file(fit, places, before, object_id=shown.object_id, marker=shown.marker, prior=prior)
    then = "`rhot objects` takes it when it is started again."
    write_found(console, file, written, then, before=held, dry_run=dry_run)


def _tell(console: Console, places: Places, fit: RegistrationFit, prior: Estimate | None) -> None:
    """Print the places, the result and what is odd about it; `prior` = what was corrected.

    Raises:
        CalibrationError: the result cannot be right.
    """
    console.print(places_table(places, fit))
    check_fit(fit)
    report(console, fit, prior)
    notes = [scale_note(places, fit), lever_note(fit)]
    if prior is not None and np.count_nonzero(fit.kept) == 1:
        notes.append("one place cannot tell how the space has turned: only its position was corrected")
    for note in filter(None, notes):
        console.print(f"note: {note}", style="yellow")


def _realign_prior(
    earlier: _Earlier,
    places: Places,
    shown: _Shown,
    lever: FloatArray | None,
    lever_sd_m: float,
    drift: tuple[float, float],
) -> Estimate:
    """Return what the earlier registration says; `drift` in metres and radians."""
    if not len(places):
        raise CalibrationError("no place was given; one is the least for --realign")
    if lever is None and earlier.record is not None and not _same(shown, earlier.record):
        lever = np.zeros(3)
    return prior_of(
        earlier.file,
        earlier.record,
        places,
        lever_m=lever,
        lever_sd_m=lever_sd_m,
        drift_m=drift[0],
        drift_rad=drift[1],
    )


def _source_of(rig: Rig, shown: _Shown) -> ObjectSource:
    """Return the source of tracking that is registered: that of the object, else the only one, else SteamVR."""
    objects = rig.config.objects
    if shown.object_id in objects:
        return objects[shown.object_id].source
    sources = sorted({config.source for config in objects.values()})
    if len(sources) > 1 and not shown.object_id:
        raise ConfigError(f"the rig's objects come from {' and '.join(sources)}; say with --object ID which was shown")
    return sources[0] if len(sources) == 1 else "steamvr"


def _check_names(rig: Rig, shown: _Shown) -> None:
    toml = rig.path / "rig.toml"
    if shown.object_id not in rig.config.objects:
        there = ", ".join(rig.config.objects) or "none"
        raise ConfigError(f"{toml}: no [objects.{shown.object_id}]; there is {there}. Add it, or correct --object")
    if shown.marker not in rig.config.markers:
        raise ConfigError(
            f"{toml}: no [markers.{shown.marker}]; there is {', '.join(rig.config.markers)}. Correct --marker"
        )


def _same(shown: _Shown, record: RegistrationQuality) -> bool:
    """Tell whether the marker sits on the device as it did; a table that names neither is taken to mean so."""
    return all(
        not now or not before or now == before
        for now, before in ((shown.object_id, record.object), (shown.marker, record.marker))
    )


def _live_places(rig: Rig, bus: BusConfig, shown: _Shown, wanted: int) -> Places:
    console = Console(stderr=True, soft_wrap=True, markup=False, highlight=False)
    collector = PlaceCollector()
    console.print(
        f"Hold {shown.object_id} with marker {shown.marker} still before the cameras at {wanted} places; Ctrl-C ends "
        "with those there are."
    )

    def taken(place: PosePair) -> None:
        x, y, z = 1e3 * place.x_rig
        console.print(f"place {len(collector.places)} of {wanted} taken at {x:.0f}, {y:.0f}, {z:.0f} mm", style="green")

    def hint(text: str) -> None:
        console.print(f"  … {text}")

    try:
        asyncio.run(
            collect_places(
                bus,
                rig,
                shown.object_id,
                shown.marker,
                collector,
                wanted=wanted,
                patience_s=_PATIENCE_S,
                taken=taken,
                hint=hint,
            )
        )
    except KeyboardInterrupt:
        if not collector.places:
            raise
        console.print(f"ended with {len(collector.places)} places")
    return collector.to_places()
