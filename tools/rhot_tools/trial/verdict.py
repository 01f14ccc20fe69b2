"""The verdict on a trial: can its hands and feet be used, and if not, why.

It is made from the messages alone, so that `rhot process`, `rhot record` and `rhot export` say the same of the same
trial. What it looks at: frames that never came, how much of what two cameras saw became a measured point, whether the
hand fits its markers, impossible jumps, whether the cameras stand as they were calibrated, and what the services
themselves complained of.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final, Literal

import numpy as np
from rich.console import Console
from rich.text import Text

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.messages import FootPose, HandPose, MarkerFrame, Message, PointSet, ServiceStatus
from rhot.recording.messages import RecordedMessages
from rhot.report.html import figures_table
from rhot.rig import Rig
from rhot.rig.cameras import camera_models
from rhot.text import printable
from rhot_tools.trial.calibration_check import CalibrationReport, judge_calibration
from rhot_tools.trial.epipolar_residuals import TrackGatherer, are_swapped

Level = Literal["good", "doubtful", "not usable"]
_LEVELS: Final = ("good", "doubtful", "not usable")
_COLORS: Final = {"good": "green", "doubtful": "yellow", "not usable": "red"}

STAGES: Final = ("marker", "depth", "inertial", "lost")
"""What a foot's position rests on, the best first."""
LEAST_FRAMES: Final = 60
"""Marker frames, or poses of feet, below which a trial is too short for a verdict: half a second of two cameras, or of
two feet, at 60 Hz. Chosen.
"""
_JUMP_M_S: Final = 8.0
"""Speed of a measured point between two samples; a fingertip in a fast tap reaches 3 m/s."""
_MOMENT_NS: Final = 100_000_000
_TOGETHER: Final = 0.5
"""Share of these moments that a camera has in common with another one; below it, the times of one are wrong."""
_HARDLY: Final = 0.02
"""Share of a camera's frames below which a marker counts as unseen."""
_STEP_S: Final = 0.1
_MANY_LOST: Final = 0.2
"""Share of a camera's frames whose loss is told: motion between them is interpolated. Chosen."""
_TOO_SLOW: Final = "its machine is too slow or busy (`rhot status`), or the network loses them; try a lower rate_hz"
_PROBLEM_SHARE: Final = 0.2
"""A complaint of a service counts if it stood in so many of its statuses: many pass while a rig starts."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with a trial, as a sentence."""

    level: Level
    text: str


@dataclass(frozen=True, slots=True)
class TrialVerdict:
    """The verdict.

    Attributes:
        figures: name, value with its unit, and what it means, for a table.
        findings: what is wrong, causes before what follows from them; empty = nothing.
        judged: whether there was enough to judge by.
    """

    figures: tuple[tuple[str, str, str], ...]
    findings: tuple[Finding, ...]
    judged: bool = True

    @property
    def level(self) -> Level:
        """The worst of all findings."""
        return max((finding.level for finding in self.findings), key=_LEVELS.index, default="good")

    @property
    def text(self) -> str:
        """The verdict in words."""
        return self.level if self.judged else "not judged: too short, or neither hands nor feet"

    @property
    def exit_code(self) -> int:
        """1 for a trial that cannot be used."""
        return 1 if self.level == "not usable" else 0

    def print(self, console: Console) -> None:
        """Print figures, findings and the verdict."""
        if self.judged:
            table = figures_table("trial", "value")
            table.add_column("")
            for row in self.figures:
                table.add_row(*row)
            console.print(table)
        for finding in self.findings:
            console.print(Text(f"{finding.level}: {printable(finding.text, 500)}", style=_COLORS[finding.level]))
        color = _COLORS[self.level] if self.judged else ""
        console.print(Text(f"verdict: {self.text}", style=f"bold {color}"))


@dataclass(slots=True)
class _Hand:
    """What is gathered of one hand; times in nanoseconds, residuals in metres."""

    poses: int = 0
    measured_ns: list[int] = field(default_factory=list)
    residuals_m: list[float] = field(default_factory=list)


