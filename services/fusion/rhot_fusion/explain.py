"""What fusion knows of each marker and why it believed the cameras or not; reads, changes nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rhot.explain import Explanation, ExplanationRow
from rhot_fusion.filter.acquisition import CONFIRMATIONS
from rhot_fusion.filter.motion_bank import DENSITIES
from rhot_fusion.filter.tracker import GATE, SLACK_PX, FilterTracker
from rhot_fusion.views.sightings import Tracker

MODELS = ("at rest", "slow", "brisk", "brisk across the view", "fast")
"""Names of the motion models, in the order of `DENSITIES`."""


def tracker_tables(
    tracker: Tracker, cameras: Sequence[str], markers: Sequence[str], counts: Mapping[str, int], now_s: float
) -> list[Explanation]:
    """Return what a tracker knows.

    Args:
        tracker: of any method; the `filter` one can tell more.
        cameras, markers: names, in the tracker's order.
        counts: of the stage.
        now_s: the moment, seconds since the stream's start.
    """
    tables = [_rig(tracker, counts)]
    if isinstance(tracker, FilterTracker):
        tables = [_gates(tracker, cameras, markers, now_s), _states(tracker, cameras, markers, now_s), *tables]
    return tables


def _gates(tracker: FilterTracker, cameras: Sequence[str], markers: Sequence[str], now_s: float) -> Explanation:
    rows = []
    focal_px = tracker.focal_px
    for camera, gates in sorted(tracker.gates.items()):
        slack = (SLACK_PX / focal_px) ** 2
        limits = np.sqrt(GATE * (gates.variance + slack)) * focal_px
        for row, marker in enumerate(gates.index.tolist()):
            miss = gates.y[row] * focal_px
            limit = limits[row].tolist()
            accepted = bool(gates.accepted[row])
            rows.append(
                ExplanationRow(
                    (
                        cameras[camera],
                        markers[marker],
                        f"{1e3 * (now_s - gates.times_s[row]):.1f}",
                        f"{miss[0]:+.2f}",
                        f"{limit[0]:.2f}",
                        f"{miss[1]:+.2f}",
                        f"{limit[1]:.2f}",
                        "taken" if accepted else _refusal(miss, limit, bool(gates.held[row])),
                    ),
                    "taken" if accepted else "refused",
                )
            )
    return Explanation(
        "Gates: each camera's newest frame against what was expected",
        ("camera", "marker", "ms ago", "off in x, px", "gate x, px", "off in y, px", "gate y, px", "verdict"),
        tuple(rows),
        f"Distance of the observation from the filter's prediction; the gate is {GATE**0.5:.0f} standard deviations of "
        f"both together with {SLACK_PX:g} px added. Markers that are not tracked have no prediction and stand below.",
    )


def _refusal(miss_px: Sequence[float], limit_px: Sequence[float], held: bool) -> str:
    outside = [
        f"{abs(miss):.1f} px off in {axis}, gate {limit:.1f} px"
        for axis, miss, limit in zip("xy", miss_px, limit_px, strict=True)
        if abs(miss) > limit
    ]
    if outside:
        return "; ".join(outside)
    return "repeats its last position while it moves" if held else "nearer to where another marker is expected"


def _states(tracker: FilterTracker, cameras: Sequence[str], markers: Sequence[str], now_s: float) -> Explanation:
    bank, presence = tracker.bank, tracker.presence
    rows = []
    for place, name in enumerate(markers):
        if not presence.tracked[place]:
            agreed = tracker.agreed(place)
            rows.append(
                ExplanationRow(
                    (name, f"not tracked: two views agreed {agreed} times of {CONFIRMATIONS}", *([""] * 7)), "refused"
                )
            )
            continue
        mean, cov = bank.mean[place], bank.cov[place]
        fresh = [camera for camera, seen in zip(cameras, presence.fresh[:, place].tolist(), strict=True) if seen]
        weight = bank.weight[place]
        rows.append(
            ExplanationRow(
                (
                    name,
                    "tracked",
                    ", ".join(f"{1e3 * value:.1f}" for value in mean[:3]),
                    f"{np.linalg.norm(mean[3:]):.3f}",
                    " / ".join(f"{1e3 * np.sqrt(cov[axis, axis]):.2f}" for axis in range(3)),
                    f"{1e3 * (now_s - presence.seen_s[place]):.0f}",
                    f"{1e3 * (now_s - presence.backed_s[place]):.0f}",
                    ", ".join(fresh) or "none",
                    f"{MODELS[int(np.argmax(weight))]} ({100 * weight.max():.0f} %)",
                ),
                "taken" if fresh else "refused",
            )
        )
    return Explanation(
        "Filters: what is known of each marker",
        (
            "marker",
            "state",
            "x, y, z, mm",
            "speed, m/s",
            "sigma x / y / z, mm",
            "seen, ms ago",
            "seen by two, ms ago",
            "newest frame shows it",
            "moves",
        ),
        tuple(rows),
        f"Middles as the cameras see them, rig frame. The motion models differ in the acceleration they expect, "
        f"{DENSITIES[0][0]:g} to {DENSITIES[-1][0]:g} m²/s³.",
    )


def _rig(tracker: Tracker, counts: Mapping[str, int]) -> Explanation:
    mean, p95 = tracker.epipolar.figures_px
    rows = [
        ("epipolar residual, mean, px", f"{mean:.2f}"),
        ("epipolar residual, p95, px", f"{p95:.2f}"),
        ("correction for cameras that moved, px", f"{tracker.epipolar.correction_px:.2f}"),
        ("noise of an observation, px", f"{tracker.epipolar.spread_px:.2f}"),
        *((f"count: {name}", str(count)) for name, count in sorted(counts.items()) if count),
    ]
    return Explanation(
        "Fusion: how well the cameras agree, and counts since the run-up began",
        ("figure", "value"),
        tuple(ExplanationRow(row) for row in rows),
    )
