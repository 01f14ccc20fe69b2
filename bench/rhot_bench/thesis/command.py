"""`rhot evaluate thesis`: the 2018 thesis's tables with our figures beside them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Final

import click
import cv2
import numpy as np
from rich.console import Console

from rhot.arrays import FloatArray
from rhot.atomic_file import why_unread
from rhot.cli.options import rig_folder_option
from rhot.errors import ConfigError
from rhot.messages import PointSet
from rhot.offline import track
from rhot.rig import Rig
from rhot_bench.hands.accuracy import START_NS
from rhot_bench.processes import read_table
from rhot_bench.speed.cores import MILLI, SpeedScene, capture_section
from rhot_bench.speed.simulated import Cameras, Capture, moments
from rhot_bench.thesis.capture import ThesisDetector
from rhot_bench.thesis.hand import law_depth_m
from rhot_bench.thesis.paint_samples import thesis_boxes
from rhot_bench.tracking.tracking import RATE_HZ, scene_frames, simulated_rig
from rhot_sim.world.motion import MotionSample, StillMotion
from rhot_sim.world.world import World
from rhot_tools.measures.output import counted, json_option, quick_option, show
from rhot_tools.measures.points import point_track
from rhot_tools.measures.rows import Row, Section, check_output

# The 2018 thesis's own tables, and our figures for the same questions.
#
# What the thesis measured is real; ours are of the simulated rig, whose truth is known.

Advance = Callable[[], None]

DISTANCES_CM: Final = (*range(20, 101, 5),)
THESIS_FRAME: Final = "thesis on a Pi 3: 17–19 ms, 31 ms more with rectification"
_PROBE: Final = "index"
_SETTLE_S: Final = 0.2
_LAW_CORRECTED: Final = "thesis: 1–3 % after correction, up to 5 % before"


def timing_section(scene: SpeedScene) -> Section:
    """Return the thesis's table of stage times beside ours, both on this machine."""
    _, spreads = capture_section(scene)
    ours, theirs = spreads["ours tracked"].median, spreads["thesis tracked"].median
    rows = (
        Row("finding six tracked markers, ours, median", ours * MILLI, "ms", peer=THESIS_FRAME),
        Row("finding six tracked markers, thesis's algorithm, median", theirs * MILLI, "ms", note="on this machine"),
        Row("ours / thesis", ours / theirs, "×", most=1.0),
        Row("six markers searched, ours, median", spreads["ours searched"].median * MILLI, "ms"),
        Row(
            "six markers searched, thesis's algorithm, median",
            spreads["thesis searched"].median * MILLI,
            "ms",
            note="on this machine",
        ),
    )
    return Section("Time of a frame", rows)


def jitter_section(rig: Rig, pictures: int, data: Path | None, advance: Advance) -> Section:
    """Return the jitter of a still hand in the picture, pixels: the thesis's recordings, its algorithm, and ours.

    Args:
        rig: simulated.
        pictures: of one camera.
        data: folder of the thesis's recordings; None = leave them out.
        advance: called after each picture.
    """
    still = _with_motion(rig, "still")
    world = World.from_rig(still)
    cameras, capture = Cameras(still, world), Capture(still)
    first = next(iter(rig.config.cameras))
    images = []
    for moment in moments(still, 0.0, (pictures + 2) / still.config.cameras[first].rate_hz):
        if moment.camera == first:
            images.append(cameras.picture(moment))
            advance()
    thesis = ThesisDetector(thesis_boxes(still, images))
    ours = [{n: (d.u, d.v) for n, d in capture.detectors[first].detect(image).items()} for image in images]
    theirs = [thesis.detect(image) for image in images]
    rows = []
    for text, found in (("ours", ours), ("thesis's algorithm", theirs)):
        spread = _jitter_px(found, list(rig.config.markers))
        note = f"simulated rig, {len(images)} pictures"
        rows.append(Row(f"{text}, standard deviation, middle marker", _middle(spread[0]), "px", note=note))
        rows.append(Row(f"{text}, standard deviation, worst marker", _worst(spread[0]), "px", note=note))
        rows.append(Row(f"{text}, from least to most, worst marker", _worst(spread[1]), "px", note=note))
    for name in ("static_jitter_unrectified.csv", "static_jitter_rectified.csv"):
        places = None if data is None else _real_places(data / name)
        kind = name.removeprefix("static_jitter_").removesuffix(".csv")
        note = "real, 10,000 frames of one camera" if places is not None else "no DATA given"
        deviation = _worst(places.std(axis=0)) if places is not None else float("nan")
        span = _worst(np.ptp(places, axis=0)) if places is not None else float("nan")
        rows.append(Row(f"thesis's recording, {kind}, standard deviation, worst marker", deviation, "px", note=note))
        rows.append(Row(f"thesis's recording, {kind}, from least to most, worst marker", span, "px", note=note))
    return Section("Jitter of a still hand in the picture (the thesis says 2–5 px)", tuple(rows))


