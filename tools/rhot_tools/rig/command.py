"""`rhot evaluate rig`: one's own rig measured as the 2018 thesis measured its own, as one report."""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final

import click
import numpy as np
from rich.console import Console

from rhot.anatomy.markers import own_paints
from rhot.arrays import FloatArray, ImageArray
from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import CalibrationError, ConfigError, RhotError
from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame, Point
from rhot.offline import marker_frames, rig_timing, track
from rhot.recording import MarkerTrack, load_recording
from rhot.recording.messages import RecordedMessages
from rhot.rig import BusConfig, Rig, load_rig
from rhot.rig.cameras import camera_model
from rhot.rig.colors import load_colors
from rhot.rig.folder import write_text_atomic
from rhot_capture.detection.color_table import camera_tables
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.sources.recorded import read_pictures
from rhot_capture.timing import row_time_ns
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.rig.schedule import FrameSchedule
from rhot_tools.measures.output import html_report, json_option, page_option, show
from rhot_tools.measures.rows import Row, Section, check_output
from rhot_tools.recordings.beside import pictures_beside
from rhot_tools.rig.depth import depth_plot, depth_sections
from rhot_tools.rig.grasps import grasps
from rhot_tools.rig.heard import Heard, depth_rows, listen, pictures_of
from rhot_tools.rig.jitter import jitter_plots, jitter_sections, still_jitter
from rhot_tools.rig.latency import latencies_of, latency_sections, thread_section
from rhot_tools.rig.statistics import figure_row, mean, root_mean_square

# What is true of a simulated rig: its cameras, when they exposed their frames, and its focal length times baseline.


@dataclass(frozen=True, slots=True)
class SimulatedTruth:
    """What is true of a simulated rig beside what `rhot/truth` says.

    Attributes:
        cameras: by name, as they truly stand.
        schedules: by name, when their frames are exposed.
        start_ns: rig time of the world's start; 0 = not known.
        rig: whose configuration the cameras have.
    """

    cameras: Mapping[str, CameraModel]
    schedules: Mapping[str, FrameSchedule]
    start_ns: int
    rig: Rig

    def exposed_ns(self, frame: MarkerFrame) -> int | None:
        """Return when a frame's middle row was exposed, rig clock; None where the world's start is not known."""
        if not self.start_ns or frame.camera not in self.schedules:
            return None
        config = self.rig.config.cameras[frame.camera]
        first_ns = self.start_ns + round(1e9 * self.schedules[frame.camera].frame(frame.frame).t_first_row_s)
        middle = 0.5 * (config.height - 1)
        return row_time_ns(first_ns, middle, config.height, config.exposure_s, config.readout_s)

    @property
    def fb(self) -> float:
        """Focal length of the first camera's calibration times the true baseline, pixel metres.

        The second camera is turned into the first one's orientation, so its own does not matter.
        """
        first, second = list(self.cameras.values())[:2]
        K = camera_model(next(iter(self.rig.cameras.values()))).K
        return float(K[0, 0]) * abs(float(first.to_camera(second.center[None])[0, 0]))


def simulated_truth(rig: Rig, heard: Heard) -> SimulatedTruth | None:
    """Return what is true of the rig that was heard; None where it is a real one."""
    if not heard.truth or len(rig.config.cameras) < 2:
        return None
    try:
        cameras = true_cameras(rig)
    except (CalibrationError, ConfigError):
        return None
    schedules = {
        name: FrameSchedule(name, index, config, rig.config.sim)
        for index, (name, config) in enumerate(rig.config.cameras.items())
    }
    return SimulatedTruth(cameras, schedules, heard.start_ns, rig)


# One figure to quote: two markers a known distance apart, moved through the volume, and how far off that distance is.
#
# This is the sphere-spacing error of VDI/VDE 2634 for a pair that moves, as ASTM E3064 measures motion capture with a
# rod: it needs no second tracker and contains calibration, clocks, blur and triangulation, but nothing that shifts both
# markers alike.

