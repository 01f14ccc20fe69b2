"""`rhot evaluate calibration`."""

from __future__ import annotations

import asyncio
import datetime as dt
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from rhot.arrays import FloatArray
from rhot.bus import CONNECT_S, Bus
from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import BusError, CalibrationError, ConfigError
from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame
from rhot.offline import marker_frames
from rhot.recording import load_recording
from rhot.report.html import figures_table
from rhot.rig import BusConfig, CamerasFile, Rig, load_rig, read_json_model
from rhot.rig.cameras import camera_models
from rhot.rig.folder import CAMERAS_FILE
from rhot.text import as_argument
from rhot_calibration.cameras.board.grid import parse_board
from rhot_calibration.cameras.pictures import read_views
from rhot_calibration.cameras.solve.views import Board, ViewSet
from rhot_tools.measures.provenance import provenance
from rhot_tools.trial.calibration_check import AXES, CalibrationReport, CameraRotation, PairReport, judge_calibration
from rhot_tools.trial.epipolar_residuals import PixelTrack, TrackGatherer, Tracks

# What `rhot evaluate calibration` tells: for people, and as JSON.

_COLORS: Final = {"good": "green", "drifting": "yellow", "bumped": "red"}
_DEPTH_NOTE: Final = (
    "A turn that moves points along their epipolar lines (yaw, for cameras side by side) changes depth and leaves no "
    "trace here; only `rhot calibrate cameras` finds it."
)
_CLOCK_FROM_NS: Final = 1_000_000_000_000_000_000
"""Times above are of the calendar (2001 on); smaller ones of a recording's own clock."""


@dataclass(frozen=True, slots=True)
class SeenTracks:
    """What the cameras saw.

    Attributes:
        tracks: of each camera.
        periods_s: time between two frames of each camera.
        start_ns: time from which the tracks' seconds count; None = they are numbers of pictures.
    """

    tracks: Tracks
    periods_s: Mapping[str, float]
    start_ns: int | None

    def moment(self, t_s: float) -> str:
        """Return a moment of the tracks for people."""
        if self.start_ns is None:
            return f"picture {t_s:.0f}"
        if self.start_ns < _CLOCK_FROM_NS:
            return f"{t_s:.0f} s"
        moment = dt.datetime.fromtimestamp((self.start_ns + t_s * 1e9) * 1e-9, dt.UTC)
        return f"{t_s:.0f} s ({moment:%Y-%m-%d %H:%M:%S} UTC)"

    def moment_json(self, t_s: float) -> dict[str, int]:
        """Return a moment of the tracks as a field."""
        if self.start_ns is None:
            return {"picture": round(t_s)}
        return {"t_ns": self.start_ns + round(t_s * 1e9)}


def print_report(report: CalibrationReport, file: CamerasFile, seen: SeenTracks, rig_path: Path) -> None:
    """Print the verdict with everything it rests on, to standard output."""
    console = Console(soft_wrap=True, markup=False, highlight=False)
    console.print(_pairs_table(report))
    console.print("Pixels off the epipolar line; shift: what a turn of a camera would cause, without the noise.\n")
    for pair in report.pairs:
        for line in _pair_lines(pair, seen):
            console.print(line)
    for name, number in report.skipped.items():
        console.print(f"{name}: only {number} common observations, not judged")
    if report.moved and report.moved_rotation is not None:
        console.print(f"camera {report.moved} has moved: {_rotation_text(report.moved_rotation)}", style="bold")
    elif report.verdict != "good":
        console.print("Which camera moved cannot be told from these views.")
    console.print(_DEPTH_NOTE)
    verdict = {
        "good": "the calibration holds",
        "drifting": "the cameras have moved a little; calibrate again when it suits",
        "bumped": "the cameras have moved since they were calibrated",
    }[report.verdict]
    dated = f" (calibrated {file.date})" if file.date else ""
    console.print(f"{report.verdict}: {verdict}{dated}", style=f"bold {_COLORS[report.verdict]}")
    if report.verdict != "good":
        console.print(f"→ rhot calibrate cameras RECORDING --rig {as_argument(rig_path)} --board 9x6 --square-mm 25")


def _pairs_table(report: CalibrationReport) -> Table:
    table = figures_table("pair", "seen", "median", "RMS", "p95", "p95 then", "shift", "limit")
    table.add_column("verdict")
    for pair in report.pairs:
        calibrated = "–" if pair.calibrated_p95_px is None else f"{pair.calibrated_p95_px:.2f}"
        table.add_row(
            f"{pair.first}-{pair.second}",
            str(pair.observations),
            f"{pair.median_px:+.2f}",
            f"{pair.rms_px:.2f}",
            f"{pair.p95_px:.2f}",
            calibrated,
            f"{pair.systematic_px:.2f}",
            f"{pair.limit_px:.2f}",
            Text(pair.verdict, style=_COLORS[pair.verdict]),
        )
    return table


