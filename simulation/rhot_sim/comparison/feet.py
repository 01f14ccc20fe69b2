"""How well a running rig tracks the feet of a simulated person: what is kept of its messages, and the figures."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from rhot.arrays import FloatArray
from rhot.bus import Bus
from rhot.messages import BodyPose, FootPose, Side
from rhot.report.html import figures_table
from rhot_sim.comparison.accuracy import seconds_since
from rhot_sim.comparison.collect import follow
from rhot_sim.comparison.figures import joined, latency_ms, number_text, spread
from rhot_sim.walker.world import WalkerWorld

# Tables of the figures of a run with feet, for the terminal.


def live_feet_table(
    elapsed_s: float, duration_s: float, figures: Mapping[str, Any], services: RenderableType
) -> RenderableType:
    """Return the table that is shown while the person walks; see `rhot_sim.comparison.figures.live_table`."""
    head = Text.assemble(
        ("RHOT simulated feet", "bold"), f"   {elapsed_s:5.1f} of {duration_s:.0f} s   ", ("Ctrl-C to stop", "dim")
    )
    tracking = figures_table("tracked", "rate /s", "error median mm", "error p95 mm", "worst mm", "age p50 ms")
    tracking.add_column("stages")
    tracking.add_row(
        "feet",
        number_text(figures, "rate_hz"),
        number_text(figures, "foot_error_mm", "median"),
        number_text(figures, "foot_error_mm", "p95"),
        number_text(figures, "foot_error_mm", "max"),
        number_text(figures, "latency_ms", "p50"),
        stages_text(figures),
    )
    tracking.add_row(
        "knees",
        "",
        number_text(figures, "knee_error_mm", "median"),
        number_text(figures, "knee_error_mm", "p95"),
        number_text(figures, "knee_error_mm", "max"),
        "",
        "",
    )
    return Group(head, tracking, services)


def feet_summary(report: Mapping[str, Any]) -> RenderableType:
    """Return the summary printed at the end of a run; all of its figures are in the report."""
    table = figures_table("figure", "value", title="Summary")
    table.add_column("")

    def millimetres(*path: str) -> str:
        return f"{number_text(report, *path)} mm"

    rows = [
        ("foot poses per second", number_text(report, "rate_hz"), f"camera at {report['camera_rate_hz']:g} Hz"),
        ("pictures per second", number_text(report, "pictures_hz"), "rendered in time and tracked"),
        ("measured", f"{100 * report['measured']:.1f} %", stages_text(report)),
        ("foot error, median", millimetres("foot_error_mm", "median"), "centre of the marker, measured feet"),
        ("foot error, p95", millimetres("foot_error_mm", "p95"), ""),
        ("foot error, worst", millimetres("foot_error_mm", "max"), ""),
        ("predicted feet, p95", millimetres("predicted_error_mm", "p95"), "without any measurement"),
        ("knee error, median", millimetres("knee_error_mm", "median"), f"{report['knees_backwards']} bent backwards"),
        ("latency, p50", f"{number_text(report, 'latency_ms', 'p50')} ms", "from the pose's timestamp to the reader"),
        ("latency, p99", f"{number_text(report, 'latency_ms', 'p99')} ms", ""),
        ("cores of the feet service", number_text(report, "feet_cores", digits=2), "without rendering"),
    ]
    for row in rows:
        table.add_row(*row)
    return table


def stages_text(figures: Mapping[str, Any]) -> str:
    """Return the shares of the stages, such as `marker 80 %, depth 20 %`."""
    stages: Mapping[str, float] = figures.get("stages", {})
    ranked = sorted(stages.items(), key=lambda item: -item[1])
    return ", ".join(f"{stage} {100 * share:.0f} %" for stage, share in ranked)


@dataclass(frozen=True, slots=True)
class FootSample:
    """One foot as it arrived.

    Attributes:
        t_ns: when it was true, rig clock.
        age_s: from then to its arrival here.
        position: metres, rig frame.
        stage: see `FootPose`.
        measured: whether it was.
    """

    t_ns: int
    age_s: float
    position: tuple[float, float, float]
    stage: str
    measured: bool


@dataclass(frozen=True, slots=True)
class KneesSample:
    """Both knees as they arrived.

    Attributes:
        t_ns: when they were true, rig clock.
        positions: leg to its knee, metres, rig frame.
        backwards: a knee bends the wrong way.
    """

    t_ns: int
    positions: dict[Side, tuple[float, float, float]]
    backwards: bool


@dataclass(slots=True)
class CollectedFeet:
    """Everything of one run, in order of arrival.

    Attributes:
        feet: by side.
        knees: of all bodies.
        invalid: messages that were none.
    """

    feet: dict[Side, list[FootSample]] = field(default_factory=dict)
    knees: list[KneesSample] = field(default_factory=list)
    invalid: int = 0

    def clear(self) -> None:
        """Forget all, as at a session's start."""
        self.feet.clear()
        self.knees.clear()
        self.invalid = 0