_MM = 1e3
_LEAST = 100


@dataclass(frozen=True, slots=True)
class Distances:
    """A pair of markers over the moments at which both were measured.

    Attributes:
        error_m: (N,) measured minus true distance, metres.
        sigma_m: (N,) the deviation that fusion states for it, metres; NaN where it states none.
        middle_m: (N, 3) middles of the pair, metres, rig frame.
        share: of the moments at which points were published.
    """

    error_m: FloatArray
    sigma_m: FloatArray
    middle_m: FloatArray
    share: float


def distances(heard: Heard, pair: tuple[str, str], length_m: float | None) -> Distances:
    """Return how far off the distance of two markers was.

    Args:
        heard: while the pair was moved.
        pair: names of the markers.
        length_m: true distance; None = what a simulated rig tells of each moment.

    Raises:
        ConfigError: no true distance is known, or the pair was measured too seldom.
    """
    first, second = pair
    seen = [
        (points.t_ns, points.points[first], points.points[second])
        for points in heard.points
        if all(name in points.points and points.points[name].state == "measured" for name in pair)
    ]
    if len(seen) < _LEAST:
        raise ConfigError(
            f"{first} and {second} were measured together {len(seen)} times, {_LEAST} are the least; are both in the "
            "pictures of two cameras (`rhot status`, or the page's Pictures)?"
        )
    t_ns = np.array([each[0] for each in seen], dtype=np.int64)
    one = np.array([each.position for _, each, _ in seen])
    other = np.array([each.position for _, _, each in seen])
    if length_m is None:
        true_m = _true_distances(heard, pair, t_ns)
        if true_m is None:
            raise ConfigError("--length-mm is missing: measure between the middles of the two markers with a caliper")
    else:
        true_m = np.full(len(t_ns), length_m)
    apart = one - other
    long = np.linalg.norm(apart, axis=1)
    along = apart / np.maximum(long, 1e-9)[:, None]
    variance = np.array([_along(u, a) + _along(u, b) for u, (_, a, b) in zip(along, seen, strict=True)])
    known = np.isfinite(true_m)
    return Distances(
        (long - true_m)[known], np.sqrt(variance)[known], (0.5 * (one + other))[known], len(seen) / len(heard.points)
    )


def distance_section(found: Distances, pair: tuple[str, str]) -> Section:
    """Return the figure to quote and what belongs to it: over which volume, how often seen, how honest the sigma."""
    low, high = np.percentile(found.middle_m, (2.5, 97.5), axis=0)
    volume = " x ".join(f"{_MM * side:.0f}" for side in high - low)
    off = np.abs(found.error_m)
    rows = [
        figure_row(
            "error of the distance, RMS",
            root_mean_square(found.error_m).scaled(_MM),
            "mm",
            note=f"to quote; in a volume of {volume} mm (x, y, z of the rig)",
        ),
        figure_row("error of the distance, mean", mean(found.error_m).scaled(_MM), "mm", note="a scale or a bias"),
        Row("error of the distance, p95", _MM * float(np.percentile(off, 95.0)), "mm"),
        Row("error of the distance, largest", _MM * float(off.max()), "mm"),
        Row("both markers measured", 100.0 * found.share, "%", note="of the moments at which points were published"),
    ]
    ratios = found.error_m / found.sigma_m
    if np.isfinite(ratios).any():
        rows.append(
            Row(
                "error over stated sigma, RMS",
                float(np.sqrt(np.nanmean(ratios**2))),
                note="1 = fusion's uncertainty is honest; less is cautious",
            )
        )
    return Section(f"Distance of {pair[0]} and {pair[1]}", tuple(rows))


def _along(direction: FloatArray, point: Point) -> float:
    """Return a point's variance along a direction (3,), square metres; NaN where it states no covariance."""
    if point.covariance is None:
        return float("nan")
    xx, xy, xz, yy, yz, zz = point.covariance
    return float(direction @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ direction)