def _pair_lines(pair: PairReport, seen: SeenTracks) -> Iterator[str]:
    a, b, c = pair.line
    sd_a, sd_b, sd_c = pair.line_sd
    yield f"{pair.first}-{pair.second}: {pair.second} against {pair.first} turned by {_rotation_text(pair.rotation)}"
    yield (
        f"  residual = {a:+.2f} ± {sd_a:.2f} px  {1e3 * b:+.2f} ± {1e3 * sd_b:.2f} px per 1000 px to the right  "
        f"{1e3 * c:+.2f} ± {1e3 * sd_c:.2f} px per 1000 px down; {pair.noise_px:.2f} px of noise"
    )
    early, late = pair.thirds_px
    yield f"  median {early:+.2f} px in the first third, {late:+.2f} px in the last"
    if pair.change is not None and pair.change.step_px > 0.5 * pair.limit_px:
        how = "moved suddenly" if pair.change.sudden else "kept moving, most"
        yield f"  {how} at {seen.moment(pair.change.t_s)}: {pair.change.step_px:.2f} px between before and after"


def _rotation_text(rotation: CameraRotation) -> str:
    parts = []
    for name, value, sd, observed in zip(AXES, rotation.degrees, rotation.sd_degrees, rotation.observed, strict=True):
        parts.append(f"{name} {value:+.2f}° ± {sd:.2f}°" if observed else f"{name} not observable")
    return ", ".join(parts)


def report_json(report: CalibrationReport, file: CamerasFile, seen: SeenTracks) -> dict[str, Any]:
    """Return the report as plain values."""
    moved = report.moved_rotation
    return {
        "verdict": report.verdict,
        "calibrated": file.date,
        "moved": None if moved is None else {"camera": report.moved, **_rotation_json(moved)},
        "pairs": {f"{pair.first}-{pair.second}": _pair_json(pair, seen) for pair in report.pairs},
        "skipped": dict(report.skipped),
    }


def _rotation_json(rotation: CameraRotation) -> dict[str, Any]:
    rows = zip(AXES, rotation.degrees.tolist(), rotation.sd_degrees.tolist(), rotation.observed, strict=True)
    return {"turn_deg": {name: {"value": value, "sd": sd, "observable": seen} for name, value, sd, seen in rows}}


def _pair_json(pair: PairReport, seen: SeenTracks) -> dict[str, Any]:
    change = pair.change
    return {
        "verdict": pair.verdict,
        "observations": pair.observations,
        "median_px": pair.median_px,
        "rms_px": pair.rms_px,
        "p95_px": pair.p95_px,
        "calibrated_p95_px": pair.calibrated_p95_px,
        "systematic_px": pair.systematic_px,
        "noise_px": pair.noise_px,
        "limit_px": pair.limit_px,
        "line": {
            "values": dict(zip(("a_px", "b", "c"), pair.line.tolist(), strict=True)),
            "sd": dict(zip(("a_px", "b", "c"), pair.line_sd.tolist(), strict=True)),
        },
        **_rotation_json(pair.rotation),
        "first_third_px": pair.thirds_px[0],
        "last_third_px": pair.thirds_px[1],
        "change": None
        if change is None
        else {**seen.moment_json(change.t_s), "step_px": change.step_px, "sudden": change.sudden},
    }


def _board(ctx: click.Context, param: click.Parameter, text: str | None) -> Board | None:
    # How large the squares are does not matter to epipolar lines.
    return None if text is None else parse_board(text, 0.025)


@click.command()
@click.argument("recording_path", metavar="[RECORDING]", required=False, type=click.Path(path_type=Path))
@click.option(
    "--live",
    "live_s",
    type=FiniteRange(2.0, 3600.0),
    metavar="SECONDS",
    help="Listen to the running rig this long instead of reading a recording.",
)
@click.option(
    "--board",
    metavar="COLUMNSxROWS",
    callback=_board,
    help="RECORDING shows a chessboard with this many inner corners, such as 9x6, instead of a hand.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of the tables.")
