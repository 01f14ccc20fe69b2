"""Tables of the figures of a run with feet, for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from rhot.report.tables import figures_table
from rhot_sim.comparison.table import number_text


def live_feet_table(
    elapsed_s: float, duration_s: float, figures: Mapping[str, Any], services: RenderableType
) -> RenderableType:
    """Return the table that is shown while the person walks; see `rhot_sim.comparison.table.live_table`."""
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