def depth_section(rig: Rig, seconds: float, data: Path | None, advance: Advance) -> Section:
    """Return depth accuracy at the thesis's 17 distances: its law on its own measurements, ours on the simulated rig.

    Args:
        rig: simulated.
        seconds: watched at each distance, after the filters have settled.
        data: folder of the thesis's table; None = leave it out.
        advance: called after each distance.
    """
    table = None if data is None else read_table(data / "depth_table.csv")
    rows = []
    errors: list[float] = []
    for distance_cm in DISTANCES_CM:
        depths = probe_depths(rig, distance_cm / 100.0, seconds)
        bias = float(np.median(depths)) if depths.size else float("nan")
        errors.append(abs(bias) / distance_cm * 1e4)
        peer = "" if table is None else _law_text(table, distance_cm)
        noise = f"spread {depths.std() * 1e3:.2f} mm" if depths.size else "not tracked"
        rows.append(Row(f"{distance_cm} cm, {noise}, error", bias * 1e3, "mm", peer=peer))
        advance()
    known = np.array(errors)[np.isfinite(errors)]
    mean, worst = (float(known.mean()), float(known.max())) if known.size else (float("nan"), float("nan"))
    rows += [
        Row(
            "all distances, mean error",
            mean,
            "%",
            peer=_LAW_CORRECTED,
            note="the law above is judged on the very 17 distances that it was fitted to; ours was fitted to none",
        ),
        Row("all distances, largest error", worst, "%"),
        Row("distances at which the marker is tracked", known.size, note=f"of {len(DISTANCES_CM)}"),
    ]
    return Section("Depth of a marker, ours (simulated) beside the thesis's law (real)", tuple(rows))


class _Shifted:
    """The still hand, moved by a vector (3,), metres."""

    def __init__(self, still: StillMotion, shift_m: FloatArray) -> None:
        self._still = still
        self._shift_m = shift_m

    def sample(self, t_s: FloatArray) -> MotionSample:
        sample = self._still.sample(t_s)
        wrists = {side: T.copy() for side, T in sample.wrists.items()}
        for T in wrists.values():
            T[:, :3, 3] += self._shift_m
        return dataclasses.replace(sample, wrists=wrists)


def probe_depths(rig: Rig, distance_m: float, seconds: float) -> FloatArray:
    """Return the errors in depth (N,), metres, of a marker that lies between two cameras at a distance.

    The hand is moved so that the marker's true centre lies on the middle line of the first two cameras.
    """
    still = _with_motion(rig, "still")
    fusion = still.config.fusion
    low, high = fusion.volume_m
    sight_margin_m = 0.1
    volume = ((low[0], low[1], min(low[2], distance_m - sight_margin_m)), high)
    config = still.config.model_copy(update={"fusion": fusion.model_copy(update={"volume_m": volume})})
    still = dataclasses.replace(still, config=config)
    world = World.from_rig(still)
    middle_x = 0.5 * float(list(still.cameras.values())[1].T_rig_camera[0][3])
    here = world.sample(np.zeros(1)).markers[_PROBE][0]
    motion = StillMotion(still.config.sides, list(world.objects), still.config.sim.desk_z_m)
    world.motion = _Shifted(motion, np.array([middle_x, 0.0, distance_m]) - here)
    frames = scene_frames(still, world, _SETTLE_S + seconds, lambda: None)
    sets = [message for _, message in track(still, frames) if isinstance(message, PointSet)]
    points = point_track(sets, world, START_NS).after(_SETTLE_S)
    column = points.names.index(_PROBE)
    rows = points.measured[:, column]
    depths: FloatArray = points.positions[rows, column, 2] - points.true[rows, column, 2]
    return depths


