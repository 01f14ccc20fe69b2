"""`rhot evaluate thesis`: the 2018 thesis's tables with our figures beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import click
import cv2
from rich.console import Console

from rhot.errors import ConfigError
from rhot_bench.speed.cores import Scene
from rhot_bench.thesis.tables import DISTANCES_CM, depth_section, jitter_section, timing_section
from rhot_bench.tracking.simulated_rig import RATE_HZ, simulated_rig
from rhot_tools.measures.output import counted, json_option, show
from rhot_tools.measures.rows import check_output

_TABLE: Final = "depth_table.csv"


@click.command()
@click.argument("data_path", metavar="[DATA]", type=click.Path(path_type=Path), required=False)
@click.option("--quick", is_flag=True, help="Use fewer pictures; rougher figures.")
@json_option
@click.option(
    "--rig",
    "rig_path",
    type=click.Path(path_type=Path, file_okay=False),
    help="Simulated rig, made by `rhot init RIG --sim`.  [default: a temporary one]",
)
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
        scene = Scene(rig, span_s, lambda: progress.advance(rendering))
        sections = [timing_section(scene)]
        still = progress.add_task("still hand", total=pictures)
        sections.append(jitter_section(rig, pictures, data_path, lambda: progress.advance(still)))
        depth = progress.add_task("distances", total=len(DISTANCES_CM))
        sections.append(depth_section(rig, seconds, data_path, lambda: progress.advance(depth)))
    show("evaluate thesis", sections, json_path, quick=quick)
