"""`rhot evaluate streams`: fusion on recorded marker tracks of a real rig, without a truth."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final

import click
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from rhot.cli.options import rig_folder_option
from rhot.errors import ConfigError
from rhot.messages import PointSet
from rhot.recording import MarkerTrack, Recording, load_recording, marker_track_frames
from rhot.rig import Rig, load_rig
from rhot.rig.folder import RIG_FILE, write_text_atomic
from rhot.rig.template import rig_template
from rhot_bench.processes import read_table
from rhot_fusion.core import FusionCore
from rhot_tools.measures.output import counted, json_option, quick_option, show
from rhot_tools.measures.rows import Row, Section, check_output
from rhot_tools.measures.streams import Stream, lateral_delay, measured_glitches, rest_noise_m, step_p99_m

_STEP_MM: Final = {"hand_recovered": 40.0, "hand_as_sent": 60.0}
_RATE_HZ: Final = 30.0


@click.command()
@click.argument("data_path", metavar="DATA", type=click.Path(path_type=Path))
@rig_folder_option("Rig of the recordings; two parallel cameras 75 mm apart when not given.")
@quick_option("Only the first 600 frames of each.")
@json_option
def streams(data_path: Path, rig_path: Path | None, quick: bool, json_path: Path | None) -> None:
    """Run recorded marker tracks through fusion, and measure steps, delay and noise at rest.

    DATA is a recording whose cameras hold markers.csv, or a folder of such recordings. There is no ground truth. Steps
    are those between consecutive frames. The delay is how far the sideways position lags behind the picture. The hand
    is at rest wherever the recorded pixels stay within 2 px for half a second. A masks.csv (frame, one column a marker,
    bits 2 and 8 for glitches) is only used to check whether a glitch was accepted.
    """
    check_output("--json", json_path)
    found = _recordings(data_path)
    sections = []
    with (
        tempfile.TemporaryDirectory(prefix="rhot-streams-") as folder,
        counted(Console(stderr=True)) as progress,
    ):
        for path in found:
            recording = load_recording(path)
            rig = load_rig(rig_path) if rig_path is not None else _parallel_rig(Path(folder), recording)
            stream = _run(rig, recording, 600 if quick else None, progress)
            sections.append(_section(path, recording, rig, stream))
    show("evaluate streams", sections, json_path, quick=quick)


def _recordings(path: Path) -> list[Path]:
    """Return the folders of recordings with marker tracks at or below a path.

    Raises:
        ConfigError: there are none.
    """
    found = sorted({file.parent.parent for file in path.glob("**/markers.csv")}) if path.is_dir() else []
    if not found:
        raise ConfigError(f"{path}: holds no recording with marker tracks (<camera>/markers.csv)")
    return found


def _parallel_rig(folder: Path, recording: Recording) -> Rig:
    names = tuple(recording.cameras)
    text = rig_template(
        folder=str(folder),
        name="streams",
        cameras=names,
        camera_xs_m=[0.075 * k for k in range(len(names))],
        rate_hz=_RATE_HZ,
    )
    write_text_atomic(folder / RIG_FILE, text)
    return load_rig(folder)


def _run(rig: Rig, recording: Recording, limit: int | None, progress: Progress) -> Stream:
    """Feed a recording to fusion and lay what comes out beside what went in, frame by frame."""
    tracks = [track for track in recording.cameras.values() if isinstance(track, MarkerTrack)]
    if len(tracks) < 2 or len(tracks) < len(recording.cameras):
        raise ConfigError(f"{recording.path}: marker tracks of two cameras or more are needed")
    numbers = np.unique(np.concatenate([track.frames for track in tracks]))[:limit]
    row_of = {int(number): row for row, number in enumerate(numbers)}
    names = list(rig.config.markers)
    count = len(numbers)
    stream = Stream(
        uv=_pixels(tracks, row_of, names, count),
        positions=np.full((count, len(names), 3), np.nan),
        measured=np.zeros((count, len(names)), dtype=np.bool_),
        views=np.zeros((count, len(names)), dtype=np.int64),
    )
    core = FusionCore(rig)
    task = progress.add_task(f"fusing frames of {recording.path.name}", total=count * len(tracks))
    for frame in marker_track_frames(rig, recording):
        row = row_of.get(frame.frame if frame.frame is not None else -1)
        if row is None:
            continue
        for _, points in core.feed(frame):
            for column, name in enumerate(names):
                point = points.points.get(name) if isinstance(points, PointSet) else None
                if point is not None:
                    stream.positions[row, column] = point.position
                    stream.measured[row, column] = point.state == "measured"
                    stream.views[row, column] = point.views
        progress.advance(task)
    return stream


def _pixels(tracks: list[MarkerTrack], row_of: dict[int, int], names: list[str], count: int) -> NDArray[np.float64]:
    uv = np.full((len(tracks), count, len(names), 2), np.nan)
    for camera, track in enumerate(tracks):
        for frame, marker, place in zip(track.frames.tolist(), track.marker.tolist(), track.uv, strict=True):
            name = track.markers[marker]
            if frame in row_of and name in names:
                uv[camera, row_of[frame], names.index(name)] = place
    return uv


def _section(path: Path, recording: Recording, rig: Rig, stream: Stream) -> Section:
    sideways, depth = (np.sort(values) * 1e3 for values in rest_noise_m(stream))
    rests = f"{len(sideways)} stretches of half a second"
    rows = [
        Row("step from frame to frame, p99", step_p99_m(stream) * 1e3, "mm", most=_STEP_MM.get(path.name)),
        Row("sideways delay behind the picture", abs(lateral_delay(stream)), "frames", most=0.5),
        Row("noise at rest, sideways, median", _share(sideways, 50), "mm", most=1.0, note=rests, peer="thesis: 2–5 px"),
        Row("noise at rest, sideways, p95", _share(sideways, 95), "mm"),
        Row("noise at rest, in depth, median", _share(depth, 50), "mm", most=4.0, note=rests),
        Row("noise at rest, in depth, p95", _share(depth, 95), "mm"),
        Row("points that are measured", 100.0 * float(stream.measured.mean()), "%"),
    ]
    masks = path / "masks.csv"
    if masks.exists():
        glitch = _glitches(masks, recording, rig, len(stream.positions))
        note = f"measured by both views while one is marked as a glitch, of {int(glitch.sum())} glitches"
        rows.append(Row("glitches published as measured", measured_glitches(stream, glitch), most=0, note=note))
    return Section(
        f"{path.name}, {len(stream.positions)} frames, fusion method {rig.config.fusion.method}", tuple(rows)
    )


def _glitches(masks: Path, recording: Recording, rig: Rig, count: int) -> NDArray[np.bool_]:
    """Return (N, M) which samples a recording's masks call a glitch of either view."""
    table = read_table(masks)
    frames = [track.frames for track in recording.cameras.values() if isinstance(track, MarkerTrack)]
    row_of = {int(number): row for row, number in enumerate(np.unique(np.concatenate(frames))[:count])}
    glitch = np.zeros((count, len(rig.config.markers)), dtype=np.bool_)
    for column, name in enumerate(rig.config.markers):
        if name in table:
            for frame, bits in zip(table["frame"].astype(int).tolist(), table[name].astype(int).tolist(), strict=True):
                if frame in row_of:
                    glitch_bits = 2 | 8
                    glitch[row_of[frame], column] = bool(bits & glitch_bits)
    return glitch


def _share(values: NDArray[np.float64], share: float) -> float:
    return float(np.percentile(values, share)) if values.size else float("nan")
