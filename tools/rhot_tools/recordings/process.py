"""`rhot process`: the whole tracker over recordings, with the very cores that run live."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from rhot.atomic_file import replacing
from rhot.cli.group import end_orderly_on_sigterm
from rhot.cli.options import DEFAULT_RIG, jobs_option, rig_folder_option
from rhot.errors import ConfigError, RhotError
from rhot.messages import FootPose, MarkerFrame, Message, PointSet, encode, encoding_of
from rhot.recording.attached import file_beside
from rhot.recording.mcap.writer import McapWriter, attachments_of
from rhot.rig import Rig
from rhot.rig.folder import RIG_FILE, settings_files
from rhot.take.tracking import Retracked, open_recorded
from rhot_tools.trial.verdict import TrialJudge, TrialVerdict

Write = Callable[[str, Message], None]


@dataclass(frozen=True, slots=True)
class Job:
    """One recording to track.

    Attributes:
        recording: its folder or file.
        out: file to write; `-` is standard output.
        rig: rig folder; None = the rig that the recording carries.
        only: beginnings of the keys to write; empty = all.
        smooth: whether later frames are used, too.
    """

    recording: Path
    out: Path
    rig: Path | None
    only: tuple[str, ...]
    smooth: bool


@dataclass(frozen=True, slots=True)
class Done:
    """What came of it: warnings, messages by key, and whether the trial can be used."""

    remarks: list[str]
    counts: Counter[str]
    verdict: TrialVerdict


def run(job: Job, progress: Progress | None = None) -> Done:
    """Track one recording and write the result.

    Raises:
        RhotError: it cannot be tracked or written.
    """
    with contextlib.ExitStack() as stack:
        recorded = open_recorded(job.recording, job.rig, stack)
        rig, remarks = recorded.rig, []
        if rig.config.cameras and not rig.calibrated:
            remarks.append(
                f"{rig.path} is not calibrated (no cameras.json): cameras are taken as parallel, at the positions and "
                "with the field of view of rig.toml"
            )
        if recorded.beside:
            remarks.append(f"with the objects of {', '.join(map(str, recorded.beside))}")
        tracker = recorded.tracker(smooth=job.smooth)
        judge, counts = TrialJudge(rig), Counter[str]()
        write = stack.enter_context(_output(job.out, rig))
        task = (
            None
            if progress is None
            else progress.add_task(f"tracking {file_beside(job.recording, '').name}, frames", total=recorded.count)
        )
        for key, message in recorded.passed_on:
            if not job.only or key.startswith(job.only):
                write(key, message)
        looked_at = 0
        for key, message in tracker.run(recorded.frames):
            counts[key] += 1
            judge.add(message)
            if not job.only or key.startswith(job.only):
                write(key, message)
            if progress is not None and task is not None:
                looked_at = _advance(progress, task, recorded, message, looked_at, smooth=job.smooth)
        if recorded.feet is not None and not any(key.startswith("rhot/foot/") for key in counts):
            remarks.append("no foot was found: are the markers those of rig.toml, and was the head tracked meanwhile?")
        return Done(remarks, counts, judge.verdict(tracker.problems, recorded.lost))


def _advance(
    progress: Progress, task: TaskID, recorded: Retracked, message: Message, looked_at: int, *, smooth: bool
) -> int:
    """Show the progress; return how many pictures of feet were looked at."""
    feet = recorded.feet
    if isinstance(message, MarkerFrame):
        progress.advance(task)
    elif feet is not None and isinstance(message, FootPose) and feet.frames_done > looked_at:
        progress.advance(task, feet.frames_done - looked_at)
        return feet.frames_done
    elif smooth and isinstance(message, PointSet):
        progress.update(task, description=f"looking back, {recorded.rig.config.name}")
    return looked_at


@contextlib.contextmanager
def _output(file: Path, rig: Rig) -> Iterator[Write]:
    """Write a file that appears only when it is complete: MCAP or JSON Lines by its name; `-` is standard output."""
    if str(file) == "-":
        yield _lines_to(sys.stdout)
        return
    with replacing(file) as part:
        if file.suffix != ".mcap":
            with part.open("w", encoding="utf-8") as stream:
                yield _lines_to(stream)
            return
        part.unlink(missing_ok=True)
        about = {"program": "rhot process"}
        with McapWriter(part, now_ns=0, attachments=attachments_of(settings_files(rig.path)), about=about) as mcap:

            def write(key: str, message: Message) -> None:
                mcap.write(
                    key, encoding_of(type(message)), encode(message), message.t_ns, message.seq, log_ns=message.t_ns
                )

            yield write


def _lines_to(stream: IO[str]) -> Write:
    def write(key: str, message: Message) -> None:
        value = message.model_dump_json(exclude_none=True)
        stream.write(f'{{"key": {json.dumps(key)}, "value": {value}}}\n')

    return write


@click.command()
@click.argument("recordings", metavar="RECORDING...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out",
    "out_path",
    type=click.Path(path_type=Path),
    required=True,
    help="File to write: MCAP if its name ends in .mcap, else JSON Lines; - for standard output. Of several "
    "recordings, a folder: each becomes an MCAP file of its name there.",
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
@jobs_option("Track this many recordings at once, each on a core of its own.")
@rig_folder_option(
    "Rig folder.  [default: the rig that a recording carries, else rig]", envvar="RHOT_RIG", show_envvar=True
)
def process(
    recordings: tuple[Path, ...],
    out_path: Path,
    only: tuple[str, ...],
    smooth: bool,
    jobs: int,
    rig_path: Path | None,
) -> int:
    """Track recordings again and write every message that would be published.

    RECORDING is an MCAP file of `rhot record` or JSON Lines, whose marker frames and objects are tracked again. Or it
    is a folder that holds, per camera of the rig, pictures with timestamps.csv, a video, or marker tracks
    (markers.csv), and, for feet, what `rhot record --frames` wrote of the depth camera, the ankle sensors and the head;
    objects and head come from the MCAP file beside the pictures, where there is one.

    A line of JSON Lines reads {"key": "rhot/hand/right", "value": {...}}, as the live rig would have published it.

    \b
    rhot process grasp.mcap --smooth --out grasp.smooth.mcap
    rhot process take/ --rig myrig --out take.jsonl
    rhot process trials/*.mcap --smooth --jobs 4 --out smooth/

    At the end it says whether the trial can be used, and why not. The exit code is 1 if one cannot.
    """
    wrong = [key for key in only if not key.startswith("rhot/")]
    if wrong:
        raise ConfigError(f"--only {wrong[0]}: keys begin with rhot/, such as rhot/hand")
    several = len(recordings) > 1
    is_file = out_path.is_file() or (out_path.suffix in (".mcap", ".jsonl") and not out_path.is_dir())
    if several and (is_file or str(out_path) == "-"):
        raise ConfigError(f"--out {out_path}: several recordings need a folder")
    if not several and out_path.is_dir():
        several = True
    todo = [
        Job(each, _target(out_path, each) if several else out_path, rig_path or _default_rig(each), only, smooth)
        for each in recordings
    ]
    _refuse_clashes(todo)
    if several:
        out_path.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True, soft_wrap=True)
    return _run_all(todo, jobs, console)


def _target(folder: Path, recording: Path) -> Path:
    return folder / (f"{recording.stem}.mcap" if recording.is_file() else file_beside(recording, ".mcap").name)


def _default_rig(recording: Path) -> Path | None:
    """Return the rig folder that is meant where none is named: a recording carries its own, pictures do not."""
    beside = file_beside(recording, ".mcap")
    if recording.suffix == ".mcap" or (
        recording.is_dir() and beside.is_file() and not (DEFAULT_RIG / RIG_FILE).exists()
    ):
        return None
    return DEFAULT_RIG


def _refuse_clashes(todo: Sequence[Job]) -> None:
    outs = Counter(job.out for job in todo)
    twice = [out for out, number in outs.items() if number > 1]
    if twice:
        raise ConfigError(f"{twice[0]} would be written twice: two recordings have one name; track them one by one")
    for job in todo:
        if str(job.out) != "-" and job.out.resolve() == job.recording.resolve():
            raise ConfigError(f"--out {job.out} is the recording itself; choose another name")


def _run_all(todo: Sequence[Job], jobs: int, console: Console) -> int:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    several, worst = len(todo) > 1, 0
    if jobs == 1 or not several:
        for job in todo:
            with Progress(*columns, console=console, transient=several) as bar:
                done = run(job, bar)
            worst = max(worst, _tell(job, done, console, name=several))
        return worst
    # Not forked: this process has threads.
    spawn = multiprocessing.get_context("spawn")
    with (
        tempfile.TemporaryDirectory(prefix="rhot-process-", ignore_cleanup_errors=True) as folder,
        ProcessPoolExecutor(min(jobs, len(todo)), spawn, _begin_worker, (folder,)) as pool,
        Progress(*columns, console=console) as bar,
    ):
        task = bar.add_task("tracking recordings", total=len(todo))
        try:
            futures = {pool.submit(_run_in_worker, job): job for job in todo}
            for future in as_completed(futures):
                job = futures[future]
                try:
                    done = future.result()
                except RhotError as error:
                    console.print(f"{job.recording}: {error}", style="red", markup=False)
                    worst = max(worst, 1)
                else:
                    worst = max(worst, _tell(job, done, console, name=True))
                bar.advance(task)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            _end_workers()
            raise
    return worst


def _begin_worker(folder: str) -> None:
    """Leave Ctrl-C to the process that waits for the results; what is temporary goes into a folder of that one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_orderly_on_sigterm()
    tempfile.tempdir = folder


def _run_in_worker(job: Job) -> Done:
    try:
        return run(job)
    except SystemExit as error:
        # A pool would go on with the next recording.
        os._exit(error.code if isinstance(error.code, int) else 1)


def _end_workers() -> None:
    """End the workers: orderly, so that no half-written file stays, but within a second."""
    workers = multiprocessing.active_children()
    for worker in workers:
        worker.terminate()
    until_s = time.monotonic() + 1.0
    for worker in workers:
        worker.join(max(until_s - time.monotonic(), 0.0))
        # Python drops an exception that a signal raises in the wrong place, such as a finalizer.
        worker.kill()


def _tell(job: Job, done: Done, console: Console, *, name: bool) -> int:
    """Say what came of a recording, and return its exit code."""
    if name:
        console.print(f"{job.recording} → {job.out}", markup=False)
    for remark in done.remarks:
        console.print(remark, style="" if remark.startswith("with the objects") else "yellow", markup=False)
    for key, number in sorted(done.counts.items()):
        console.print(f"{key:<24} {number:>8} messages", markup=False)
    done.verdict.print(console)
    return done.verdict.exit_code
