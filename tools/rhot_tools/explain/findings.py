"""The first tables of an explanation: summary of the markers, messages published by the rig, its services."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rhot.anatomy.skeleton import FINGERS
from rhot.core import Explanation, ExplanationRow, PictureExplanation, Verdict
from rhot.messages import HandPose, PointSet, ServiceStatus
from rhot.rig import Rig
from rhot_tools.explain.moment import Moment
from rhot_tools.explain.trace import Trace, difference_m

_STALE_S = 0.1
_SAME_M = 0.001


def in_short(rig: Rig, trace: Trace, pictures: Mapping[str, PictureExplanation]) -> Explanation:
    """Return one row per marker: its detection in each camera, its point, and its finger or palm."""
    rows = []
    fresh = trace.points is not None and trace.t_ns - trace.points.t_ns <= _STALE_S * 1e9
    points = trace.points.points if trace.points is not None and fresh else {}
    for name, marker in rig.config.markers.items():
        cells = [name, *(_seen(camera, name, trace, pictures) for camera in rig.cameras)]
        point = points.get(name)
        cells.append(
            "no point" if point is None else f"{point.state}, {point.views} views, ±{1e3 * point.sigma:.1f} mm"
        )
        hand = trace.hands.get(marker.hand)
        if hand is not None and trace.t_ns - hand.t_ns > _STALE_S * 1e9:
            hand = None
        finger = next((finger for finger in FINGERS if marker.joint.startswith(finger)), "")
        miss = None if hand is None or not finger else hand.residual.get(finger)
        if hand is None:
            cells.append("no hand")
        elif finger:
            state = hand.fingers.get(finger, "")
            cells.append(f"{finger} {state}" + ("" if miss is None else f", residual {1e3 * miss:.1f} mm"))
        else:
            cells.append(f"palm {hand.state}")
        verdict: Verdict = "accepted" if point is not None and point.state == "measured" else "rejected"
        rows.append(ExplanationRow(tuple(cells), verdict))
    columns = ("marker", *(f"camera {camera}" for camera in rig.cameras), "point", "hand")
    return Explanation("Summary", columns, tuple(rows))


def _seen(camera: str, name: str, trace: Trace, pictures: Mapping[str, PictureExplanation]) -> str:
    frame = trace.frames.get(camera)
    if frame is None:
        return "no frame"
    marker = frame.markers.get(name)
    age_s = (trace.t_ns - frame.t_ns) / 1e9
    late = f" ({1e3 * age_s:.0f} ms ago)" if age_s > _STALE_S else ""
    if marker is not None:
        return f"seen at {marker.u:.1f}, {marker.v:.1f}, score {marker.score:.2f}{late}"
    if camera in pictures:
        reasons = [row.cells[-1] for row in pictures[camera].candidates.rows if row.cells[0] == name]
        if reasons and reasons[0] != "accepted":
            return f"not seen{late}: {reasons[0]}"
    return f"not seen{late}"


def published_then(moment: Moment, trace: Trace) -> list[Explanation]:
    """Return the rig's last published messages compared with the recomputed ones, and the status of its services."""
    rows, services = [], []
    for key, message in sorted(moment.published.items()):
        if isinstance(message, ServiceStatus):
            late = {name: count for name, count in message.counts.items() if count}
            services.append(
                ExplanationRow(
                    (
                        f"{message.service}/{message.instance}",
                        message.state,
                        ", ".join(f"{name} {rate:.0f}" for name, rate in sorted(message.rates.items())),
                        ", ".join(f"{name} {count}" for name, count in sorted(late.items())),
                        message.problem or message.last_error,
                    ),
                    "rejected" if message.problem else "",
                )
            )
        elif isinstance(message, HandPose | PointSet):
            again = trace.before.get((key, message.t_ns))
            gap_m = float("nan") if again is None else difference_m(message, again)
            verdict: Verdict = "" if np.isnan(gap_m) else "accepted" if gap_m <= _SAME_M else "rejected"
            rows.append(
                ExplanationRow(
                    (
                        key,
                        f"{(moment.t_ns - message.t_ns) / 1e6:.1f}",
                        "not computed for that time" if np.isnan(gap_m) else f"{1e3 * gap_m:.3f}",
                    ),
                    verdict,
                )
            )
    tables = []
    if rows:
        tables.append(
            Explanation(
                "Published messages compared with recomputed ones",
                ("key", "age, ms", "largest difference, mm"),
                tuple(rows),
                "Recomputed from the recorded markers with the rig folder's settings. They differ if messages were "
                "lost on the way to fusion or ik, if settings were changed while it ran, or if too few seconds were "
                "processed (--lead).",
            )
        )
    if services:
        columns = ("service", "state", "rates, 1/s", "counts", "problem")
        tables.append(Explanation("Services", columns, tuple(services)))
    return tables