@rig_option
@bus_options
def calibration(
    recording_path: Path | None,
    live_s: float | None,
    board: Board | None,
    as_json: bool,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> int:
    """Check whether the cameras have moved since they were calibrated.

    Any movement of the hand before two cameras or more will do; half a minute over all of the picture is good.
    RECORDING is a folder of pictures, videos or marker tracks, as for `rhot process`.

    \b
    rhot evaluate calibration RECORDING --rig RIG
    rhot evaluate calibration --live 30 --rig RIG

    A point seen by one camera must lie on its epipolar line in the other's image. The distance from that line, and how
    it varies over the image and over time, shows how the cameras have rotated relative to each other.

    The exit code is 1 when they were bumped.
    """
    if (recording_path is None) == (live_s is None):
        raise ConfigError("give either a RECORDING or --live SECONDS")
    if board is not None and recording_path is None:
        raise ConfigError("--board needs a RECORDING of pictures")
    rig = load_rig(rig_path)
    if not rig.calibrated:
        raise CalibrationError(
            f"{rig_path / CAMERAS_FILE} is not there, so there is nothing to check; run `rhot calibrate cameras` first"
        )
    file = read_json_model(rig_path / CAMERAS_FILE, CamerasFile)
    cameras = camera_models(rig.cameras)
    if board is not None and recording_path is not None:
        seen = _board_seen(recording_path, board, cameras)
    else:
        seen = _markers_seen(rig, cameras, recording_path, live_s, tool_bus(rig_path, connect, namespace))
    report = judge_calibration(seen.tracks, cameras, seen.periods_s, file.quality)
    if as_json:
        click.echo(json.dumps({"run": provenance(), **report_json(report, file, seen)}))
    else:
        print_report(report, file, seen, rig_path)
    return 1 if report.verdict == "bumped" else 0


def _markers_seen(
    rig: Rig, cameras: Mapping[str, CameraModel], path: Path | None, live_s: float | None, bus: BusConfig
) -> SeenTracks:
    """Return what a recording or the running rig shows of the markers.

    Raises:
        CalibrationError: fewer than two cameras gave anything.
    """
    gatherer = TrackGatherer(cameras)
    if path is not None:
        recording = load_recording(path)
        total = sum(len(set(track.frames.tolist())) for track in recording.cameras.values())
        with _progress("frames") as progress:
            task = progress.add_task("", total=total)
            gatherer.add(_counted(marker_frames(rig, recording), lambda: progress.advance(task)))
    elif live_s is not None:
        asyncio.run(_listen(bus, live_s, gatherer))
    empty = [name for name, number in gatherer.frames.items() if not number]
    if len(cameras) - len(empty) < 2:
        raise CalibrationError(
            f"only {len(cameras) - len(empty)} of {len(cameras)} cameras gave frames (none from {', '.join(empty)}); "
            "two are the least"
        )
    return SeenTracks(gatherer.tracks(), gatherer.periods_s(), gatherer.start_ns())


def _board_seen(path: Path, board: Board, cameras: Mapping[str, CameraModel]) -> SeenTracks:
    """Return what pictures show of a board."""
    with _progress("pictures") as progress:
        task = progress.add_task("", total=None)
        sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
        views = read_views(
            path, board, list(cameras), lambda done, total: progress.update(task, completed=done, total=total), sizes
        )
    return SeenTracks(_board_tracks(views, cameras), dict.fromkeys(cameras, 0.0), None)


def _board_tracks(views: ViewSet, cameras: Mapping[str, CameraModel]) -> dict[str, dict[str, PixelTrack]]:
    """Return the corners of a board in still pictures as tracks: one per corner, the picture's number for seconds.

    Pictures of the same number were taken together, so nothing is interpolated between them.
    """
    rows: dict[str, dict[str, dict[int, FloatArray]]] = {name: {} for name in cameras}
    for (camera, number), view in views.views.items():
        xy = cameras[camera].undistort(view.corners)
        for corner, place in zip(view.ids.tolist(), xy, strict=True):
            rows[camera].setdefault(str(corner), {})[number] = place
    return {
        camera: {
            corner: PixelTrack(
                np.array(sorted(places), dtype=np.float64), np.array([places[n] for n in sorted(places)])
            )
            for corner, places in corners.items()
        }
        for camera, corners in rows.items()
    }


def _progress(what: str) -> Progress:
    columns = (TextColumn("looking"), BarColumn(), MofNCompleteColumn(), TextColumn(what), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True, soft_wrap=True))


def _counted(frames: Iterator[MarkerFrame], advance: Callable[[], object]) -> Iterator[MarkerFrame]:
    for frame in frames:
        yield frame
        advance()


async def _listen(bus_config: BusConfig, seconds: float, gatherer: TrackGatherer) -> None:
    """Gather what the running rig publishes for some seconds from its first frame on.

    Raises:
        BusError: no router, or no marker frame in all that time.
    """
    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus:
        with _progress("seconds") as progress:
            task = progress.add_task("", total=round(seconds))
            loop = asyncio.get_running_loop()
            begun: float | None = None
            try:
                async with asyncio.timeout(seconds) as ends:
                    async for _, frame in bus.events("rhot/markers/*").messages(MarkerFrame):
                        if begun is None:
                            begun = loop.time()
                            ends.reschedule(begun + seconds)
                        progress.update(task, completed=int(loop.time() - begun))
                        gatherer.add([frame])
            except TimeoutError:
                progress.update(task, completed=round(seconds))
    if not any(gatherer.frames.values()):
        raise BusError(
            f"no marker frame came in {seconds:g} s; is the rig running and started (`rhot status`, `rhot start`)?"
        )
