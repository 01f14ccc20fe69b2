"""The figures of a simulated run: every number that is printed, under the name that the report gives it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.messages import ServiceStatus
from rhot.report.html import figures_table
from rhot_sim.comparison.accuracy import hand_errors, object_errors, point_errors, seconds_since
from rhot_sim.comparison.collect import Collected, HandSample, ObjectSample, PointsSample
from rhot_sim.world.world import World

# Tables of a run's figures for the terminal.

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
    if not report.get(got):
        return (
            False,
            f"Nothing was tracked ({told}); while it runs, `rhot status` shows which service complains of what.",
        )
    return False, (
        f"This machine did not keep up ({told}): these figures are the machine's, not the tracker's. Try it with "
        f"nothing else running, or with --rate {rate_hz / 2:g}."
    )


def _degrees(report: Mapping[str, Any]) -> str:
    return f"orientation {number_text(report, 'object_error_deg', 'median', digits=2)}°"


S = TypeVar("S", HandSample, PointsSample, ObjectSample)


def window(samples: Sequence[S], start_t_ns: int, from_s: float, to_s: float) -> list[S]:
    """Return what was true between two times, seconds since the start."""
    low, high = start_t_ns + round(from_s * 1e9), start_t_ns + round(to_s * 1e9)
    chosen = []
    # From the end, because a live table wants the last second of a long run; what is older than the window by more than
    # any disorder ends the search.
    for sample in reversed(samples):
        t_ns = sample.t_ns
        disorder_ns = 1_000_000_000
        if t_ns < low - disorder_ns:
            break
        if low <= t_ns < high:
            chosen.append(sample)
    chosen.reverse()
    return chosen


def spread(values: FloatArray, scale: float) -> dict[str, float]:
    """Return median, 95th percentile and maximum of the finite values, scaled; empty where there are none."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return {}
    median, p95 = np.percentile(finite, (50, 95))
    return {"median": float(median * scale), "p95": float(p95 * scale), "max": float(finite.max() * scale)}


def tracking_figures(world: World, start_t_ns: int, collected: Collected, from_s: float, to_s: float) -> dict[str, Any]:
    """Return accuracy, rate and latency between two times of a run.

    Args:
        world: the truth.
        start_t_ns: rig time at which the world's time is 0.
        collected: what was published.
        from_s, to_s: seconds since the start.
    """
    seconds = max(to_s - from_s, 1e-3)
    figures: dict[str, Any] = {}
    tips, joints, ages, stamps = [], [], [], []
    per_finger: dict[str, list[FloatArray]] = {finger: [] for finger in FINGERS}
    poses_measured: list[FloatArray] = []
    for side, arrivals in collected.hands.items():
        if side not in world.hands:
            continue  # a board may stand before the cameras by now
        poses = window(arrivals, start_t_ns, from_s, to_s)
        if not poses:
            continue
        errors = hand_errors(world, start_t_ns, poses)
        tips.append(errors.tips_m.ravel())
        joints.append(errors.joints_m.ravel())
        poses_measured.append(errors.measured.astype(float).ravel())
        for index, finger in enumerate(FINGERS):
            per_finger[finger].append(errors.tips_m[:, index])
        ages += [pose.age_s for pose in poses]
        stamps += [pose.t_ns for pose in poses]
    figures["rate_hz"] = len(stamps) / seconds / max(len(world.hands), 1)
    figures["fingertip_error_mm"] = spread(joined(tips), 1e3)
    figures["fingertip_error_mm"]["per_finger"] = {
        finger: spread(joined(values), 1e3) for finger, values in per_finger.items()
    }
    figures["fingers_measured"] = float(np.mean(joined(poses_measured))) if poses_measured else 0.0
    figures["joint_error_mm"] = spread(joined(joints), 1e3)
    points = window(collected.points, start_t_ns, from_s, to_s)
    by_marker = point_errors(world, start_t_ns, points)
    figures["point_error_mm"] = spread(joined([np.linalg.norm(e, axis=1) for e in by_marker.values()]), 1e3)
    figures["point_error_mm"]["per_marker"] = {
        name: {
            **spread(np.linalg.norm(error, axis=1), 1e3),
            "bias_xyz": [float(1e3 * value) for value in np.median(error, axis=0)],
        }
        for name, error in by_marker.items()
    }
    objects = {name: window(arrivals, start_t_ns, from_s, to_s) for name, arrivals in collected.objects.items()}
    found = object_errors(world, start_t_ns, objects)
    figures["object_error_mm"] = spread(joined([distance for distance, _ in found.values()]), 1e3)
    figures["object_error_deg"] = spread(joined([angle for _, angle in found.values()]), float(np.degrees(1.0)))
    figures["object_rate_hz"] = sum(map(len, objects.values())) / seconds / max(len(world.objects), 1)
    if ages:
        figures["latency_ms"] = latency_ms(ages)
        # Time between one pose and the next as published: a gap is what a user sees as a stutter.
        gaps = np.diff(np.sort(seconds_since(start_t_ns, stamps)))
        figures["largest_gap_ms"] = float(1e3 * gaps.max()) if gaps.size else 0.0
    return figures