def _law_text(table: dict[str, FloatArray], distance_cm: int) -> str:
    """Return what the thesis's law makes of its own measurement at a distance."""
    row = np.flatnonzero(table["distance_cm"] == distance_cm)
    if not row.size:
        return ""
    off_m = law_depth_m(float(table["disparity_px"][row[0]])) - distance_cm / 100.0
    return f"thesis's law: {off_m * 1e3:+.1f} mm, {off_m * 1e4 / distance_cm:+.1f} %"


def _with_motion(rig: Rig, motion: str) -> Rig:
    sim = rig.config.sim.model_copy(update={"motion": motion})
    return dataclasses.replace(rig, config=rig.config.model_copy(update={"sim": sim}))


def _jitter_px(found: list[dict[str, tuple[float, float]]], names: list[str]) -> tuple[FloatArray, FloatArray]:
    """Return per marker the standard deviation and the span, the worse of u and v, pixels."""
    places = np.array([[one.get(name, (np.nan, np.nan)) for name in names] for one in found])
    seen = [k for k in range(len(names)) if np.isfinite(places[:, k]).all(axis=1).sum() > 1]
    deviation = [float(np.nanstd(places[:, k], axis=0).max()) for k in seen]
    span = [float((np.nanmax(places[:, k], axis=0) - np.nanmin(places[:, k], axis=0)).max()) for k in seen]
    return np.array(deviation), np.array(span)


def _real_places(file: Path) -> FloatArray:
    """Return the thesis's pixels (N, 12) without the first row, which is start-up.

    Raises:
        ConfigError: it cannot be read or is no table of numbers.
    """
    try:
        return np.loadtxt(file, delimiter=",", dtype=np.float64, ndmin=2)[1:]
    except OSError as error:
        raise ConfigError(
            f"{file}: cannot be read: {why_unread(error)}; is DATA the folder of the thesis's rig?"
        ) from error
    except ValueError as error:
        raise ConfigError(f"{file}: is not a table of numbers: {error}") from error


def _middle(values: FloatArray) -> float:
    return float(np.median(values)) if values.size else float("nan")


def _worst(values: FloatArray) -> float:
    return float(values.max()) if values.size else float("nan")


_TABLE: Final = "depth_table.csv"


@click.command()
@click.argument("data_path", metavar="[DATA]", type=click.Path(path_type=Path), required=False)
@quick_option("Use fewer pictures; rougher figures.")
@json_option
@rig_folder_option("Simulated rig, made by `rhot init RIG --sim`.  [default: a temporary one]")
def thesis(data_path: Path | None, quick: bool, json_path: Path | None, rig_path: Path | None) -> None:
    """Answer the 2018 thesis's questions: time per frame, jitter of a still hand, depth at 17 distances.

    Our algorithm and the thesis's, re-implemented, run on the same pictures of the simulated rig. DATA is the folder
    with what the thesis measured on its real rig (depth_table.csv, static_jitter_*.csv). Without it, those figures are
    left out.
    """
    check_output("--json", json_path)
    if data_path is not None and not (data_path / _TABLE).exists():
        data_path = data_path / "thesis_rig"
    if data_path is not None and not (data_path / _TABLE).exists():
        raise ConfigError(
            f"{data_path.parent}: holds no {_TABLE}; name the folder of the thesis's rig, or leave it out"
        )
    pictures, seconds = (20, 0.15) if quick else (240, 0.5)
    span_s = 0.3 if quick else 3.0
    cv2.setNumThreads(1)
    with (
        counted(Console(stderr=True)) as progress,
        simulated_rig(rig_path, progress) as rig,
    ):
        rendering = progress.add_task("time of a frame", total=round(2 * span_s * RATE_HZ))
        scene = SpeedScene(rig, span_s, lambda: progress.advance(rendering))
        sections = [timing_section(scene)]
        still = progress.add_task("still hand", total=pictures)
        sections.append(jitter_section(rig, pictures, data_path, lambda: progress.advance(still)))
        depth = progress.add_task("distances", total=len(DISTANCES_CM))
        sections.append(depth_section(rig, seconds, data_path, lambda: progress.advance(depth)))
    show("evaluate thesis", sections, json_path, quick=quick)
