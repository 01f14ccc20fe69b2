"""Tables of a run's figures for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from rhot.report.tables import figures_table

_NOTHING = "–"
_KEPT_UP = 0.9
"""Share of the asked rate; simulated cameras lose 2 % by design."""


def number_text(figures: Mapping[str, Any], *path: str, digits: int = 1) -> str:
    """Return the number at a path in nested figures, or a dash."""
    value: Any = figures
    for name in path:
        if not isinstance(value, Mapping) or name not in value:
            return _NOTHING
        value = value[name]
    return f"{value:.{digits}f}" if isinstance(value, int | float) else _NOTHING


def live_table(
    elapsed_s: float, duration_s: float, figures: Mapping[str, Any], services: RenderableType
) -> RenderableType:
    """Return the table that is shown while the rig runs.

    Args:
        elapsed_s, duration_s: of the run.
        figures: `tracking_figures` of the last second or two.
        services: table of the services.
    """
    head = Text.assemble(
        ("RHOT simulated rig", "bold"), f"   {elapsed_s:5.1f} of {duration_s:.0f} s   ", ("Ctrl-C to stop", "dim")
    )
    tracking = figures_table("tracked", "rate /s", "error median mm", "error p95 mm", "age p50 ms", "age p99 ms")
    tracking.add_row(
        "fingertips",
        number_text(figures, "rate_hz"),
        number_text(figures, "fingertip_error_mm", "median"),
        number_text(figures, "fingertip_error_mm", "p95"),
        number_text(figures, "latency_ms", "p50"),
        number_text(figures, "latency_ms", "p99"),
    )
    tracking.add_row(
        "object",
        number_text(figures, "object_rate_hz"),
        number_text(figures, "object_error_mm", "median", digits=2),
        number_text(figures, "object_error_mm", "p95", digits=2),
        "",
        "",
    )
    return Group(head, tracking, services)


def summary(report: Mapping[str, Any]) -> RenderableType:
    """Return the summary printed at the end of a run; all of its figures are in the report."""
    table = figures_table("figure", "value", title="Summary")
    table.add_column("", style="dim")
    coverage = f"{100 * report['coverage']:.2f} %" if "coverage" in report else _NOTHING

    def millimetres(*path: str) -> str:
        return f"{number_text(report, *path, digits=2)} mm"

    rows = [
        ("hand poses per second", number_text(report, "rate_hz"), f"cameras at {report['camera_rate_hz']:g} Hz"),
        ("coverage", coverage, f"measured, of {report.get('coverage_samples', 0)} visible to two cameras"),
        (
            "fingertip error, median",
            millimetres("fingertip_error_mm", "median"),
            "tip joint of the hand, against ground truth",
        ),
        ("fingertip error, p95", millimetres("fingertip_error_mm", "p95"), ""),
        ("marker error, median", millimetres("point_error_mm", "median"), "centre of the paint, before ik"),
        ("joint error, median", millimetres("joint_error_mm", "median"), "all 26 joints"),
        ("object error, median", millimetres("object_error_mm", "median"), _degrees(report)),
        (
            "latency, p50",
            f"{number_text(report, 'latency_ms', 'p50')} ms",
            "from mid-exposure to the pose at the reader",
        ),
        ("latency, p99", f"{number_text(report, 'latency_ms', 'p99')} ms", ""),
        ("frames dropped as late", str(report["dropped_late"]), f"after the first {report['steady_from_s']:g} s"),
        ("frames lost by cameras", str(report["missed"]), "2 % by design; more if this machine is busy"),
    ]
    for row in rows:
        table.add_row(*row)
    parts = figures_table("step", "p50 ms", "p99 ms", title="Where the latency goes")
    for name, part in report.get("latency_ms", {}).get("parts", {}).items():
        parts.add_row(name, f"{part['p50']:.1f}", f"{part['p99']:.1f}")
    return Group(table, parts)


def machine_verdict(report: Mapping[str, Any]) -> tuple[bool, str]:
    """Return whether the machine drew and tracked as fast as was asked, and a sentence about it."""
    cameras, rate_hz = max(len(report.get("cameras", ())), 1), float(report["camera_rate_hz"])
    what, got = ("pictures", "pictures_hz") if "pictures_hz" in report else ("poses", "rate_hz")
    told = f"{report.get(got, 0.0):.0f} of {cameras * rate_hz:.0f} {what} a second"
    if report.get(got, 0.0) >= _KEPT_UP * cameras * rate_hz:
        return True, f"This machine kept up ({told})."
    return False, (
        f"This machine did not keep up ({told}): these figures are the machine's, not the tracker's. Try it with "
        f"nothing else running, or with --rate {rate_hz / 2:g}."
    )


def _degrees(report: Mapping[str, Any]) -> str:
    return f"orientation {number_text(report, 'object_error_deg', 'median', digits=2)}°"
