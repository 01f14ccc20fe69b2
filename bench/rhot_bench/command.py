"""`rhot bench`: how fast each part is, beside what the 2018 thesis did, on this machine and in one run."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import click
import cv2
from rich.console import Console
from rich.progress import Progress

from rhot.cli.options import FiniteRange, rig_folder_option
from rhot.rig import Rig
from rhot_bench.speed.bridges import bridges_section
from rhot_bench.speed.cores import SpeedScene, capture_section, fusion_section, ik_section, pipeline_section
from rhot_bench.speed.live import live_section
from rhot_bench.speed.pages import pages_section
from rhot_bench.speed.pi_budget import budget_section
from rhot_bench.speed.process_costs import processes_section
from rhot_bench.speed.scaling import scaling_section, scaling_steps, secured_section
from rhot_bench.speed.soak import soak_section
from rhot_bench.tracking.tracking import RATE_HZ, simulated_rig
from rhot_tools.measures.output import json_option, quick_option, show
from rhot_tools.measures.rows import Section, check_output

_CORES: Final = ("capture", "fusion", "ik", "pipeline", "scaling", "budget")
PARTS: Final = (*_CORES, "live", "processes", "tls", "bridge")
NAMED_PARTS: Final = ("page", "soak")
"""Measured only where they are asked for by name: one needs a browser, one hours."""


@click.command()
@quick_option("Repeat less often: half the time, rougher figures.")
@click.option(
    "--part",
    "parts",
    multiple=True,
    type=click.Choice((*PARTS, *NAMED_PARTS)),
    help="Measure only this part. May be repeated.  [default: all but page and soak]",
)
@click.option(
    "--hours",
    type=FiniteRange(min=0.0, min_open=True, max=1000.0),
    default=2.0,
    show_default=True,
    help="How long the soak runs. Ctrl-C ends it sooner, with the figures so far.",
)
@json_option
@rig_folder_option("Simulated rig to measure on, made by `rhot init RIG --sim`.  [default: a temporary one]")
def bench(quick: bool, parts: tuple[str, ...], hours: float, json_path: Path | None, rig_path: Path | None) -> None:
    """Measure how fast each part is on this machine, and compare with the 2018 thesis.

    The thesis's algorithms are re-implemented here. They alternate with ours on the same images, so the ratios are
    valid on a busy machine too. The images come from the simulated rig: 640x480, with all its imperfections. OpenCV
    uses one thread.

    \b
    capture    a frame with all markers tracked, and with all searched
    fusion     one camera's markers into points
    ik         five fingers; a whole hand
    pipeline   picture in memory to encoded pose, in one process
    scaling    how the cost grows with markers, cameras, hands and frame rate
    budget     what capture would cost on Pis: an estimate from counted instructions
    live       latency of the whole system, as processes on the bus
    processes  start-up time and memory of each service
    tls        what a secured bus costs: latency with and without certificates
    bridge     four other programs at once: latency from the bus to the packet, rate, processor time
    page       two windows with the page Grasp: pose on the bus to its picture, and what they cost the tracker
    soak       hours of the running rig: memory, descriptors, threads, latency and losses, each minute

    Run nothing else on the machine meanwhile. This takes about two minutes, or one with --quick.
    """
    check_output("--json", json_path)
    chosen = parts or PARTS
    console = Console(stderr=True, soft_wrap=True)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    sections: list[Section] = []
    try:
        if set(chosen) - {"soak"}:
            with Progress(console=console, transient=True) as progress, simulated_rig(rig_path, progress) as rig:
                sections = _measure(rig, chosen, quick, progress)
    finally:
        cv2.setNumThreads(threads)
    if "soak" in chosen:
        # By itself, after all else: what it measures needs hours and nothing that the others make.
        sections.append(soak_section(hours, json_path, console.print))
    show("bench", sections, json_path, quick=quick)


def _measure(rig: Rig, parts: tuple[str, ...], quick: bool, progress: Progress) -> list[Section]:
    seconds = 0.6 if quick else 6.0
    sections: list[Section] = []
    if set(parts) & set(_CORES):
        pictures = progress.add_task("rendering", total=2 * seconds * RATE_HZ)
        scene = SpeedScene(rig, seconds, lambda: progress.advance(pictures))
        work = progress.add_task("measuring the cores", total=4 + scaling_steps())
        if "capture" in parts:
            sections.append(capture_section(scene)[0])
        progress.advance(work)
        for part, make in (("fusion", fusion_section), ("ik", ik_section), ("pipeline", pipeline_section)):
            if part in parts:
                sections.append(make(scene)[0])
            progress.advance(work)
        if "scaling" in parts:
            sections.append(scaling_section(scene, 0.5 if quick else 3.0, lambda: progress.advance(work)))
        if "budget" in parts:
            sections.append(budget_section())
    for part, text in (("live", "the whole system live"), ("processes", "starting each service")):
        if part in parts:
            waiting = progress.add_task(text, total=None)
            sections.append(live_section(rig, 6.0 if quick else 20.0) if part == "live" else processes_section(rig))
            progress.remove_task(waiting)
    if "tls" in parts:
        waiting = progress.add_task("a bus with and without TLS", total=None)
        sections.append(secured_section(6.0 if quick else 20.0))
        progress.remove_task(waiting)
    if "bridge" in parts:
        waiting = progress.add_task("bridges to four programs", total=None)
        sections.append(bridges_section(rig, 6.0 if quick else 20.0))
        progress.remove_task(waiting)
    if "page" in parts:
        waiting = progress.add_task("two windows of a browser", total=None)
        sections.append(pages_section(rig, 6.0, 1) if quick else pages_section(rig, 10.0))
        progress.remove_task(waiting)
    return sections