def latency_ms(ages_s: Sequence[float]) -> dict[str, float]:
    """Return median, 99th percentile and maximum of ages on arrival, milliseconds."""
    p50, p99 = np.percentile(np.array(ages_s), (50, 99))
    return {"p50": float(1e3 * p50), "p99": float(1e3 * p99), "max": float(1e3 * max(ages_s))}


def service_figures(before: Mapping[str, ServiceStatus], after: Mapping[str, ServiceStatus]) -> dict[str, Any]:
    """Return what the services say of themselves: counts since `before`, latencies, clocks.

    Args:
        before: statuses when the steady state began, by `service/instance`.
        after: statuses at the end.
    """
    services: dict[str, Any] = {}
    dropped_late = 0
    for name, status in sorted(after.items()):
        earlier = before[name].counts if name in before else {}
        counts = {key: value - earlier.get(key, 0) for key, value in status.counts.items()}
        dropped_late += counts.get("dropped_late", 0)
        services[name] = {
            "state": status.state,
            "rates_hz": status.rates,
            "counts": counts,
            "latency_ms": {
                stage: {key: 1e3 * value for key, value in latencies.items()}
                for stage, latencies in status.latency_s.items()
            },
            "clock_uncertainty_ms": None if status.clock_uncertainty_s is None else 1e3 * status.clock_uncertainty_s,
            "last_error": status.last_error,
        }
    return {"dropped_late": dropped_late, "services": services}


def latency_parts(services: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the parts of the way from mid-exposure to pose, milliseconds, the slowest instance of each."""
    wanted = {
        "age when the picture is there": ("capture/", "frame_age"),
        "work: finding the markers": ("capture/", "detect"),
        "age when capture publishes": ("capture/", "output_age"),
        "age when fusion publishes": ("fusion/", "output_age"),
        "work: fusion": ("fusion/", "compute"),
        "age when ik publishes": ("ik/", "output_age"),
        "work: ik": ("ik/", "compute"),
    }
    parts: dict[str, dict[str, float]] = {}
    for text, (prefix, stage) in wanted.items():
        found = [
            service["latency_ms"][stage]
            for name, service in services.items()
            if name.startswith(prefix) and stage in service["latency_ms"]
        ]
        if found:
            slowest = max(found, key=lambda latency: latency["p99"])
            parts[text] = {"p50": slowest["p50"], "p99": slowest["p99"]}
    return parts


def joined(arrays: Sequence[FloatArray]) -> FloatArray:
    """Return all numbers of some arrays, (N,)."""
    return np.concatenate([array.ravel() for array in arrays]) if arrays else np.empty(0)
