"""`rhot process`: the whole tracker over a recording, with the very cores that run live."""

from __future__ import annotations

import contextlib
import json
import sys
from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import IO

import click
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rhot.atomic_file import replacing
from rhot.cli.options import rig_option
from rhot.errors import ConfigError
from rhot.messages import FootPose, MarkerFrame, PointSet
from rhot.offline import MessagesBeside, OfflineTracker, feet_of, marker_frames, rig_timing
from rhot.recording import Recording, load_recording
from rhot.rig import load_rig
from rhot_tools.export.source import RecordedMessages
from rhot_tools.recordings.beside import messages_beside
from rhot_tools.trial.verdict import TrialJudge


def _frame_count(recording: Recording) -> int:
    return sum(len(np.unique(track.frames)) for track in recording.cameras.values())


@contextlib.contextmanager
def _output(file: Path) -> Iterator[IO[str]]:
    """Write a file that appears only when it is complete; `-` is standard output."""
    if str(file) == "-":
        yield sys.stdout
        return
    with replacing(file) as part, part.open("w", encoding="utf-8") as stream:
        yield stream


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
    help="Also use later frames, for the most accurate paths; a live rig cannot do that. Marker frames are "
    "written first, then points and hands.",
)
@rig_option
def process(recording_path: Path, out_path: Path, only: tuple[str, ...], smooth: bool, rig_path: Path) -> int:
    """Track a recording and write every message that would be published, one JSON object per line.

    RECORDING is a folder that holds, per camera of the rig, pictures with timestamps.csv, a video, or marker tracks
    (markers.csv), and, for feet, what `rhot record --frames` wrote of the depth camera, the ankle sensors and the head.
    Each line reads {"key": "rhot/hand/right", "value": {...}}, as the live rig would have published it. Objects and
    head come from the MCAP file beside the pictures, where there is one.

    At the end it says whether the trial can be used, and why not. The exit code is 1 if it cannot.
    """
    wrong = [key for key in only if not key.startswith("rhot/")]
    if wrong:
        raise ConfigError(f"--only {wrong[0]}: keys begin with rhot/, such as rhot/hand")
    rig = load_rig(rig_path)
    recording = load_recording(recording_path, rig_timing(rig))
    counts: Counter[str] = Counter()
    looked_at = 0
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("frames"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True, soft_wrap=True)
    feet = feet_of(rig, recording)
    if recording.cameras and not rig.calibrated:
        console.print(
            f"[yellow]{escape(str(rig_path))} is not calibrated (no cameras.json): cameras are taken as parallel, at "
            "the positions and with the field of view of rig.toml[/]"
        )
    objects = _objects_beside(recording, console)
    tracker = OfflineTracker(rig, feet, objects, smooth=smooth)
    judge = TrialJudge(rig)
    with _output(out_path) as stream, Progress(*columns, console=console) as progress:
        pictures = 0 if feet is None else feet.frame_count
        task = progress.add_task("tracking", total=_frame_count(recording) + pictures)
        for key, message in tracker.run(marker_frames(rig, recording)):
            counts[key] += 1
            judge.add(message)
            if isinstance(message, MarkerFrame):
                progress.advance(task)
            elif feet is not None and isinstance(message, FootPose) and feet.frames_done > looked_at:
                progress.advance(task, feet.frames_done - looked_at)
                looked_at = feet.frames_done
            elif smooth and isinstance(message, PointSet):
                progress.update(task, description="looking back")
            if not only or key.startswith(only):
                value = message.model_dump_json(exclude_none=True)
                stream.write(f'{{"key": {json.dumps(key)}, "value": {value}}}\n')
    for key, number in sorted(counts.items()):
        console.print(f"{key:<24} {number:>8} messages")
    if feet is not None and not any(key.startswith("rhot/foot/") for key in counts):
        console.print(
            "[yellow]no foot was found: are the markers those of rig.toml, and was the head tracked meanwhile?[/]"
        )
    verdict = judge.verdict(tracker.problems)
    verdict.print(console)
    return verdict.exit_code


def _objects_beside(recording: Recording, console: Console) -> MessagesBeside | None:
    """Return the objects and the head that `rhot record --frames` wrote beside the pictures, None without any."""
    files = messages_beside(recording.path)
    objects = MessagesBeside(chain.from_iterable(RecordedMessages(file) for file in files))
    if not objects:
        return None
    console.print(f"with the objects of {escape(', '.join(str(file) for file in files))}")
    return objects