def _true_distances(
    heard: Heard, pair: tuple[str, str], t_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
) -> FloatArray | None:
    """Return the true distance (N,), metres, at times; NaN beyond what the simulator told, None where it tells none."""
    known: Mapping[int, float] = {
        each.t_ns: float(np.linalg.norm(np.subtract(each.points[pair[0]], each.points[pair[1]])))
        for each in heard.truth
        if all(name in each.points for name in pair)
    }
    if len(known) < 2:
        return None
    times = np.array(sorted(known), dtype=np.int64)
    true = np.array([known[t] for t in times.tolist()])
    since, wanted = (times - times[0]).astype(np.float64), (t_ns - times[0]).astype(np.float64)
    found: FloatArray = np.interp(wanted, since, true, np.nan, np.nan)
    return found


PARTS: Final = ("still", "distance", "latency", "depth", "grasp")
_PICTURES: Final = 12
_LOOK_S: Final = 3.0
"""So long is it listened whether a simulated rig tells its truth: it does so sixty times a second."""
_DISTANCES_CM: Final = "30,35,40,45,50,55,60,65,70,75,80,85,90"
_SAY: Final = {
    "still": "hold the hand still, on something, all markers in view",
    "distance": "move two markers that are a known distance apart through the whole volume, slowly and fast",
    "latency": "let the rig run",
    "depth": "move the hand slowly towards the cameras and away",
    "grasp": "take hold of the object, carry it, put it down, a few times",
}


