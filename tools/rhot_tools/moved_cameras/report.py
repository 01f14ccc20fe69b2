"""What `rhot evaluate calibration` tells: for people, and as JSON."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rhot.report.tables import figures_table
from rhot.rig import CamerasFile
from rhot.text import as_argument
from rhot.trial.calibration_check import AXES, CalibrationReport, CameraRotation, PairReport
from rhot.trial.epipolar_residuals import Tracks

_COLORS: Final = {"good": "green", "drifting": "yellow", "bumped": "red"}
_DEPTH_NOTE: Final = (
    "A turn that moves points along their epipolar lines (yaw, for cameras side by side) changes depth and leaves no "
    "trace here; only `rhot calibrate cameras` finds it."
)
_CLOCK_FROM_NS: Final = 1_000_000_000_000_000_000
"""Times above are of the calendar (2001 on); smaller ones of a recording's own clock."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What the cameras saw.

    Attributes:
        tracks: of each camera.
        periods_s: time between two frames of each camera.
        start_ns: time from which the tracks' seconds count; None = they are numbers of pictures.
    """

    tracks: Tracks
    periods_s: Mapping[str, float]
    start_ns: int | None

    def moment(self, t_s: float) -> str:
        """Return a moment of the tracks for people."""
        if self.start_ns is None:
            return f"picture {t_s:.0f}"
        if self.start_ns < _CLOCK_FROM_NS:
            return f"{t_s:.0f} s"
        moment = dt.datetime.fromtimestamp((self.start_ns + t_s * 1e9) * 1e-9, dt.UTC)
        return f"{t_s:.0f} s ({moment:%Y-%m-%d %H:%M:%S} UTC)"

    def moment_json(self, t_s: float) -> dict[str, int]:
        """Return a moment of the tracks as a field."""
        if self.start_ns is None:
            return {"picture": round(t_s)}
        return {"t_ns": self.start_ns + round(t_s * 1e9)}


def print_report(report: CalibrationReport, file: CamerasFile, seen: Seen, rig_path: Path) -> None:
    """Print the verdict with everything it rests on, to standard output."""
    console = Console(soft_wrap=True, markup=False, highlight=False)
    console.print(_pairs_table(report))
    console.print("Pixels off the epipolar line; shift: what a turn of a camera would cause, without the noise.\n")
    for pair in report.pairs:
        for line in _pair_lines(pair, seen):
            console.print(line)
    for name, number in report.skipped.items():
        console.print(f"{name}: only {number} common observations, not judged")
    if report.moved and report.moved_rotation is not None:
        console.print(f"camera {report.moved} has moved: {_rotation_text(report.moved_rotation)}", style="bold")
    elif report.verdict != "good":
        console.print("Which camera moved cannot be told from these views.")
    console.print(_DEPTH_NOTE)
    verdict = {
        "good": "the calibration holds",
        "drifting": "the cameras have moved a little; calibrate again when it suits",
        "bumped": "the cameras have moved since they were calibrated",
    }[report.verdict]
    dated = f" (calibrated {file.date})" if file.date else ""
    console.print(f"{report.verdict}: {verdict}{dated}", style=f"bold {_COLORS[report.verdict]}")
    if report.verdict != "good":
        console.print(f"→ rhot calibrate cameras RECORDING --rig {as_argument(rig_path)} --board 9x6 --square-mm 25")


def _pairs_table(report: CalibrationReport) -> Table:
    table = figures_table("pair", "seen", "median", "RMS", "p95", "p95 then", "shift", "limit")
    table.add_column("verdict")
    for pair in report.pairs:
        calibrated = "–" if pair.calibrated_p95_px is None else f"{pair.calibrated_p95_px:.2f}"
        table.add_row(
            f"{pair.first}-{pair.second}",
            str(pair.observations),
            f"{pair.median_px:+.2f}",
            f"{pair.rms_px:.2f}",
            f"{pair.p95_px:.2f}",
            calibrated,
            f"{pair.systematic_px:.2f}",
            f"{pair.limit_px:.2f}",
            Text(pair.verdict, style=_COLORS[pair.verdict]),
        )
    return table


def _pair_lines(pair: PairReport, seen: Seen) -> Iterator[str]:
    a, b, c = pair.line
    sd_a, sd_b, sd_c = pair.line_sd
    yield f"{pair.first}-{pair.second}: {pair.second} against {pair.first} turned by {_rotation_text(pair.rotation)}"
    yield (
        f"  residual = {a:+.2f} ± {sd_a:.2f} px  {1e3 * b:+.2f} ± {1e3 * sd_b:.2f} px per 1000 px to the right  "
        f"{1e3 * c:+.2f} ± {1e3 * sd_c:.2f} px per 1000 px down; {pair.noise_px:.2f} px of noise"
    )
    early, late = pair.thirds_px
    yield f"  median {early:+.2f} px in the first third, {late:+.2f} px in the last"
    if pair.change is not None and pair.change.step_px > 0.5 * pair.limit_px:
        how = "moved suddenly" if pair.change.sudden else "kept moving, most"
        yield f"  {how} at {seen.moment(pair.change.t_s)}: {pair.change.step_px:.2f} px between before and after"


def _rotation_text(rotation: CameraRotation) -> str:
    parts = []
    for name, value, sd, observed in zip(AXES, rotation.degrees, rotation.sd_degrees, rotation.observed, strict=True):
        parts.append(f"{name} {value:+.2f}° ± {sd:.2f}°" if observed else f"{name} not observable")
    return ", ".join(parts)


def report_json(report: CalibrationReport, file: CamerasFile, seen: Seen) -> dict[str, Any]:
    """Return the report as plain values."""
    moved = report.moved_rotation
    return {
        "verdict": report.verdict,
        "calibrated": file.date,
        "moved": None if moved is None else {"camera": report.moved, **_rotation_json(moved)},
        "pairs": {f"{pair.first}-{pair.second}": _pair_json(pair, seen) for pair in report.pairs},
        "skipped": dict(report.skipped),
    }


def _rotation_json(rotation: CameraRotation) -> dict[str, Any]:
    rows = zip(AXES, rotation.degrees.tolist(), rotation.sd_degrees.tolist(), rotation.observed, strict=True)
    return {"turn_deg": {name: {"value": value, "sd": sd, "observable": seen} for name, value, sd, seen in rows}}


def _pair_json(pair: PairReport, seen: Seen) -> dict[str, Any]:
    change = pair.change
    return {
        "verdict": pair.verdict,
        "observations": pair.observations,
        "median_px": pair.median_px,
        "rms_px": pair.rms_px,
        "p95_px": pair.p95_px,
        "calibrated_p95_px": pair.calibrated_p95_px,
        "systematic_px": pair.systematic_px,
        "noise_px": pair.noise_px,
        "limit_px": pair.limit_px,
        "line": {
            "values": dict(zip(("a_px", "b", "c"), pair.line.tolist(), strict=True)),
            "sd": dict(zip(("a_px", "b", "c"), pair.line_sd.tolist(), strict=True)),
        },
        **_rotation_json(pair.rotation),
        "first_third_px": pair.thirds_px[0],
        "last_third_px": pair.thirds_px[1],
        "change": None
        if change is None
        else {**seen.moment_json(change.t_s), "step_px": change.step_px, "sudden": change.sudden},
    }
