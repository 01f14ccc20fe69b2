"""`rhot process`: the whole tracker over a recording, with the very cores that run live."""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import IO, Any

import click
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rhot.cli.options import rig_option
from rhot.errors import ConfigError
from rhot.messages import MarkerFrame, Message, PointSet
from rhot.recording import Recording, TrackTiming, load_recording, marker_track_frames
from rhot.rig import Rig, load_rig


def core(name: str) -> Callable[..., Any]:
    """Return a service's core by its entry point.

    Raises:
        ConfigError: it is not installed here.
    """
    found = list(entry_points(group="rhot.stages", name=name))
    try:
        if found:
            loaded: Callable[..., Any] = found[0].load()
            return loaded
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"offline tracking needs the Python module {error.name}, which is not installed; pip install 'rhot[{name}]'"
        ) from error
    raise ConfigError(f"offline tracking needs the {name} part of RHOT; pip install 'rhot[{name}]'")


def track(rig: Rig, frames: Iterator[MarkerFrame]) -> Iterator[tuple[str, Message]]:
    """Yield every message that a live rig would have published for these marker frames, in order."""
    yield from track_with(core("fusion")(rig), core("ik")(rig), frames)


def track_with(fusion: Any, ik: Any, frames: Iterable[MarkerFrame]) -> Iterator[tuple[str, Message]]:
    """Yield what cores make of marker frames, as `track` does."""
    for frame in frames:
        yield f"rhot/markers/{frame.camera}", frame
        for points_key, points in fusion.feed(frame):
            yield points_key, points
            hands = ik.feed(points)
            yield from hands
            for _, hand in hands:
                fusion.feed(hand)


def track_smoothly(rig: Rig, frames: Iterator[MarkerFrame]) -> Iterator[tuple[str, Message]]:
    """Yield all marker frames, then all points as the whole recording shows them, and the hands from those.

    Raises:
        ConfigError: the rig's method keeps no paths to smooth.
    """
    method = rig.config.fusion.method
    if method != "filter":
        raise ConfigError(
            f'{rig.path / "rig.toml"}: --smooth looks back at the paths of [fusion] method = "filter", '
            f'it is "{method}"; set it to "filter" or leave --smooth out'
        )
    fusion, ik = core("fusion")(rig, record=True), core("ik")(rig)
    for frame in frames:
        yield f"rhot/markers/{frame.camera}", frame
        for _, points in fusion.feed(frame):
            for _, hand in ik.feed(points):
                fusion.feed(hand)
    ik = core("ik")(rig)
    for points in fusion.smoothed():
        yield "rhot/points", points
        yield from ik.feed(points)


def rig_timing(rig: Rig) -> dict[str, TrackTiming]:
    """Return read-out and exposure of each camera as `rig.toml` states them, for recordings that do not."""
    return {
        name: TrackTiming(exposure_s=camera.exposure_s, readout_s=camera.readout_s)
        for name, camera in rig.config.cameras.items()
    }


def marker_frames(rig: Rig, recording: Recording) -> Iterator[MarkerFrame]:
    """Return the marker frames of a recording: read from its tracks, or found in its pictures."""
    if recording.holds_markers:
        return iter(marker_track_frames(rig, recording))
    frames: Iterator[MarkerFrame] = core("capture")(rig, recording)
    return frames


def _frame_count(recording: Recording) -> int:
    return sum(len(np.unique(track.frames)) for track in recording.cameras.values())


@contextlib.contextmanager
def _output(file: Path) -> Iterator[IO[str]]:
    """Write a file that appears only when it is complete; `-` is standard output."""
    if str(file) == "-":
        yield sys.stdout
        return
    try:
        with tempfile.NamedTemporaryFile(
            "w", dir=file.parent, prefix=f".{file.name}.", suffix=".part", delete=False, encoding="utf-8"
        ) as stream:
            part = Path(stream.name)
            try:
                yield stream
                stream.flush()
                part.chmod(0o644)
                part.replace(file)
            except BaseException:
                part.unlink(missing_ok=True)
                raise
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error.strerror or error}") from error


@click.command()
@click.argument("recording_path", metavar="RECORDING", type=click.Path(path_type=Path))
@click.option(
    "--out",
    "out_path",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    help="JSON Lines file to write; - for standard output.",
)
@click.option(
    "--only",
    multiple=True,
    metavar="KEY",
    help="Write only keys that begin with this, such as rhot/hand. May be repeated.",
)
@click.option(
    "--smooth",
    is_flag=True,
    help="Look back from the end: each point as all frames together show it, those after it too. The best paths, for "
    "study; a live rig cannot have them. Marker frames are written first, then points and hands.",
)
@rig_option
def process(recording_path: Path, out_path: Path, only: tuple[str, ...], smooth: bool, rig_path: Path) -> None:
    """Track a recording and write every published message as one JSON object a line.

    RECORDING is a folder that holds, per camera of the rig, pictures with timestamps.csv, a video, or marker tracks
    (markers.csv). Each line reads {"key": "rhot/hand/right", "value": {...}}, as the live rig would have published it,
    or better with --smooth.
    """
    rig = load_rig(rig_path)
    recording = load_recording(recording_path, rig_timing(rig))
    counts: Counter[str] = Counter()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("frames"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True, soft_wrap=True)
    if not rig.calibrated:
        console.print(
            f"[yellow]{rig_path} is not calibrated (no cameras.json): cameras are taken as parallel, at the places and "
            "with the field of view of rig.toml[/]"
        )
    with _output(out_path) as stream, Progress(*columns, console=console) as progress:
        task = progress.add_task("tracking", total=_frame_count(recording))
        for key, message in (track_smoothly if smooth else track)(rig, marker_frames(rig, recording)):
            counts[key] += 1
            if isinstance(message, MarkerFrame):
                progress.advance(task)
            elif smooth and isinstance(message, PointSet):
                progress.update(task, description="looking back")
            if not only or key.startswith(only):
                value = message.model_dump_json(exclude_none=True)
                stream.write(f'{{"key": {json.dumps(key)}, "value": {value}}}\n')
    for key, number in sorted(counts.items()):
        console.print(f"{key:<24} {number:>8} messages")
    if not any(key.startswith("rhot/hand/") for key in counts):
        console.print("[yellow]no hand was found: are the cameras named as in rig.toml, and colours calibrated?[/]")
