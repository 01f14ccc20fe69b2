"""`rhot evaluate calibration`."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

import click
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rhot.arrays import FloatArray
from rhot.bus import Bus
from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import BusError, CalibrationError, ConfigError
from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame
from rhot.offline import marker_frames
from rhot.recording import load_recording
from rhot.rig import BusConfig, CamerasFile, Rig, load_rig, read_json_model
from rhot.rig.folder import CAMERAS_FILE
from rhot.trial.calibration_check import judge_calibration
from rhot.trial.epipolar_residuals import Track
from rhot.trial.marker_tracks import TrackGatherer
from rhot_calibration.cameras.board.boards import parse_board
from rhot_calibration.cameras.pictures import read_views
from rhot_calibration.cameras.solve.views import Board, ViewSet
from rhot_tools.measures.provenance import provenance
from rhot_tools.moved_cameras.report import Seen, print_report, report_json

_CONNECT_TIMEOUT_S: Final = 5.0


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
    cameras = {name: CameraModel.from_calibration(camera) for name, camera in rig.cameras.items()}
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
) -> Seen:
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
    return Seen(gatherer.tracks(), gatherer.periods_s(), gatherer.start_ns())


def _board_seen(path: Path, board: Board, cameras: Mapping[str, CameraModel]) -> Seen:
    """Return what pictures show of a board."""
    with _progress("pictures") as progress:
        task = progress.add_task("", total=None)
        sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
        views = read_views(
            path, board, list(cameras), lambda done, total: progress.update(task, completed=done, total=total), sizes
        )
    return Seen(_board_tracks(views, cameras), dict.fromkeys(cameras, 0.0), None)


def _board_tracks(views: ViewSet, cameras: Mapping[str, CameraModel]) -> dict[str, dict[str, Track]]:
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
            corner: Track(np.array(sorted(places), dtype=np.float64), np.array([places[n] for n in sorted(places)]))
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
    """Gather what the running rig publishes.

    Raises:
        BusError: no router, or no marker frame in all that time.
    """
    async with await Bus.open(bus_config, timeout_s=_CONNECT_TIMEOUT_S) as bus:
        with _progress("seconds") as progress:
            task = progress.add_task("", total=round(seconds))
            loop = asyncio.get_running_loop()
            begun = loop.time()
            try:
                async with asyncio.timeout(seconds):
                    async for _, frame in bus.events("rhot/markers/*").messages(MarkerFrame):
                        progress.update(task, completed=int(loop.time() - begun))
                        gatherer.add([frame])
            except TimeoutError:
                progress.update(task, completed=round(seconds))
    if not any(gatherer.frames.values()):
        raise BusError(
            f"no marker frame came in {seconds:g} s; is the rig running and started (`rhot status`, `rhot start`)?"
        )
