"""`rhot report`: a page for each trial that says whether it can be used, and what to write about it in a paper."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Final

import click
import numpy as np
from rich.console import Console

from rhot import __version__
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.atomic_file import why
from rhot.cli.options import rig_folder_option
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame, PointSet, ServiceStatus
from rhot.recording.attached import rig_of
from rhot.recording.messages import RecordedMessages
from rhot.report.html import html_page
from rhot.report.svg import line_plot
from rhot.rig import Rig, load_rig
from rhot.rig.cameras import camera_models
from rhot.rig.folder import write_text_atomic
from rhot.take import HandTrack, Take
from rhot.take.reading import load
from rhot_tools.measures.output import html_table
from rhot_tools.measures.rows import Section
from rhot_tools.recordings.beside import StoredPicture, pictures_beside, stored_pictures
from rhot_tools.rig.heard import Heard
from rhot_tools.rig.jitter import jitter_sections, still_jitter
from rhot_tools.trial.verdict import STAGES, TrialJudge, TrialVerdict

_MM: Final = 1e3
_PICTURES: Final = 3
_LIGHTS: Final = {"good": "#2d6a4f", "doubtful": "#b8860b", "not usable": "#b00020"}
_STYLE: Final = """
.light { display: inline-block; width: 0.8em; height: 0.8em; border-radius: 50%; margin-right: 0.4em; }
figure { display: inline-block; margin: 0 0.5em 0.5em 0; } figure img { width: 240px; display: block; }
blockquote { background: #f5f5f5; padding: 0.8em 1em; margin: 0.5em 0; }
"""


@dataclass(frozen=True, slots=True)
class Trial:
    """What is known of one recording.

    Attributes:
        file: it.
        take: its arrays.
        verdict: on it.
        rig: that it was recorded with, None if it carries none.
        lost: camera to frames that were never looked at, and all that it took.
        clock_s: largest uncertainty of a camera's clock; NaN if no status says.
        heard: its messages of markers and points, for the jitter.
        fingers: hand to the figures of its five fingers.
        feet: figures of each foot.
    """

    file: Path
    take: Take
    verdict: TrialVerdict
    rig: Rig | None
    lost: dict[str, tuple[int, int]]
    clock_s: float
    heard: Heard
    fingers: dict[str, list[FingerFigures]]
    feet: list[FootFigures]


def trial_of(file: Path, rig: Rig | None) -> Trial:
    """Read a recording.

    Raises:
        ConfigError: it cannot be read, or holds no hand, object, foot or body.
    """
    source = RecordedMessages(file)
    rig = rig or rig_of([source])
    judge, heard = TrialJudge(rig), Heard()
    clocks: list[float] = []
    for key, message in source:
        judge.add(message)
        if isinstance(message, MarkerFrame | PointSet):
            heard.note(key, message)
        if isinstance(message, ServiceStatus) and message.service == "capture":
            clocks += [] if message.clock_uncertainty_s is None else [message.clock_uncertainty_s]
    take = load(file)
    if not take.tracks:
        raise ConfigError(f"{file}: holds nothing that was tracked; `rhot process` tracks marker frames and pictures")
    fingers = {side: finger_figures(take, hand, rig) for side, hand in sorted(take.hands.items())}
    verdict, clock_s = judge.verdict(lost=source.lost), max(clocks, default=float("nan"))
    return Trial(file, take, verdict, rig, judge.lost_frames, clock_s, heard, fingers, foot_figures(take))


# The figures of a hand.


@dataclass(frozen=True, slots=True)
class FingerFigures:
    """What one finger did; NaN where it was not seen.

    Attributes:
        measured, one_view: shares of the poses whose tip fusion measured, or saw with one camera.
        gap_s: longest time without either.
        sigma_m: median and 95th percentile of the tip's standard deviation.
        speed_m_s: 95th percentile.
        knuckle_rad, middle_rad: range of motion of knuckle and middle joint, 2nd to 98th percentile.
    """

    finger: str
    measured: float
    one_view: float
    gap_s: float
    sigma_m: tuple[float, float]
    speed_m_s: float
    knuckle_rad: float
    middle_rad: float


def finger_figures(take: Take, hand: HandTrack, rig: Rig | None) -> list[FingerFigures]:
    """Return the figures of each finger of a hand."""
    side = hand.name.rpartition("/")[2]
    markers = {} if rig is None else rig.config.markers
    tip_of = {m.joint.removesuffix("_tip"): name for name, m in markers.items() if m.hand == side}
    found = []
    for index, finger in enumerate(FINGERS):
        point = take.points.get(tip_of.get(finger, finger))
        states = hand.finger_states[:, index] if point is None else point.state
        t = hand.t if point is None else point.t
        known = np.isin(states, ("measured", "one_view"))
        tip = hand.joint(f"{finger}_tip")
        sigma = hand.sigma[:, hand.joint_names.index(f"{finger}_tip")]
        flexion = hand.angles[:, 4 * index : 4 * index + 4]
        found.append(
            FingerFigures(
                finger=finger,
                measured=float(np.mean(states == "measured")),
                one_view=float(np.mean(states == "one_view")),
                gap_s=_longest_gap_s(t, known),
                sigma_m=(_percentile(sigma, 50), _percentile(sigma, 95)),
                speed_m_s=_percentile(_speed(hand.t, tip), 95),
                knuckle_rad=_percentile(flexion[:, 0], 98) - _percentile(flexion[:, 0], 2),
                middle_rad=_percentile(flexion[:, 2], 98) - _percentile(flexion[:, 2], 2),
            )
        )
    return found


def _all_fingers(trials: Sequence[Trial]) -> list[FingerFigures]:
    return [figures for trial in trials for hand in trial.fingers.values() for figures in hand]


def _percentile(values: FloatArray, share: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, share)) if finite.size else float("nan")


def _longest_gap_s(t: FloatArray, known: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> float:
    if not len(t):
        return float("nan")
    edges = np.concatenate([[t[0]], t[known], [t[-1]]])
    return float(np.diff(edges).max())


def _speed(t: FloatArray, positions: FloatArray) -> FloatArray:
    steps = np.diff(t)
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.where(steps > 0.0, steps, np.nan)
    return np.asarray(speeds)


@dataclass(frozen=True, slots=True)
class FootFigures:
    """What one foot did; NaN where it is not known.

    Attributes:
        stages: share of the poses by what the position rests on, in the order of `STAGES`.
        gap_s: longest time in which nothing measured it.
        sigma_m: median and 95th percentile of its standard deviation.
        speed_m_s: 95th percentile.
        knee_rad: range of motion of its knee, 2nd to 98th percentile.
    """

    side: str
    stages: tuple[float, ...]
    gap_s: float
    sigma_m: tuple[float, float]
    speed_m_s: float
    knee_rad: float


def foot_figures(take: Take) -> list[FootFigures]:
    """Return the figures of each foot."""
    found = []
    for side, foot in sorted(take.feet.items()):
        knees = take.body is not None and f"{side}_knee_flexion" in take.body.angle_names
        knee = take.body.angle(f"{side}_knee_flexion") if take.body is not None and knees else np.empty(0)
        found.append(
            FootFigures(
                side=side,
                stages=tuple(float(np.mean(foot.stage == stage)) for stage in STAGES),
                gap_s=_longest_gap_s(foot.t, foot.state == "measured"),
                sigma_m=(_percentile(foot.sigma, 50), _percentile(foot.sigma, 95)),
                speed_m_s=_percentile(np.linalg.norm(foot.velocities, axis=1), 95),
                knee_rad=_percentile(knee, 98) - _percentile(knee, 2),
            )
        )
    return found


# The page.


def report_html(trials: Sequence[Trial]) -> str:
    """Return one page with all trials: a table with a row each where there are several, then one after the other."""
    single = len(trials) == 1
    title = f"Trial {trials[0].file.name}" if single else f"{len(trials)} trials"
    about = f"Written by rhot report {__version__}. Lengths in millimetres, angles in degrees."
    body = "" if single else _overview(trials)
    body += "".join(_of_trial(number, trial, heading=not single) for number, trial in enumerate(trials))
    return html_page(title, about, body + _methods(trials), _STYLE)


def _light(verdict: TrialVerdict) -> str:
    level = verdict.level if verdict.judged else "doubtful"
    return f"<span class='light' style='background:{_LIGHTS[level]}'></span>{escape(verdict.text)}"


def _overview(trials: Sequence[Trial]) -> str:
    head = ("trial", "verdict", "length, s", "measured", "sigma, mm", "lost frames", "why")
    rows = []
    for number, trial in enumerate(trials):
        fingers = _all_fingers([trial])
        lost, all_frames = (sum(counts) for counts in zip(*trial.lost.values(), strict=True)) if trial.lost else (0, 0)
        shares = [*(each.measured for each in fingers), *(1.0 - each.stages[-1] for each in trial.feet)]
        sigmas_m = [*(each.sigma_m[0] for each in fingers), *(each.sigma_m[0] for each in trial.feet)]
        measured, sigma = np.mean(shares or [np.nan]), np.median(sigmas_m or [np.nan])
        reasons = "; ".join(finding.text for finding in trial.verdict.findings)
        cells = (
            f"<a href='#trial{number}'>{escape(trial.file.name)}</a>",
            _light(trial.verdict),
            f"{_length_s(trial.take):.1f}",
            _percent(float(measured)),
            _number(_MM * float(sigma)),
            _percent(lost / all_frames if all_frames else 0.0),
            escape(reasons),
        )
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    return f"<table><tr>{''.join(f'<th>{name}</th>' for name in head)}</tr>{''.join(rows)}</table>"


def _length_s(take: Take) -> float:
    return max((float(track.t[-1]) for track in take.tracks.values() if len(track)), default=0.0)


def _of_trial(number: int, trial: Trial, *, heading: bool) -> str:
    parts = [f"<h2>{escape(trial.file.name)}</h2>"] if heading else []
    parts.append(f"<p><b>{_light(trial.verdict)}</b></p>")
    if trial.verdict.findings:
        texts = (f"<li>{escape(finding.level)}: {escape(finding.text)}</li>" for finding in trial.verdict.findings)
        parts.append(f"<ul>{''.join(texts)}</ul>")
    figures = [*trial.verdict.figures]
    if np.isfinite(trial.clock_s):
        figures.append(("clocks", f"± {_MM * trial.clock_s:.2f} ms", "largest uncertainty of a camera's"))
    if trial.take.events:
        labels = ", ".join(event.label for event in trial.take.events[:20])
        figures.append(("events", str(len(trial.take.events)), labels))
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td class='number'>{escape(value)}</td><td><small>{escape(note)}</small></td></tr>"
        for name, value, note in figures
    )
    parts.append(f"<table>{rows}</table>")
    for side, hand in sorted(trial.take.hands.items()):
        parts.append(_of_hand(side, hand, trial))
    parts.append(_of_feet(trial))
    parts += [html_table(section) for section in _jitter(trial) if section.rows]
    parts.append(_pictures(trial))
    return f"<section id='trial{number}'>{''.join(parts)}</section>"


def _of_hand(side: str, hand: HandTrack, trial: Trial) -> str:
    head = (
        "finger", "measured", "in one view", "longest gap, s", "sigma, median", "p95", "speed p95, m/s",
        "knuckle, range °", "middle joint, range °",
    )  # fmt: skip
    rows = []
    for each in trial.fingers[side]:
        cells = (
            each.finger,
            _percent(each.measured),
            _percent(each.one_view),
            f"{each.gap_s:.2f}",
            _number(_MM * each.sigma_m[0]),
            _number(_MM * each.sigma_m[1]),
            f"{each.speed_m_s:.2f}",
            _number(float(np.degrees(each.knuckle_rad))),
            _number(float(np.degrees(each.middle_rad))),
        )
        rows.append("<tr>" + "".join(f"<td class='number'>{cell}</td>" for cell in cells) + "</tr>")
    # A plot needs no more points than it has pixels.
    step = max(1, len(hand) // 1500)
    tips = {finger: hand.joint_names.index(f"{finger}_tip") for finger in FINGERS}
    lines = {finger: (hand.t[::step], _MM * hand.sigma[::step, tip]) for finger, tip in tips.items()}
    plot = line_plot(f"Standard deviation of the {side} hand's tips", "t, s", "mm", lines)
    grip = np.linalg.norm(hand.joint("thumb_tip") - hand.joint("index_tip"), axis=1)
    aperture = line_plot(
        "Grip aperture, thumb to index finger", "t, s", "mm", {side: (hand.t[::step], _MM * grip[::step])}
    )
    table = f"<tr>{''.join(f'<th>{name}</th>' for name in head)}</tr>{''.join(rows)}"
    return f"<h3>{escape(side)} hand</h3><table>{table}</table>{plot}{aperture}"


def _of_feet(trial: Trial) -> str:
    if not trial.feet:
        return ""
    head = ("foot", *STAGES, "longest gap, s", "sigma, median", "p95", "speed p95, m/s", "knee, range °")
    rows = []
    for each in trial.feet:
        cells = (
            each.side,
            *(_percent(share) for share in each.stages),
            f"{each.gap_s:.2f}",
            _number(_MM * each.sigma_m[0]),
            _number(_MM * each.sigma_m[1]),
            f"{each.speed_m_s:.2f}",
            _number(float(np.degrees(each.knee_rad))),
        )
        rows.append("<tr>" + "".join(f"<td class='number'>{cell}</td>" for cell in cells) + "</tr>")
    lines = {}
    for side, foot in sorted(trial.take.feet.items()):
        step = max(1, len(foot) // 1500)
        lines[side] = foot.t[::step], _MM * foot.sigma[::step]
    plot = line_plot("Standard deviation of the feet", "t, s", "mm", lines)
    table = f"<tr>{''.join(f'<th>{name}</th>' for name in head)}</tr>{''.join(rows)}"
    return f"<h3>Feet</h3><table>{table}</table>{plot}"


def _jitter(trial: Trial) -> list[Section]:
    cameras: dict[str, CameraModel] = {} if trial.rig is None else camera_models(trial.rig.cameras)
    try:
        return list(jitter_sections(still_jitter(trial.heard, cameras)))
    except ConfigError:
        # Nothing rested.
        return []


def _pictures(trial: Trial) -> str:
    """Return pictures of the moments whose fingertips are least sure, where pictures were recorded."""
    recording = pictures_beside(trial.file)
    if recording is None or not trial.take.hands:
        return ""
    pictures = list(stored_pictures(recording))
    if not pictures:
        return ""
    times = np.array([picture.t_ns for picture in pictures])
    found: list[StoredPicture] = []
    for hand in trial.take.hands.values():
        tips = [hand.joint_names.index(f"{finger}_tip") for finger in FINGERS]
        worst = np.where(hand.state == "measured", np.max(hand.sigma[:, tips], axis=1, initial=0.0), -1.0)
        chosen: list[int] = []
        for row in np.argsort(-worst):
            # Moments of their own, not neighbours.
            if all(abs(int(hand.t_ns[row] - hand.t_ns[other])) > 500_000_000 for other in chosen):
                chosen.append(int(row))
            if len(chosen) == _PICTURES:
                break
        found += [pictures[int(np.argmin(np.abs(times - hand.t_ns[row])))] for row in chosen]
    figures = [
        f"<figure><img src='data:image/{'png' if each.file.suffix == '.png' else 'jpeg'};base64,"
        f"{base64.b64encode(_bytes_of(each.file)).decode()}' alt=''/><figcaption><small>{escape(each.camera)}, "
        f"{1e-9 * (each.t_ns - trial.take.start_ns):.2f} s</small></figcaption></figure>"
        for each in found
    ]
    return f"<h3>The least certain moments</h3>{''.join(figures)}"


def _bytes_of(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {why(error)}") from error


def _methods(trials: Sequence[Trial]) -> str:
    """Return a paragraph for a paper's methods, with the figures of these trials and the citation."""
    rig = next((trial.rig for trial in trials if trial.rig is not None), None)
    total_s = sum(_length_s(trial.take) for trial in trials)
    count = f"{len(trials)} trial{'s' if len(trials) > 1 else ''}, {total_s:.0f} s in all"
    fingers, feet = _all_fingers(trials), [each for trial in trials for each in trial.feet]
    texts = [f"Motion was recorded with RHOT {__version__} ({count})."]
    if fingers:
        measured = 100 * float(np.mean([each.measured for each in fingers]))
        texts += [
            f"Painted markers on the fingertips and the back of the hand were triangulated from "
            f"{'unsynchronised cameras' if rig is None else _cameras_text(rig)} by a Kalman filter, and a hand with 26 "
            f"joints was fitted to them. Fingertips were measured by two or more cameras in {measured:.1f} % of the "
            f"samples; {_sigmas_text(fingers)}.",
        ]
    if feet:
        by_stage = [100 * float(np.mean([each.stages[number] for each in feet])) for number in range(len(STAGES))]
        texts += [
            "Feet were tracked by a head-worn depth camera with a printed marker on each foot, and by inertial sensors "
            "at the ankles where they were worn, fused by a Kalman filter; knees and hips follow from the person's "
            f"segment lengths. Positions rest on the marker in {by_stage[0]:.0f} %, on the depth image in "
            f"{by_stage[1]:.0f} % and on the inertial sensor alone in {by_stage[2]:.0f} % of the samples; "
            f"{_sigmas_text(feet)}.",
        ]
    text = " ".join(texts)
    citation = f"The RHOT developers. RHOT: an open-source tracker of hands, objects and feet, version {__version__}."
    return f"<h2>For the methods section</h2><blockquote>{escape(text)}</blockquote><p>Cite: {escape(citation)}</p>"


def _sigmas_text(figures: Sequence[FingerFigures | FootFigures]) -> str:
    median, p95 = (_MM * float(np.median([each.sigma_m[part] for each in figures])) for part in (0, 1))
    return f"their estimated standard deviation was {median:.1f} mm (median; 95th percentile {p95:.1f} mm)"


def _cameras_text(rig: Rig) -> str:
    kinds = [f"{camera.width}x{camera.height} at {camera.rate_hz:g} Hz" for camera in rig.config.cameras.values()]
    if len(set(kinds)) == 1:
        return f"{len(kinds)} unsynchronised cameras ({kinds[0]})"
    return f"unsynchronised cameras ({', '.join(kinds)})" if kinds else "unsynchronised cameras"


def _percent(share: float) -> str:
    return "–" if np.isnan(share) else f"{100 * share:.1f} %"


def _number(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.1f}"


@click.command()
@click.argument("files", metavar="RECORDING...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", "out_path", type=click.Path(path_type=Path, dir_okay=False), required=True, help="HTML file.")
@rig_folder_option("Rig folder, for recordings without one.")
def report(files: tuple[Path, ...], out_path: Path, rig_path: Path | None) -> int:
    """Say on one page whether trials can be used, and why.

    RECORDING is an MCAP file of `rhot record` or `rhot process`, or JSON Lines. The page, one file that needs no
    network, shows for each trial a traffic light with its reasons, coverage, gaps, standard deviations, speed and range
    of motion of each finger and foot, lost frames, clocks, drift of the cameras since calibration, jitter where the
    hand rested, and pictures of the least certain moments where `rhot record --frames` kept them. Of several trials a
    table comes first. A paragraph for a paper's methods section ends it.

    \b
    rhot report grasp.mcap --out report.html
    rhot report trials/*.mcap --out trials.html

    The exit code is 1 if a trial cannot be used.
    """
    rig = None if rig_path is None else load_rig(rig_path)
    console = Console(stderr=True, soft_wrap=True)
    trials = []
    for number, file in enumerate(files, 1):
        with console.status(f"reading {file.name}, {number} of {len(files)}"):
            trials.append(trial_of(file, rig))
    write_text_atomic(out_path, report_html(trials))
    worst = max((trial.verdict.exit_code for trial in trials), default=0)
    good = sum(trial.verdict.judged and trial.verdict.level == "good" for trial in trials)
    said = trials[0].verdict.text if len(trials) == 1 else f"{good} of {len(trials)} good"
    console.print(f"{out_path}: {said}", markup=False)
    return worst