async def collect_feet(bus: Bus, into: CollectedFeet, rig_now_ns: Callable[[], int]) -> None:
    """Collect feet and bodies until cancelled; `into` grows meanwhile, `rig_now_ns` reads the rig clock."""

    def refuse() -> None:
        into.invalid += 1

    def keep_foot(_: str, pose: FootPose, age_s: float) -> None:
        sample = FootSample(pose.t_ns, age_s, pose.position, pose.stage, pose.state == "measured")
        into.feet.setdefault(pose.side, []).append(sample)

    def keep_body(_: str, body: BodyPose, __: float) -> None:
        positions = {side: body.joints[f"{side}_knee"].position for side in body.legs}
        backwards = any(angles.knee_flexion < 0.0 for angles in body.angles.values())
        into.knees.append(KneesSample(body.t_ns, positions, backwards))

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(follow(bus.events("rhot/foot/*"), FootPose, rig_now_ns, keep_foot, refuse))
        tasks.create_task(follow(bus.events("rhot/body"), BodyPose, rig_now_ns, keep_body, refuse))


def feet_figures(
    world: WalkerWorld, start_t_ns: int, collected: CollectedFeet, from_s: float, to_s: float
) -> dict[str, Any]:
    """Return accuracy, rate and latency between two times of a run, seconds since its start.

    Errors are taken over measured feet; how many those are of all that could be published stands beside them.
    """
    seconds = max(to_s - from_s, 1e-3)
    low, high = start_t_ns + round(from_s * 1e9), start_t_ns + round(to_s * 1e9)
    errors: dict[str, FloatArray] = {}
    guesses: list[FloatArray] = []
    ages: list[float] = []
    stages: Counter[str] = Counter()
    measured = 0
    for side, arrivals in collected.feet.items():
        samples = [sample for sample in arrivals if low <= sample.t_ns < high]
        if not samples:
            continue
        truth = world.feet(seconds_since(start_t_ns, [sample.t_ns for sample in samples]))[side][:, :3, 3]
        distance = np.linalg.norm(np.array([sample.position for sample in samples]) - truth, axis=1)
        seen = np.array([sample.measured for sample in samples])
        errors[side] = distance[seen]
        guesses.append(distance[~seen])
        ages += [sample.age_s for sample in samples]
        stages.update(sample.stage for sample in samples)
        measured += int(seen.sum())
    count = max(sum(stages.values()), 1)
    figures: dict[str, Any] = {
        "rate_hz": sum(stages.values()) / seconds / max(len(world.feet_config.feet), 1),
        "foot_error_mm": {
            **spread(joined(list(errors.values())), 1e3),
            "per_foot": {side: spread(values, 1e3) for side, values in errors.items()},
        },
        "predicted_error_mm": spread(joined(guesses), 1e3),
        "measured": measured / count,
        "stages": {stage: number / count for stage, number in sorted(stages.items())},
        "knee_error_mm": spread(_knee_errors(world, start_t_ns, collected, low, high), 1e3),
        "knees_backwards": sum(knees.backwards for knees in collected.knees),
    }
    if ages:
        figures["latency_ms"] = latency_ms(ages)
    return figures


def _knee_errors(world: WalkerWorld, start_t_ns: int, collected: CollectedFeet, low: int, high: int) -> FloatArray:
    knees = [sample for sample in collected.knees if low <= sample.t_ns < high]
    if not knees:
        return np.empty(0)
    truth: Mapping[str, FloatArray] = world.joints(seconds_since(start_t_ns, [sample.t_ns for sample in knees]))
    return np.array(
        [
            float(np.linalg.norm(np.array(position) - truth[f"{side}_knee"][k, :3, 3]))
            for k, sample in enumerate(knees)
            for side, position in sample.positions.items()
        ]
    )
