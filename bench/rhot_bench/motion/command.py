"""`rhot evaluate motion`: recorded hands before a family of random rigs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, Literal

import click
from rich.console import Console

from rhot.cli.options import FiniteRange
from rhot_bench.motion.figures import stratum_sections
from rhot_bench.motion.recordings import list_recordings
from rhot_bench.motion.run import Job, RigResult, Stratum, run_job
from rhot_bench.motion.tracks import MarkerKind
from rhot_bench.processes import each
from rhot_tools.measures.output import counted, json_option, show
from rhot_tools.measures.rows import check_output

Half = Literal["develop", "held-back"]

STRATA: Final = (
    Stratum("60 fps, 0.1 px", 60.0, 0.1, (1.3, 4.0)),
    Stratum("30 fps, 0.1 px", 30.0, 0.1, (2.2, 7.0)),
    Stratum("15 fps, 0.1 px", 15.0, 0.1, (5.0, 15.0)),
    Stratum("the whole family"),
)
"""Strata with their targets; the last one is the family as drawn, which has none of its own."""
_NAMES: Final = {"60": STRATA[0], "30": STRATA[1], "15": STRATA[2], "family": STRATA[3]}


@click.command()
@click.argument("data_path", metavar="DATA", type=click.Path(path_type=Path))
@click.option("--rigs", type=click.IntRange(min=1), default=6, show_default=True, help="Rigs to draw; 30 for a report.")
@click.option(
    "--seconds",
    type=FiniteRange(min=1.0),
    default=2.5,
    show_default=True,
    help="Of each clip; 6 for a report.",
)
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Rigs to run at the same time.")
@click.option(
    "--half",
    type=click.Choice(["develop", "held-back"]),
    default="develop",
    show_default=True,
    help="Half of the family; held-back is for final validation only, so that nothing is tuned to it.",
)
@click.option(
    "--markers",
    type=click.Choice(["caps", "points"]),
    default="caps",
    show_default=True,
    help="caps: cameras see the middle of the paint that faces them. points: they see the marker's own middle, so that "
    "the filter alone is judged.",
)
@click.option("--stratum", "chosen", multiple=True, type=click.Choice(list(_NAMES)), help="Only this; may be repeated.")
@click.option("--first", type=click.IntRange(min=0), default=0, show_default=True, help="Number of the first rig.")
@json_option
def motion(
    data_path: Path,
    rigs: int,
    seconds: float,
    jobs: int,
    half: Half,
    markers: MarkerKind,
    chosen: tuple[str, ...],
    first: int,
    json_path: Path | None,
) -> None:
    """Track recorded hand motion with random simulated rigs, and compare points and hands with ground truth.

    DATA is a folder with recorded joints (msra14_*.csv, nyu_*.csv, fpha/S*_*.csv), or one that holds it as hand_motion.
    Each rig is drawn from a family (15 to 120 fps, any phase, 2 to 4 cameras, rolling shutters, lost frames, a
    calibration as wrong as it states) and looks at another clip, hand, paint and patch. Fingers, palm and an object in
    the hand hide what lies behind them.

    For comparison, two references run on the same tracks: a plain filter per marker (causal) and a cubic spline per
    camera and marker (offline). The same seeds give the same figures.
    """
    check_output("--json", json_path)
    list_recordings(data_path)
    strata = tuple(_NAMES[name] for name in chosen) or STRATA
    seeds = [2 * number + (half == "held-back") for number in range(first, first + rigs)]
    work = [Job(seed, data_path, seconds, strata, markers) for seed in seeds]
    console = Console(stderr=True, soft_wrap=True)
    results: list[list[RigResult]] = []
    with counted(console) as progress:
        task = progress.add_task("tracking rigs", total=len(work))
        for result in _run(work, jobs):
            results.append(result)
            progress.advance(task)
    sections = [
        section
        for number, stratum in enumerate(strata)
        for section in stratum_sections(stratum, [result[number] for result in results])
    ]
    drawn = {str(result[0].seed): [one.about for one in result] for result in results}
    show(
        "evaluate motion",
        sections,
        json_path,
        half=half,
        rigs=rigs,
        seconds=seconds,
        markers=markers,
        first=first,
        drawn=drawn,
    )


def _run(work: Sequence[Job], jobs: int) -> Iterator[list[RigResult]]:
    """Yield the results in the order of the work."""
    if jobs == 1:
        yield from map(run_job, work)
        return
    yield from each(run_job, work, jobs)
