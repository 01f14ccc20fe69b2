"""`rhot evaluate pictures`: photo-real pictures of a stranger's rig, from calibration to the scored hand."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import click
from rich.console import Console

from rhot.cli.options import FiniteRange
from rhot.messages import MarkerFrame, Side
from rhot.offline import track, track_smoothly
from rhot.recording import load_recording
from rhot.rig import Rig
from rhot_bench.motion.references.plain_ekf import plain_ekf
from rhot_bench.motion.references.spline_reference import spline_reference
from rhot_bench.motion.references.views import views_of
from rhot_bench.pictures.changes import CHANGES, changed_copy
from rhot_bench.pictures.rendered import (
    SEQUENCES,
    Measures,
    at_rate_of,
    found_markers,
    prepare_rig,
    require_pictures,
)
from rhot_bench.pictures.scoring import Score, score_estimates, score_messages
from rhot_tools.measures.output import counted, json_option, show
from rhot_tools.measures.rows import Row, Section, check_output


@dataclass(frozen=True, slots=True)
class Targets:
    """Targets of one sequence: most millimetres, least coverage in percent.

    Attributes:
        live_mm, smooth_mm: median and p95 after one constant offset per marker.
        raw_mm: median, nothing removed.
        joints_mm: mean.
        live_coverage, smooth_coverage: percent.
    """

    live_mm: tuple[float, float]
    smooth_mm: tuple[float, float]
    joints_mm: float
    raw_mm: float = 2.0
    live_coverage: float = 95.0
    smooth_coverage: float = 98.0


_TARGETS: Final = {
    "G1": Targets((1.4, 6.0), (1.0, 5.5), 6.0),
    "G2": Targets((2.2, 7.0), (1.6, 6.0), 9.0),
}
_TITLES: Final = {"G1": "gestures", "G2": "a grasp"}
_OFFSET: Final = "after one constant offset per marker, along its bone and along the viewing ray"


@click.command()
@click.argument("data_path", metavar="DATA", type=click.Path(path_type=Path))
@click.option(
    "--keep",
    "keep_path",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for the calibrated rig and the detected markers. A later run with the same folder uses them again and "
    "takes seconds. Delete it after changes to detection or calibration.",
)
@click.option(
    "--changed",
    "change",
    type=click.Choice(list(CHANGES)),
    help="Evaluate a changed copy of the pictures, with its own calibration: "
    + "; ".join(f"{name}: {change.about}" for name, change in CHANGES.items())
    + ".",
)
@click.option(
    "--width-mm",
    type=FiniteRange(40.0, 130.0),
    help="Width of the hand across the knuckles, measured with a ruler; DATA states only its length.  [default: 74 for "
    "a hand of 172, and in proportion]",
)
@click.option("--left", "is_left", is_flag=True, help="The pictures show a left hand.")
@json_option
def pictures(
    data_path: Path,
    keep_path: Path | None,
    change: str | None,
    width_mm: float | None,
    is_left: bool,
    json_path: Path | None,
) -> None:
    """Track photo-real pictures of another rig and hand, and compare with their ground truth.

    DATA is the folder of the rendered pictures, or its parent. Cameras and colours are calibrated with `rhot calibrate`
    from its chessboards and colour reference, the hand by two ruler measurements. Two references run on the same
    detections for comparison: a plain Kalman filter per marker (causal) and a cubic spline per camera and marker
    (offline). The errors are computed by the scorer in DATA.
    """
    check_output("--json", json_path)
    data = require_pictures(data_path)
    with ExitStack() as stack:
        keep = keep_path or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rhot-pictures-")))
        keep.mkdir(parents=True, exist_ok=True)
        progress = stack.enter_context(counted(Console(stderr=True, soft_wrap=True)))
        if change is not None:
            keep = keep / change
            task = progress.add_task("changing the pictures", total=len(list(data.glob("*/*/*.jpg"))))
            data = changed_copy(data, change, keep / "pictures", partial(progress.advance, task))
        mirrored = change is not None and CHANGES[change].mirrored
        side: Side = "left" if is_left != mirrored else "right"
        width_m = None if width_mm is None else 1e-3 * width_mm
        measures = Measures.of(data, width_m=width_m, side=side)
        task = progress.add_task("calibrating the rig", total=None)
        rig = prepare_rig(data, keep / "rig", measures)
        progress.remove_task(task)
        sections = []
        for name in SEQUENCES:
            recording = load_recording(data / name)
            total = sum(len(track.t_ns) for track in recording.cameras.values())
            task = progress.add_task(f"finding markers, {name}", total=total)
            frames = found_markers(rig, data, name, keep, partial(progress.advance, task))
            task = progress.add_task(f"tracking, {name}", total=4)
            timed = at_rate_of(rig, recording)
            scores = score_sequence(data, name, timed, frames, partial(progress.advance, task))
            rate_hz = next(iter(timed.config.cameras.values())).rate_hz
            title = f"{name}, {_TITLES[name]} at {rate_hz:.0f} fps{'' if change is None else f', {change}'}"
            sections.append(Section(title, _rows(_TARGETS[name], scores)))
    show("evaluate pictures", sections, json_path)


def score_sequence(
    data: Path, name: str, rig: Rig, frames: list[MarkerFrame], advance: Callable[[], None] = lambda: None
) -> dict[str, Score]:
    """Return the scores of one sequence: `live`, `smooth`, and the references `ekf` and `spline`.

    Args:
        data: the rendered pictures.
        name: of the sequence.
        rig: calibrated, at the sequence's rate.
        frames: markers found in its pictures.
        advance: called after each of the four.
    """
    names = list(rig.config.markers)
    views = views_of(frames, rig)
    steps: dict[str, Callable[[], Score]] = {
        "live": lambda: score_messages(data, name, track(rig, iter(frames))),
        "smooth": lambda: score_messages(data, name, track_smoothly(rig, iter(frames))),
        "ekf": lambda: score_estimates(data, name, plain_ekf(views, len(frames), len(names)), names),
        "spline": lambda: score_estimates(data, name, spline_reference(views, len(names)), names),
    }
    scores = {}
    for step, make in steps.items():
        scores[step] = make()
        advance()
    return scores


def _rows(targets: Targets, scores: dict[str, Score]) -> tuple[Row, ...]:
    rows: list[Row] = []
    for step, limit, coverage in (
        ("live", targets.live_mm, targets.live_coverage),
        ("smooth", targets.smooth_mm, targets.smooth_coverage),
    ):
        score, beside = scores[step], scores["ekf" if step == "live" else "spline"]
        other = "plain EKF" if step == "live" else "spline"

        def peer(value: float, unit: str = "mm", other: str = other) -> str:
            return f"{other}: {value:.2f} {unit}"

        rows += [
            Row(f"{step}, median", score.median_mm, "mm", most=limit[0], peer=peer(beside.median_mm), note=_OFFSET),
            Row(f"{step}, p95", score.p95_mm, "mm", most=limit[1], peer=peer(beside.p95_mm), note=_OFFSET),
            Row(
                f"{step}, nothing removed, median",
                score.raw_median_mm,
                "mm",
                most=targets.raw_mm,
                peer=peer(beside.raw_median_mm),
            ),
            Row(f"{step}, nothing removed, p95", score.raw_p95_mm, "mm", peer=peer(beside.raw_p95_mm)),
            Row(f"{step}, joints, mean", score.joints_mm, "mm", most=targets.joints_mm),
            Row(f"{step}, coverage", score.coverage, "%", least=coverage, peer=peer(beside.coverage, "%")),
            Row(f"{step}, wrong identity", score.swaps, most=0),
            Row(f"{step}, hallucinations", score.hallucinations, most=0),
            Row(f"{step}, told as measured with one view, median", score.one_view_median_mm, "mm"),
            Row(f"{step}, told as measured with one view, p95", score.one_view_p95_mm, "mm"),
        ]
    return tuple(rows)