@click.command()
@click.argument("recording_path", metavar="[RECORDING]", required=False, type=click.Path(path_type=Path, exists=True))
@click.option(
    "--live", "live", multiple=True, type=click.Choice(PARTS), help="Measure this on the running rig. May be repeated."
)
@click.option(
    "--seconds",
    type=FiniteRange(3.0, 3600.0),
    default=60.0,
    show_default=True,
    help="Live: how long each part listens.",
)
@click.option("--marker", default="index", show_default=True, help="Depth: the marker that is held before the cameras.")
@click.option("--distances", default=_DISTANCES_CM, show_default=True, help="Depth: where it is held, cm.")
@click.option(
    "--ruler-mm",
    type=FiniteRange(0.0, 100.0),
    default=8.0,
    show_default=True,
    help="Depth: what a measured distance may be off; a painted tip has a radius of about 8 mm.",
)
@click.option(
    "--between",
    metavar="A,B",
    help="Distance: the two markers, such as the paints of two dots on a rod.  [default: the rig's first two]",
)
@click.option(
    "--length-mm",
    type=FiniteRange(10.0, 2000.0),
    help="Distance: how far apart they are, middle to middle. A simulated rig knows it.",
)
@click.option("--yes", is_flag=True, help="Live: begin each part at once, without waiting for Enter.")
@json_option
@page_option("--report")
@rig_option
@bus_options
def rig(
    recording_path: Path | None,
    live: tuple[str, ...],
    seconds: float,
    marker: str,
    distances: str,
    ruler_mm: float,
    between: str | None,
    length_mm: float | None,
    yes: bool,
    json_path: Path | None,
    page_path: Path | None,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Measure your own rig: jitter, latency, threads, depth and grasping, with uncertainties, as one report.

    Either on the running rig, part by part (it says what to do), or on a RECORDING: an MCAP file of `rhot record`, or a
    folder of pictures or marker tracks:

    \b
    rhot evaluate rig --rig RIG --live still --live latency --report rig.html
    rhot evaluate rig --rig RIG --live depth --distances 40,50,60,70,80,90
    rhot evaluate rig --rig RIG take.mcap --report take.html

    \b
    still     jitter of each marker, in pixels and millimetres, while the hand rests
    distance  error of a known distance between two markers that move through the volume: one figure to quote
    latency   retrieval, detection, sending and all of it, per camera; threads against time of a frame
    depth     disparity at measured distances, and the depth law through them (see `rhot calibrate depth`)
    grasp     the phases of grasping, as `rhot evaluate grasp`

    Every figure has a 95 % confidence interval that accounts for the correlation of neighbouring samples. On `rhot sim`
    the report also shows ground truth; the depth session then uses it instead of a ruler.
    """
    check_output("--json", json_path)
    check_output("--report", page_path)
    if (recording_path is None) == (not live):
        raise ConfigError(f"give either a RECORDING or --live {'|'.join(PARTS)}")
    loaded, console = _loaded(rig_path, marker), Console(stderr=True, soft_wrap=True)
    rod = _Rod(_pair(loaded, between), None if length_mm is None else 1e-3 * length_mm)
    failed: list[str] = []
    if recording_path is not None:
        sections, plots = _recorded(loaded, recording_path, rod)
        source = f"the recording {recording_path.name}"
    else:
        session = _Session(loaded, tool_bus(rig_path, connect, namespace), seconds, console, rod)
        held = _Held(marker, _distances(distances), 1e-3 * ruler_mm)
        sections, plots, failed = _live(session, list(dict.fromkeys(live)), held, ask=not yes)
        source = f"the running rig {loaded.config.name}, {seconds:g} s each"
    show("evaluate rig", sections, json_path, source=source)
    if page_path is not None:
        about = f"From {source}. Intervals hold the truth in 95 of 100 cases; neighbouring samples count as alike."
        write_text_atomic(page_path, html_report(f"Measures of the rig “{loaded.config.name}”", about, sections, plots))
        console.print(f"report: {page_path}", markup=False)
    if failed:
        raise ConfigError(f"not measured: {', '.join(failed)}; the reasons stand above")


@dataclass(frozen=True, slots=True)
class _Rod:
    """Two markers and how far they are apart, metres; None = not said."""

    pair: tuple[str, str]
    length_m: float | None


@dataclass(frozen=True, slots=True)
class _Session:
    """A running rig, how long each part listens, where the person reads what to do, and what is moved for distance."""

    rig: Rig
    bus: BusConfig
    seconds: float
    console: Console
    rod: _Rod

    def listen(self, seconds: float) -> Heard:
        """Return what the rig publishes from now on."""
        return asyncio.run(listen(self.bus, seconds, lambda _: None))


@dataclass(frozen=True, slots=True)
class _Held:
    """What is held before the cameras to measure depth: a marker, at which distances, and how exact these are."""

    marker: str
    places_cm: Sequence[float]
    ruler_m: float


def _live(
    session: _Session, parts: Sequence[str], held: _Held, *, ask: bool
) -> tuple[list[Section], list[str], list[str]]:
    """Measure parts one after the other; return sections, plots and the parts that failed.

    Raises:
        RhotError: the only part failed, or all did.
    """
    sections: list[Section] = []
    plots: list[str] = []
    failed: list[str] = []
    for part in parts:
        session.console.print(f"{part}: {_SAY[part]}, {session.seconds:g} s")
        if ask:
            click.prompt("Enter begins", default="", show_default=False, err=True)
        try:
            found, drawn = _depth(session, held) if part == "depth" else _listened(part, session)
        except RhotError as error:
            if len(parts) == 1:
                raise
            # What was measured before it is not lost.
            failed.append(part)
            session.console.print(f"{part}: {error}", style="red", markup=False)
        else:
            sections += found
            plots += drawn
    if not sections:
        raise ConfigError("nothing was measured; the reasons stand above")
    return sections, plots, failed


def _loaded(rig_path: Path, marker: str) -> Rig:
    """Load a rig that must have a marker."""
    loaded = load_rig(rig_path)
    if marker not in loaded.config.markers:
        raise ConfigError(f"--marker {marker}: the rig has {', '.join(loaded.config.markers)}")
    return loaded


def _depth(session: _Session, held: _Held) -> tuple[Sequence[Section], list[str]]:
    """Measure depth: against the truth where the rig tells it, else at distances that a person measures."""
    rig, guided = session.rig, not session.listen(_LOOK_S).truth
    heard = Heard() if guided else session.listen(session.seconds)
    rows = depth_rows(rig, session.bus, heard, held.marker, held.places_cm, held.ruler_m, session.console)
    truth = simulated_truth(rig, heard)
    return depth_sections(rows, None if truth is None else truth.fb), [depth_plot(rows)]


def _listened(part: str, session: _Session) -> tuple[Sequence[Section], Sequence[str]]:
    """Listen, and judge what was heard for one part other than depth."""
    rig, heard = session.rig, session.listen(session.seconds)
    truth = simulated_truth(rig, heard)
    if part == "grasp":
        return grasps(rig, heard), ()
    if part == "distance":
        return [distance_section(distances(heard, session.rod.pair, session.rod.length_m), session.rod.pair)], ()
    if part == "latency":
        times = latencies_of(heard) if truth is None else latencies_of(heard, truth.exposed_ns)
        pictures = asyncio.run(pictures_of(session.bus, tuple(rig.cameras), _PICTURES))
        return [*latency_sections(heard, times), _threads(rig, pictures)], ()
    jitter = still_jitter(heard, None if truth is None else truth.cameras)
    return jitter_sections(jitter), jitter_plots(jitter)


def _recorded(rig: Rig, path: Path, rod: _Rod) -> tuple[list[Section], list[str]]:
    """Judge a recording: jitter where the hand rests, latency, a distance that is told, and threads on its pictures."""
    if path.is_file():
        # What was published is in it: nothing is tracked again.
        heard, recording = Heard.of(RecordedMessages(path)), pictures_beside(path)
    else:
        recording = load_recording(path, rig_timing(rig))
        heard = Heard.of(track(rig, marker_frames(rig, recording)))
    if not heard.frames:
        raise ConfigError(f"{path}: no camera's markers are in it; record with `rhot record`, or name a folder")
    jitter = still_jitter(heard)
    sections = [*jitter_sections(jitter), *latency_sections(heard, latencies_of(heard))]
    if rod.length_m is not None:
        sections.insert(0, distance_section(distances(heard, rod.pair, rod.length_m), rod.pair))
    cameras = {} if recording is None else recording.cameras
    tracks = {name: each for name, each in cameras.items() if not isinstance(each, MarkerTrack)}
    if tracks:
        sections.append(
            _threads(rig, {name: list(islice(read_pictures(each), _PICTURES)) for name, each in tracks.items()})
        )
    return sections, list(jitter_plots(jitter))


def _threads(rig: Rig, pictures: dict[str, list[ImageArray]]) -> Section:
    names = list(own_paints(rig.config.markers))
    tables = camera_tables(load_colors(rig.colors_path), names, pictures)
    detectors = {
        name: MarkerDetector(rig.config.markers, tables[name], rig.cameras[name].width, rig.cameras[name].height)
        for name in pictures
    }
    cores = os.cpu_count() or 1
    return thread_section(pictures, detectors, sorted({1, 2, min(4, cores), cores}))


def _pair(rig: Rig, text: str | None) -> tuple[str, str]:
    names = list(rig.config.markers)[:2] if text is None else [part.strip() for part in text.split(",")]
    if len(names) != 2 or names[0] == names[1] or not set(names) <= set(rig.config.markers):
        raise ConfigError(f"--between {text}: give two of the rig's markers, {', '.join(rig.config.markers)}")
    return names[0], names[1]


def _distances(text: str) -> Sequence[float]:
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) < 3 or not all(0.0 < each < math.inf for each in found):
        raise ConfigError(f"--distances {text}: give three or more in centimetres, such as 40,60,80")
    return found
