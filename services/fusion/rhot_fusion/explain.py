"""Explain fusion: the state of each marker, and why views were accepted or rejected (read-only)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rhot.explain import Explanation, ExplanationRow
from rhot_fusion.filter.joint import squared_distance
from rhot_fusion.filter.settings import DEFAULT
from rhot_fusion.filter.state import ROUND
from rhot_fusion.filter.tracker import FilterTracker
from rhot_fusion.filter.tracks import TrackStatus
from rhot_fusion.views.sightings import Tracker


def tracker_tables(
    tracker: Tracker, cameras: Sequence[str], markers: Sequence[str], counts: Mapping[str, int], now_s: float
) -> list[Explanation]:
    """Return the tables of a tracker's state.

    Args:
        tracker: of any method; `filter` has tables of its own.
        cameras, markers: names, in the tracker's order.
        counts: of the stage.
        now_s: current time, seconds since the stream's start.
    """
    tables = [_rig(tracker, counts)]
    if isinstance(tracker, FilterTracker):
        tables = [_gates(tracker, cameras, markers), _states(tracker, cameras, markers, now_s), *tables]
    return tables


def _gates(tracker: FilterTracker, cameras: Sequence[str], markers: Sequence[str]) -> Explanation:
    rows = []
    for camera, (index, innovation, slack) in sorted(tracker.gates.items()):
        focal_px = tracker.focal_px(camera)
        S = innovation.S + np.square(slack)[:, None] * ROUND
        sigma_px = np.sqrt(S[:, (0, 2)]) * focal_px
        distance2 = squared_distance(S, innovation.y)
        for marker, y, sigma, nis, accepted in zip(
            index.tolist(), innovation.y * focal_px, sigma_px, distance2.tolist(), innovation.accepted, strict=True
        ):
            rows.append(
                ExplanationRow(
                    (
                        cameras[camera],
                        markers[marker],
                        f"{y[0]:+.2f}",
                        f"{sigma[0]:.2f}",
                        f"{y[1]:+.2f}",
                        f"{sigma[1]:.2f}",
                        f"{nis**0.5:.1f}",
                        "accepted" if accepted else "rejected",
                    ),
                    "accepted" if accepted else "rejected",
                )
            )
    return Explanation(
        "Gates: innovations of each camera's newest frame",
        (
            *("camera", "marker", "innovation x, px", "sigma x, px", "innovation y, px", "sigma y, px"),
            *("Mahalanobis distance", "verdict"),
        ),
        tuple(rows),
        "Innovation: observation minus the filter's prediction. Sigma: its standard deviation, including an allowance "
        f"for occluded paint. Observations with a Mahalanobis distance above {DEFAULT.track.gate**0.5:.0f} are "
        "rejected.",
    )


def _states(tracker: FilterTracker, cameras: Sequence[str], markers: Sequence[str], now_s: float) -> Explanation:
    outcome = tracker.outcome(now_s)
    rows = []
    for index, name in enumerate(markers):
        track = tracker.tracks[index]
        if track.status is not TrackStatus.CONFIRMED or outcome.covariance is None or outcome.state is None:
            status = f"not tracked ({track.status.name.lower()})"
            rows.append(ExplanationRow((name, status, "", "", "", ""), "rejected"))
            continue
        fresh = [camera for camera, seen in zip(cameras, outcome.seen, strict=True) if seen[index]]
        xx, _, _, yy, _, zz = outcome.covariance[index]
        rows.append(
            ExplanationRow(
                (
                    name,
                    outcome.state[index],
                    ", ".join(f"{1e3 * value:.1f}" for value in outcome.position[index]),
                    " / ".join(f"{1e3 * value:.2f}" for value in (xx**0.5, yy**0.5, zz**0.5)),
                    f"{1e3 * (now_s - track.seen_s):.0f}",
                    ", ".join(fresh) or "none",
                ),
                "accepted" if fresh else "rejected",
            )
        )
    return Explanation(
        "Filter: state of each marker",
        ("marker", "state", "x, y, z, mm", "sigma x / y / z, mm", "last seen, ms ago", "visible to cameras"),
        tuple(rows),
    )


def _rig(tracker: Tracker, counts: Mapping[str, int]) -> Explanation:
    mean, p95 = tracker.epipolar.figures_px
    noise = []
    if isinstance(tracker, FilterTracker):
        noise = [(f"noise, camera {k + 1}, px", f"{px:.2f}") for k, px in enumerate(tracker.noise.sigma_px.tolist())]
    rows = [
        ("epipolar residual, mean, px", f"{mean:.2f}"),
        ("epipolar residual, p95, px", f"{p95:.2f}"),
        ("systematic epipolar residual, px", f"{tracker.epipolar.correction_px:.2f}"),
        *noise,
        *((f"count: {name}", str(count)) for name, count in sorted(counts.items()) if count),
    ]
    return Explanation(
        "Fusion: agreement of the cameras, and counts",
        ("quantity", "value"),
        tuple(ExplanationRow(row) for row in rows),
        "The systematic residual grows when a camera moves after its calibration. Counts start with the processed part "
        "of the recording (--lead).",
    )