@dataclass(slots=True)
class _Foot:
    """What is gathered of one foot: its poses by stage, and when it was measured, nanoseconds."""

    stages: Counter[str] = field(default_factory=Counter)
    measured_ns: list[int] = field(default_factory=list)


class TrialJudge:
    """Gathers the messages of one trial.

    Args:
        rig: that the trial was recorded with; without one the cameras are not judged, and fingers are taken to be
            named like their markers.
    """

    def __init__(self, rig: Rig | None = None) -> None:
        self._rig = rig
        self._cameras = {} if rig is None else camera_models(rig.cameras)
        self._tracks = TrackGatherer(self._cameras)
        self._seen: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self._frames: Counter[str] = Counter()
        self._numbers: dict[str, int] = {}
        self._lost: Counter[str] = Counter()
        self._moments: defaultdict[str, set[int]] = defaultdict(set)
        self._measured: Counter[str] = Counter()
        self._sets = 0
        self._span_ns = [1 << 63, 0]
        self._points: PointSet | None = None
        self._hands: dict[str, _Hand] = {}
        self._feet: dict[str, _Foot] = {}
        self._last: dict[str, tuple[int, FloatArray]] = {}
        self._steps = self._jumps = 0
        self._largest_jump_m = 0.0
        self._statuses: Counter[str] = Counter()
        self._problems: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self._finger_of = {} if rig is None else _fingers_by_marker(rig)

    def add(self, message: Message) -> None:
        """Add a message, in the order of the recording."""
        if isinstance(message, MarkerFrame | FootPose):
            self._span_ns = [min(self._span_ns[0], message.t_ns), max(self._span_ns[1], message.t_ns)]
        if isinstance(message, MarkerFrame):
            self._frames[message.camera] += 1
            # A camera that starts again counts from 0.
            self._lost[message.camera] += max(message.frame - self._numbers.get(message.camera, message.frame) - 1, 0)
            self._numbers[message.camera] = message.frame
            self._moments[message.camera].add(message.t_ns // _MOMENT_NS)
            self._seen[message.camera].update(message.markers.keys())
            self._tracks.add([message])
        elif isinstance(message, PointSet):
            self._add_points(message)
        elif isinstance(message, HandPose):
            self._add_hand(message)
        elif isinstance(message, FootPose):
            foot = self._feet.setdefault(message.side, _Foot())
            foot.stages[message.stage] += 1
            if message.state == "measured":
                foot.measured_ns.append(message.t_ns)
        elif isinstance(message, ServiceStatus) and message.state == "running":
            self._statuses[message.service] += 1
            if message.problem:
                self._problems[message.service][message.problem] += 1

    def add_all(self, messages: Iterable[tuple[str, Message]]) -> None:
        """Add the messages of a recording."""
        for _, message in messages:
            self.add(message)

    def _add_points(self, points: PointSet) -> None:
        self._points = points
        self._sets += 1
        for name, point in points.points.items():
            if point.state != "measured":
                self._last.pop(name, None)
                continue
            self._measured[name] += 1
            position = np.array(point.position)
            before_ns, before = self._last.get(name, (0, position))
            elapsed_s = (points.t_ns - before_ns) * 1e-9
            if 0.0 < elapsed_s <= _STEP_S:
                step_m = float(np.linalg.norm(position - before))
                self._steps += 1
                # Shorter steps are noise, however soon after one another the samples are.
                if step_m > 0.02 and step_m > _JUMP_M_S * elapsed_s:
                    self._jumps += 1
                    self._largest_jump_m = max(self._largest_jump_m, step_m)
            self._last[name] = points.t_ns, position

    def _add_hand(self, hand: HandPose) -> None:
        kept = self._hands.setdefault(hand.side, _Hand())
        kept.poses += 1
        if hand.state == "measured":
            kept.measured_ns.append(hand.t_ns)
        points = self._points
        if points is None or abs(points.t_ns - hand.t_ns) > 1_000_000:
            return
        markers = self._finger_of.get(hand.side, {})
        misses = [
            miss_m
            for finger, miss_m in hand.residual.items()
            if (tip := points.points.get(markers.get(finger, finger))) is not None and tip.state == "measured"
        ]
        if len(misses) > 1:
            kept.residuals_m.append(sum(misses) / len(misses))

    @property
    def lost_frames(self) -> dict[str, tuple[int, int]]:
        """Camera to frames that were never looked at, and all that it took."""
        return {camera: (self._lost[camera], n + self._lost[camera]) for camera, n in sorted(self._frames.items())}

    def verdict(self, problems: Mapping[str, str] | None = None, lost: Sequence[str] = ()) -> TrialVerdict:
        """Return the verdict on what was added.

        Args:
            problems: of the cores that tracked it, by their names.
            lost: what could not be read of its files.
        """
        missing = tuple(Finding("doubtful", text) for text in lost)
        poses = {f"{side} foot": foot.stages.total() for side, foot in self._feet.items()}
        frames = sum(self._frames.values())
        if frames < LEAST_FRAMES and sum(poses.values()) < LEAST_FRAMES:
            if (taken := sum(taken for _, taken in self.lost_frames.values())) < LEAST_FRAMES:
                return TrialVerdict((), missing, judged=False)
            empty = Finding("not usable", f"only {frames} of {taken} frames were looked at; {_TOO_SLOW}")
            return TrialVerdict((), (*missing, empty))
        seconds = 1e-9 * (self._span_ns[1] - self._span_ns[0])
        counted = [("frames", self._frames)] * bool(self._frames) + [("poses", poses)] * bool(poses)
        each = (f"{what}: {', '.join(f'{name} {n}' for name, n in sorted(of.items()))}" for what, of in counted)
        figures = [("length", f"{seconds:.1f} s", "; ".join(each))]
        feet = self._judge_feet(figures)
        stated = self._stated(problems or {})
        if not self._frames:
            told = [Finding("not usable", text) for texts in stated.values() for text in texts]
            return TrialVerdict(tuple(figures), (*missing, *told, *feet))
        times = self._judge_times()
        slow = self._judge_lost(figures)
        coverage = self._judge_coverage(figures)
        hands = self._judge_hands(figures)
        jumps = self._judge_jumps(figures)
        cameras = self._judge_cameras(figures)
        # Fusion complains of the cameras, and they are judged here over the whole trial; ik knows best why a hand
        # does not fit.
        if cameras:
            stated.pop("fusion", None)
        if "ik" in stated or times:
            hands = []
        if times:
            coverage = []
        told = [Finding("not usable", text) for texts in stated.values() for text in texts]
        told += self._unseen() if hands or coverage else []
        # Causes before what follows from them.
        return TrialVerdict(
            tuple(figures), (*missing, *times, *slow, *cameras, *told, *hands, *jumps, *coverage, *feet)
        )

    def _stated(self, problems: Mapping[str, str]) -> dict[str, list[str]]:
        """Return what the services complained of for long, by service."""
        found = {service: [text] for service, text in problems.items() if text}
        for service, counts in self._problems.items():
            often = [text for text, count in counts.items() if count > _PROBLEM_SHARE * self._statuses[service]]
            if often:
                found.setdefault(service, []).extend(often)
        return found

    def _judge_times(self) -> list[Finding]:
        """Judge whether each camera looked at the same time as some other one."""
        for name, own in sorted(self._moments.items()):
            others = [other for camera, other in self._moments.items() if camera != name]
            share = max((len(own & other) / min(len(own), len(other)) for other in others), default=1.0)
            if share < _TOGETHER:
                text = (
                    f"{name} looked at the same time as another camera for only {100 * share:.0f} % of the trial: the "
                    "times of one are wrong (its clock, or its timestamps.csv)"
                )
                return [Finding("not usable", text)]
        return []

    def _judge_lost(self, figures: list[tuple[str, str, str]]) -> list[Finding]:
        """Judge how many frames were never looked at."""
        findings = []
        for camera, (lost, taken) in self.lost_frames.items():
            figures.append((f"{camera}, frames lost", f"{100 * lost / taken:.1f} %", f"{lost} of {taken}"))
            if lost > _MANY_LOST * taken:
                told = f"{100 * lost / taken:.0f} % of the frames of {camera} were not looked at; {_TOO_SLOW}"
                findings.append(Finding("doubtful", told))
        return findings

    def _unseen(self) -> list[Finding]:
        """Return which of the rig's markers hardly any picture shows, as causes of what else is wrong."""
        names = () if self._rig is None else tuple(self._rig.config.markers)
        missing = {
            camera: [name for name in names if self._seen[camera][name] < _HARDLY * frames]
            for camera, frames in sorted(self._frames.items())
        }
        blind = [camera for camera, gone in missing.items() if len(gone) == len(names)]
        as_then = "as when colours were calibrated? `rhot calibrate colors` again"
        texts = [
            f"{camera} sees no marker at all: is its lens free, and its picture as bright {as_then}" for camera in blind
        ]
        seeing = [set(gone) for camera, gone in missing.items() if camera not in blind]
        if seeing and (gone := [name for name in names if all(name in each for each in seeing)]):
            texts.append(f"no camera sees {', '.join(gone)}: painted and lit {as_then}")
        return [Finding("doubtful", text) for text in texts]

    def _judge_coverage(self, figures: list[tuple[str, str, str]]) -> list[Finding]:
        """Judge how much of what two cameras saw became a measured point."""
        names = {name for seen in self._seen.values() for name in seen}
        shares = {}
        for name in names:
            by_camera = sorted((seen[name] / self._frames[camera] for camera, seen in self._seen.items()), reverse=True)
            shares[name] = by_camera[1] if len(by_camera) > 1 else 0.0
        visible = sum(shares.values())
        if not visible:
            return [Finding("not usable", "no two cameras saw the same marker: are colours calibrated, and both on?")]
        measured = sum(self._measured[name] / max(self._sets, 1) for name in names)
        coverage = min(measured / visible, 1.0)
        figures.append(("in view", f"{100 * visible / len(names):.1f} %", "of markers, by two cameras, on average"))
        figures.append(("measured", f"{100 * coverage:.1f} %", "of what two cameras saw"))
        # Share of what two cameras saw that became no measured point, beyond which a trial is doubtful, and
        # not usable. Rendered and simulated sequences have 0 to 0.1; swapped or moved cameras 0.9 to 1.
        level = _worse(1.0 - coverage, (0.2, 0.5))
        if level == "good":
            return []
        return [Finding(level, f"only {100 * coverage:.0f} % of what two cameras saw became a measured point")]

    def _judge_hands(self, figures: list[tuple[str, str, str]]) -> list[Finding]:
        """Judge whether the hands fit their markers, and whether there are any."""
        findings = []
        for side, hand in sorted(self._hands.items()):
            share = len(hand.measured_ns) / hand.poses
            about = f"of {hand.poses} poses; longest gap {_longest_gap_s(hand.measured_ns):.2f} s"
            figures.append((f"{side} hand, measured", f"{100 * share:.1f} %", about))
            if not hand.residuals_m:
                continue
            fit_m, p95_m = (float(np.percentile(hand.residuals_m, share)) for share in (50, 95))
            about = f"median residual of fingertips; 95th percentile {1e3 * p95_m:.1f} mm"
            figures.append((f"{side} hand, fit", f"{1e3 * fit_m:.1f} mm", about))
            # Median residual of the fingertips that two cameras see. Hands that fit leave 0.5 to 2 mm,
            # the wrong side 28 to 38.
            level = _worse(fit_m, (0.006, 0.015))
            if level != "good":
                told = f"the {side} hand does not fit its markers: {1e3 * fit_m:.0f} mm, 1 to 2 are usual"
                findings.append(Finding(level, told))
        if self._rig is not None and self._rig.config.sides and not self._hands:
            told = "no hand was found: are the cameras named as in rig.toml, and colours calibrated?"
            findings.append(Finding("not usable", told))
        return findings

    def _judge_feet(self, figures: list[tuple[str, str, str]]) -> list[Finding]:
        """Judge whether something measured the feet."""
        findings = []
        for side, foot in sorted(self._feet.items()):
            poses = foot.stages.total()
            by_stage = ", ".join(f"{stage} {100 * foot.stages[stage] / poses:.0f} %" for stage in STAGES)
            about = f"of {poses} poses; longest gap {_longest_gap_s(foot.measured_ns):.2f} s; {by_stage}"
            figures.append((f"{side} foot, measured", f"{100 * len(foot.measured_ns) / poses:.1f} %", about))
            # Share of poses that hold the last position, because neither camera nor sensor says anything.
            lost = foot.stages["lost"] / poses
            level = _worse(lost, (0.2, 0.5))
            if level != "good":
                told = f"nothing measured the {side} foot in {100 * lost:.0f} % of its poses: was its marker in view?"
                findings.append(Finding(level, told))
        return findings

    def _judge_jumps(self, figures: list[tuple[str, str, str]]) -> list[Finding]:
        share = self._jumps / self._steps if self._steps else 0.0
        about = f"of {self._steps} steps of measured points, over {_JUMP_M_S:g} m/s"
        figures.append(("jumps", str(self._jumps), about))
        # Share of steps that are jumps.
        level = _worse(share, (0.001, 0.01))
        if level == "good":
            return []
        return [
            Finding(level, f"measured points jump {self._jumps} times, by up to {1e3 * self._largest_jump_m:.0f} mm")
        ]

    def _judge_cameras(self, figures: list[tuple[str, str, str]]) -> list[Finding]:
        """Judge whether the cameras stand as they were calibrated, and are not swapped."""
        rig = self._rig
        if rig is None or len(self._cameras) < 2:
            return []
        tracks, periods_s = self._tracks.tracks(), self._tracks.periods_s()
        findings = [
            Finding(
                "not usable",
                f"cameras {first} and {second} are swapped: exchange the folders (or the plugs), or their names in "
                "rig.toml",
            )
            for first, second in combinations(self._cameras, 2)
            if are_swapped(first, second, tracks, self._cameras, periods_s)
        ]
        if not rig.calibrated:
            figures.append(("cameras", "–", "not calibrated: taken as parallel, as rig.toml places them"))
            return findings
        try:
            report = judge_calibration(tracks, self._cameras, periods_s, rig.quality)
        except CalibrationError:
            # Too few common views; the coverage says so.
            return findings
        shift_px = max(pair.systematic_px for pair in report.pairs)
        figures.append(("epipolar shift", f"{shift_px:.2f} px", f"since calibration; cameras: {report.verdict}"))
        if report.verdict != "good" and not findings:
            findings.append(Finding(_moved_level(report), _moved_text(report, shift_px)))
        return findings


def _moved_level(report: CalibrationReport) -> Level:
    # Times the limit of a pair's systematic epipolar residual beyond which a trial is not usable.
    far = any(pair.systematic_px > 4.0 * pair.limit_px for pair in report.pairs)
    return "not usable" if far else "doubtful"


def _moved_text(report: CalibrationReport, shift_px: float) -> str:
    which = f"camera {report.moved} has" if report.moved else "a camera has"
    return (
        f"{which} moved since the calibration: views are {shift_px:.1f} px off their epipolar lines; "
        "`rhot calibrate cameras` again (`rhot evaluate calibration` says more)"
    )


def _longest_gap_s(measured_ns: Sequence[int]) -> float:
    """Return the longest time between two measured poses in a row, seconds."""
    return 1e-9 * float(np.diff(measured_ns).max()) if len(measured_ns) > 1 else 0.0


def _worse(value: float, limits: tuple[float, float]) -> Level:
    """Return the level of a figure that is the worse the larger it is."""
    doubtful, unusable = limits
    return "not usable" if value > unusable else "doubtful" if value > doubtful else "good"


def _fingers_by_marker(rig: Rig) -> dict[str, dict[str, str]]:
    """Return the marker of each fingertip by hand and finger."""
    found: dict[str, dict[str, str]] = {}
    for name, marker in rig.config.markers.items():
        if marker.joint.endswith("_tip"):
            found.setdefault(marker.hand, {})[marker.joint.removesuffix("_tip")] = name
    return found


def judged_recording(parts: Sequence[RecordedMessages], rig: Rig | None) -> TrialVerdict:
    """Return the verdict on a recording, in parts."""
    judge = TrialJudge(rig)
    for part in parts:
        judge.add_all(part)
    return judge.verdict(lost=[text for part in parts for text in part.lost])
