"""`rhot explain`: how one moment of a recording was tracked and why, as an HTML page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from rhot.anatomy.skeleton import FINGERS
from rhot.cli.options import FiniteRange, rig_option
from rhot.core import Explaining, Explanation, ExplanationRow, PictureExplanation, Verdict
from rhot.messages import HandPose, PointSet, ServiceStatus
from rhot.offline import core, marker_frames, rig_timing, track_with
from rhot.plugins import load_plugin
from rhot.recording import PictureTrack, Recording, VideoTrack, load_recording
from rhot.recording.attached import attached_rig
from rhot.recording.mcap.reader import open_mcap
from rhot.rig import Rig, load_rig
from rhot.rig.folder import write_text_atomic
from rhot_tools.explain.moment import Moment, Trace, difference_m, moment_of_folder, moment_of_mcap, trace_of
from rhot_tools.explain.page import explanation_page
from rhot_tools.recordings.beside import newest, pictures_beside

# The first tables of an explanation: summary of the markers, messages published by the rig, its services.

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


def _time(_: click.Context, __: click.Parameter, text: str) -> float:
    """Return seconds, or nanoseconds as an exact integer."""
    try:
        value = int(text) if text.isdecimal() else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value < 0:
        raise click.BadParameter(f"{text!r} is not a time; give seconds such as 12.5, or a message's t_ns")
    return value


@click.command()
@click.argument("recording_path", metavar="RECORDING", type=click.Path(path_type=Path))
@click.option(
    "--at",
    metavar="TIME",
    callback=_time,
    required=True,
    help="Seconds after the first marker frame, or the t_ns of a message.",
)
@click.option(
    "--out",
    "out_path",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("explain.html"),
    show_default=True,
    help="Page to write.",
)
@click.option(
    "--lead",
    "lead_s",
    type=FiniteRange(0.1, 3600),
    default=10.0,
    show_default=True,
    help="Seconds before the moment to process, so that the filters reach the state they had then.",
)
@rig_option
@click.pass_context
def explain(
    context: click.Context, recording_path: Path, at: float, out_path: Path, lead_s: float, rig_path: Path
) -> None:
    """Explain how one moment of a recording was tracked, as an HTML page to attach to a bug report.

    RECORDING is an MCAP file of `rhot record`, or a folder of pictures, videos or marker tracks. The same code as in
    the live rig processes the seconds before that moment. The page shows the pictures, if `rhot record --frames` took
    them, with every candidate and why it was accepted or rejected, the gates, the filters and the hand. The rig is the
    one stored in the recording, unless --rig names another.

    \b
    rhot explain grasp.mcap --at 12.5 --out report.html
    """
    given = context.get_parameter_source("rig_path") is not click.core.ParameterSource.DEFAULT
    with ExitStack() as stack:
        if recording_path.is_dir():
            rig = load_rig(rig_path)
            moment = moment_of_folder(
                load_recording(recording_path, rig_timing(rig)), lambda part: marker_frames(rig, part), at, lead_s
            )
        else:
            messages = open_mcap(recording_path)
            carried = messages.attachments
            rig = load_rig(rig_path) if given else stack.enter_context(attached_rig(carried, recording_path))
            moment = moment_of_mcap(messages, pictures_beside(recording_path), at, lead_s)
        page = _page(rig, moment, recording_path, lead_s)
    write_text_atomic(out_path, page)
    console = Console(soft_wrap=True, markup=False)
    console.print(f"{out_path}: {len(page) / 1e3:.0f} kB, {moment.since_s:.3f} s into the recording")


def _page(rig: Rig, moment: Moment, path: Path, lead_s: float) -> str:
    fusion, ik = core("fusion")(rig), core("ik")(rig)
    trace = trace_of(moment.t_ns, track_with(fusion, ik, moment.frames))
    tables: list[Explanation] = []
    for stage in (fusion, ik):
        if isinstance(stage, Explaining):
            tables += stage.explain()
    pictures = {} if moment.pictures is None else _explained(rig, moment.pictures)
    about = (
        f"{path}, {moment.since_s:.3f} s after its first marker frame, t_ns {moment.t_ns} on the rig clock. "
        f"Rig {rig.config.name}, fusion method {rig.config.fusion.method}, hand solver {rig.config.ik.solver}. "
        f"Recomputed from the preceding {lead_s:g} s at most: {len(moment.frames)} marker frames."
    )
    first = [in_short(rig, trace, pictures), *published_then(moment, trace)]
    return explanation_page(f"{path.name} at {moment.since_s:.3f} s", about, rig, trace, first, pictures, tables)


def _explained(rig: Rig, pictures: Recording) -> dict[str, PictureExplanation]:
    """Return the explanation of each camera's last picture; empty without `colors.json`."""
    if not rig.colors_path.exists():
        return {}
    explain_last = load_plugin("rhot.explainers", "capture", "explaining pictures", "capture")
    # Pictures before the one to explain: detection uses up to ten previous ones, and searches everywhere every
    # thirty.
    return {
        name: explain_last(rig, newest(track, 30 + 1))
        for name, track in pictures.cameras.items()
        if name in rig.cameras and isinstance(track, PictureTrack | VideoTrack)
    }
