"""`rhot evaluate tracking`: the whole tracker on a simulated rig, against its truth."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Final

import click
import cv2
import numpy as np
from rich.console import Console

from rhot.cli.options import FiniteRange, rig_folder_option
from rhot.report.svg import histogram, line_plot
from rhot.rig import Rig
from rhot.rig.folder import write_text_atomic
from rhot_bench.tracking.tracking import (
    MM,
    SETTLE_S,
    Tracked,
    TrackingScene,
    run_scene,
    simulated_rig,
    tracking_sections,
)
from rhot_tools.measures.output import (
    counted,
    duration_option,
    html_report,
    json_option,
    page_option,
    quick_option,
    show,
)
from rhot_tools.measures.rows import check_output

_FAST_S: Final = 15.0
_QUICK: Final = 0.1
_LEAST_S: Final = 0.6


@click.command()
@click.option(
    "--scene",
    "chosen",
    multiple=True,
    type=click.Choice(["script", "still", "fast"]),
    help="Play only this scene. May be repeated.  [default: all three]",
)
@duration_option(1, 3600, 40.0, "Seconds of gestures and grasps; rendering takes about three times as long.")
@click.option("--speed", type=FiniteRange(1, 10), default=3.0, show_default=True, help="How much faster `fast` moves.")
@click.option(
    "--seed", type=click.IntRange(0, 2**63 - 1), default=1, show_default=True, help="Seed of the simulated world."
)
@click.option(
    "--method",
    type=click.Choice(["filter", "triangulate", "disparity"]),
    help="Fusion method.  [default: the rig's own]",
)
@quick_option("Take a tenth of the time; rougher figures.")
@json_option
@page_option("--report")
@rig_folder_option("Simulated rig, made by `rhot init RIG --sim`.  [default: a temporary one]")
def tracking(
    chosen: tuple[str, ...],
    duration_s: float,
    speed: float,
    seed: int,
    method: str | None,
    quick: bool,
    json_path: Path | None,
    page_path: Path | None,
    rig_path: Path | None,
) -> None:
    """Track simulated images and compare every point and joint with ground truth.

    The images have all imperfections of the simulated rig: lens distortion, noise, blur, rolling shutter, drifting
    light, lost frames, unsynchronised cameras and calibration errors. They are tracked by the same code that runs live
    in capture, fusion and ik.

    \b
    script  gestures and grasps: accuracy, swaps, false points, occlusions, the whole hand
    still   a hand that never moves: jitter
    fast    the script sped up: accuracy at 1.5 m/s, lag
    """
    check_output("--json", json_path)
    check_output("--report", page_path)
    share = _QUICK if quick else 1.0
    still_s = 8.0
    scenes = {
        "script": TrackingScene("script", "script", 1.0, max(duration_s * share, _LEAST_S)),
        "still": TrackingScene("still", "still", 1.0, max(still_s * share, _LEAST_S)),
        "fast": TrackingScene("fast", "script", speed, max(_FAST_S * share, _LEAST_S)),
    }
    console = Console(stderr=True, soft_wrap=True)
    cv2.setNumThreads(1)
    done: dict[str, Tracked] = {}
    with (
        counted(console) as progress,
        simulated_rig(rig_path, progress, seed) as given,
    ):
        rig = given if method is None else _with_method(given, method)
        rate_hz = sum(camera.rate_hz for camera in rig.config.cameras.values())
        used, seed = rig.config.fusion.method, rig.config.sim.seed
        for name in chosen or tuple(scenes):
            scene = scenes[name]
            task = progress.add_task(f"scene {name}", total=round((SETTLE_S + scene.seconds) * rate_hz))
            done[name] = run_scene(rig, scene, partial(progress.advance, task), look=name == "script")
    sections = tracking_sections(done)
    seconds = {name: one.scene.seconds for name, one in done.items()}
    show("evaluate tracking", sections, json_path, seed=seed, method=used, seconds=seconds)
    if page_path is not None:
        text = f"Simulated rig, seed {seed}, fusion method {used}. Truth is the centre of the painted volume."
        write_text_atomic(page_path, html_report("Tracking against truth", text, sections, _plots(done)))
        console.print(f"report: {page_path}", markup=False)


def _with_method(rig: Rig, method: str) -> Rig:
    fusion = rig.config.fusion.model_copy(update={"method": method})
    return dataclasses.replace(rig, config=rig.config.model_copy(update={"fusion": fusion}))


def _plots(done: dict[str, Tracked]) -> list[str]:
    plots = []
    for name, tracked in done.items():
        points, errors = tracked.points, tracked.points.errors_m * MM
        lines = {
            marker: (points.t_s, errors[:, column])
            for column, marker in enumerate(points.names)
            if np.isfinite(errors[:, column]).any()
        }
        plots.append(line_plot(f"Error of measured points over time, {name}", "time [s]", "error [mm]", lines))
        plots.append(histogram(f"Distribution of errors, {name}", "error [mm]", errors.ravel()))
    return plots
