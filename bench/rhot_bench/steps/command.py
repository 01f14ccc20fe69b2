"""`rhot evaluate steps`: feet on recordings of real sensors and real pictures, with what the truth there is."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from rich.console import Console

from rhot.arrays import FloatArray
from rhot.aruco_dictionary import marker_dictionary
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import rotation_from_quaternion, vector_from_rotation
from rhot.messages import Side
from rhot_bench.feet.runs import SIDES
from rhot_bench.processes import read_columns
from rhot_bench.steps.dead_reckoning import (
    Reckoned,
    faster,
    held_out_rows,
    horizontal_error_m,
    kind_rows,
    reckon,
    reckoned,
)
from rhot_bench.steps.markers import follow_marker, marker_figures, read_marker_test, tilt_figures
from rhot_bench.steps.walks import StepTrial, hide_swings, read_places, read_step_trial
from rhot_bench.thesis.feet import ThesisFeet
from rhot_feet.depth.tracker import DepthTracker
from rhot_feet.frames import DepthFrame, pinhole
from rhot_feet.imu.samples import GRAVITY_M_S2
from rhot_feet.imu.zero_velocity_detector import ACCELERATION_NOISE, RATE_NOISE
from rhot_feet.prediction import FootPrediction
from rhot_feet.sources.depth_camera.recorded_frames import load_depth_recording
from rhot_feet.sources.imu.recorded import read_samples
from rhot_tools.measures.output import counted, json_option, quick_option, show
from rhot_tools.measures.rows import Row, Section, check_output

# Depth pictures of really walking feet with toes marked by hand: followed from the first marks alone.
#
# There is no headset and no sensor: each foot is expected where it would be if it went on as before. The lens is not
# known; a D435's colour camera at 640x480 has a focal length of about 610 px.

NEAR_PX: Final = 15.0
FOCAL_PX: Final = 610.0
_RATE_HZ: Final = 30.0
_DEPTH_RANGE_M: Final = (0.3, 4.0)
_MARKED_M: Final = 0.01
"""How well the first marks tell a foot's position, standard deviation per axis."""
_EXPECTED_M: Final = 0.04
"""The same of a foot that goes on as before, 1/30 s later."""
_MARKS: Final = "manual_toe_tips.csv"


class ToeWalk:
    """A recording, and pixels that somebody has marked in some of its pictures.

    Attributes:
        camera: its lens.
        marks: number of a picture to its toes: side to (u, v, depth), pixels and millimetres.
    """

    def __init__(self, folder: Path, focal_px: float = FOCAL_PX) -> None:
        """Look at the files.

        Raises:
            ConfigError: something is missing or unreadable; names the file.
        """
        K = np.array([[focal_px, 0.0, 320.0], [0.0, focal_px, 240.0], [0.0, 0.0, 1.0]])
        self.camera = pinhole(640, 480, K, np.empty(0))
        self.recording = load_depth_recording(folder, camera=self.camera, rate_hz=_RATE_HZ)
        columns = {side: [f"{side}_toe_{name}" for name in ("u", "v", "depth_mm")] for side in SIDES}
        table = read_columns(folder / _MARKS, ["frame", *columns["left"], *columns["right"]])
        positions = {side: np.stack([table[name] for name in names], axis=1) for side, names in columns.items()}
        numbers = [int(number) for number in table["frame"]]
        self.marks = {number: {side: positions[side][row] for side in SIDES} for row, number in enumerate(numbers)}
        first = self.recording.frame(0).index
        if first not in self.marks:
            raise ConfigError(f"{folder / _MARKS}: the toes of the first picture ({first}) are not marked")

    def off_px(self, frame: DepthFrame, positions: Mapping[Side, FloatArray]) -> list[float]:
        """Return how far positions (3,), metres, camera frame, lie from a picture's marks; nothing without marks."""
        marks = self.marks.get(frame.index, {})
        return [
            float(np.linalg.norm(self.camera.project(position[None])[0] - marks[side][:2]))
            for side, position in positions.items()
            if side in marks
        ]


def follow_toes(walk: ToeWalk) -> FloatArray:
    """Return the distances from the marks, pixels, of the feet's depth stage; one not found is where it was bound."""
    tracker = DepthTracker(_DEPTH_RANGE_M)
    positions: dict[Side, FloatArray] = {}
    speeds = {side: np.zeros(3) for side in SIDES}
    off: list[float] = []
    for frame in walk.recording.frames():
        if not positions:
            positions = {side: _seen_at(mark, walk.camera) for side, mark in walk.marks[frame.index].items()}
            sure = {side: FootPrediction(position, _MARKED_M**2 * np.eye(3)) for side, position in positions.items()}
            tracker.detect(frame, {}, sure)
            continue
        bound = {side: FootPrediction(positions[side] + speeds[side], _EXPECTED_M**2 * np.eye(3)) for side in SIDES}
        found = tracker.detect(frame, bound, {}).feet
        for side in SIDES:
            now = found[side].position if side in found else positions[side] + speeds[side]
            speeds[side] = 0.5 * speeds[side] + 0.5 * (now - positions[side])
            positions[side] = now
        off += walk.off_px(frame, positions)
    return np.array(off)


def thesis_toes(walk: ToeWalk) -> FloatArray:
    """Return the same of the thesis's depth stage, of the feet that it reports."""
    thesis = ThesisFeet(marker_dictionary("4X4_50"), {"left": 0, "right": 1}, 0.04)
    off: list[float] = []
    for number, frame in enumerate(walk.recording.frames()):
        if frame.depth_mm is None:
            continue
        if number == 0:
            for side, (u, v, depth_mm) in walk.marks[frame.index].items():
                thesis.start(side, (float(u), float(v)), float(depth_mm))
        feet = thesis.detect(frame.color, frame.depth_mm, walk.camera)
        if number:
            off += walk.off_px(frame, {side: foot.position for side, foot in feet.items()})
    return np.array(off)


def _seen_at(mark: FloatArray, camera: CameraModel) -> FloatArray:
    """Return the position (3,), metres, camera frame, of a mark: u, v, depth in millimetres."""
    x, y = camera.undistort(mark[None, :2])[0]
    position: FloatArray = np.array([x, y, 1.0]) * mark[2] * 1e-3
    return position


# The standard detectors of zero velocity over whole recordings, to compare the live one with.
#
# All are tests over a window of n samples of specific force f (m/s²) and angular rate ω (rad/s); small means still:
#
#     SHOE  = mean(|f − g·f̄/|f̄||²/σ_a² + |ω|²/σ_ω²)      (generalised likelihood ratio test)
#     ARED  = mean(|ω|²)/σ_ω²                            (energy of the angular rate)
#
# Source: Skog, Händel, Nilsson and Rantakokko, "Zero-velocity detection: an algorithm evaluation", IEEE Transactions on
# Biomedical Engineering 57 (11), 2010.


def _windows(values: FloatArray, size: int) -> FloatArray:
    """Return (N, size, 3): the centred window of each of the rows (N, 3); the ends repeat the outermost row."""
    before = (size - 1) // 2
    padded = np.pad(values, ((before, size - 1 - before), (0, 0)), mode="edge")
    windows: FloatArray = sliding_window_view(padded, size, axis=0).swapaxes(1, 2)
    return windows


def shoe(specific_force: FloatArray, angular_rate: FloatArray, size: int = 5) -> FloatArray:
    """Return the SHOE statistic (N,) of samples (N, 3) and (N, 3), over centred windows of `size`."""
    f, w = _windows(specific_force, size), _windows(angular_rate, size)
    mean = f.mean(axis=1, keepdims=True)
    gravity = GRAVITY_M_S2 * mean / np.maximum(np.linalg.norm(mean, axis=2, keepdims=True), 1e-9)
    force = ((f - gravity) ** 2).sum(axis=2) / ACCELERATION_NOISE**2
    statistic: FloatArray = (force + (w * w).sum(axis=2) / RATE_NOISE**2).mean(axis=1)
    return statistic


def ared(angular_rate: FloatArray, size: int = 5) -> FloatArray:
    """Return the energy of the angular rate (N,) of samples (N, 3), over centred windows of `size`."""
    w = _windows(angular_rate, size)
    statistic: FloatArray = (w * w).sum(axis=2).mean(axis=1) / RATE_NOISE**2
    return statistic


# Which way a foot points, by how its heel is lifted, on recorded walks (`rhot_feet.filter.displacement`).
#
# The axis about which the sensor turns until the heel is highest, against the way of the foot: a foot that walks points
# about along the mean of the steps before and after. Its own toe-out counts as an error. The sensor's north is that of
# the whole path by dead reckoning.

LEAST_LIFT_RAD: Final = math.radians(25.0)
_STANDS_M_S: Final = 0.25
_SMOOTHED: Final = 7
_SHORTEST: Final = 10
_SEARCHED: Final = 120
"""Of the motion capture: slower is a stand, over so many samples, if it lasts so many; the heel is highest within."""
_STEP_M: Final = 0.3
_TURN_RAD: Final = math.radians(85.0)
"""Between steps that are shorter, or turn by more, nobody knows where the foot points."""


def heel_directions(trial: StepTrial) -> FloatArray:
    """Return by how much each lifted heel is off (K,), radians, in a recording with motion capture (200 Hz)."""
    R = rotation_from_quaternion(trial.samples.orientation_xyzw)
    path, true = reckon(trial.samples), trial.position - trial.position[0]
    north = float(np.angle(np.sum((true[:, 0] + 1j * true[:, 1]) * np.conj(path[:, 0] + 1j * path[:, 1]))))
    stands = _stands(trial)
    off = []
    for before, here, after in zip(stands, stands[1:], stands[2:], strict=False):
        came, goes = (
            complex(*(trial.position[to[0]] - trial.position[start[1]])[:2])
            for start, to in ((before, here), (here, after))
        )
        turn = float(np.angle(goes * came.conjugate()))
        if min(abs(came), abs(goes)) < _STEP_M or abs(turn) > _TURN_RAD:
            continue
        middle = sum(here) // 2
        lifts = [vector_from_rotation(R[k] @ R[middle].T) for k in range(middle, min(after[0], here[1] + _SEARCHED))]
        x, y, _ = max(lifts, key=lambda lift: math.hypot(lift[0], lift[1])).tolist()
        if math.hypot(x, y) >= LEAST_LIFT_RAD:
            # The toes go down about an axis to the left.
            points = float(np.angle(came)) + 0.5 * turn + math.pi / 2.0
            off.append(float(np.angle(np.exp(1j * (math.atan2(y, x) + north - points)))))
    return np.array(off)


def _stands(trial: StepTrial) -> list[tuple[int, int]]:
    """Return the first and last sample of each stand."""
    speed = np.linalg.norm(np.gradient(trial.position, trial.t_s, axis=0), axis=1)
    still = np.convolve(speed, np.full(_SMOOTHED, 1.0 / _SMOOTHED), "same") < _STANDS_M_S
    edges = np.flatnonzero(np.diff(np.r_[False, still, False].astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2) if b - a > _SHORTEST]


Advance = Callable[[], None]

MM: Final = 1e3
_SENSORS: Final = Path("foot_imu")
_MARKERS: Final = Path("aruco") / "d435_qualisys"
_WALK: Final = Path("realsense") / "feet_rgbd"
_TRIALS: Final = "trials.json"
_SWINGS: Final = "_raw200.csv"
_FORMS: Final = {"raw200": "200 Hz, force and rate", "bno100": "100 Hz, as a BNO080 sends it"}
_THRESHOLD: Final = 1e5
"""Of the standard detectors: the best one for all of PyShoe's trials together among 1e4, 3e4, 1e5, 3e5 and 1e6."""
_ARMSE: Final = "mean over time of the horizontal error per axis, turned into one heading: the published measure"
_FASTER: Final = 1.6
"""No recording here runs: from the strides of a walk (about 1 s) to those of a jog (about 0.65 s)."""
_HELD_OUT: Final = "raw200"
_WINDOW: Final = {"raw200": 5, "bno100": 3}


@click.command()
@click.argument("data_path", metavar="DATA", type=click.Path(path_type=Path))
@quick_option("Use less of each recording; rougher figures.")
@json_option
def steps(data_path: Path, quick: bool, json_path: Path | None) -> None:
    """Track feet on recordings of real sensors and cameras.

    DATA is a folder with any of these:

    \b
    foot_imu/              sensors on feet with motion capture: *_raw200.csv with
                           t, ax ay az, gx gy gz, px py pz, zv; *_bno100.csv;
                           trials.json with what is published of each
    aruco/d435_qualisys/   detections of a marker with motion capture: *.csv
    realsense/feet_rgbd/   depth pictures of a walk, toes marked by hand

    Hidden swings: the filter sees the truth only while the foot stands; the figure is how far off the foot is when it
    comes down. Dead reckoning: no camera at all, from the first sample to the last; the same walks once more, played
    faster, stand in for somebody who runs. Leave one trial out: the detector's constants are chosen on all other
    trials; how much each of them matters.
    """
    check_output("--json", json_path)
    tasks = _tasks(data_path, quick)
    sections = []
    with counted(Console(stderr=True, soft_wrap=True)) as progress:
        bar = progress.add_task("", total=sum(task.total for task in tasks))
        for task in tasks:
            progress.update(bar, description=task.name)
            sections.append(Section(task.name, tuple(task.make(lambda: progress.advance(bar)))))
    show("evaluate steps", sections, json_path, quick=quick)


@dataclass(frozen=True, slots=True)
class _Task:
    name: str
    total: int
    make: Callable[[Advance], list[Row]]


def _tasks(data: Path, quick: bool) -> list[_Task]:
    tasks = []
    published = _published(data / _SENSORS / _TRIALS)
    swings = sorted((data / _SENSORS).glob(f"*{_SWINGS}"))
    if swings:
        longest_s = 15.0 if quick else np.inf
        name = "Swings that nobody sees"
        tasks.append(_Task(name, len(swings), lambda go: _swings(swings, published, longest_s, go)))
        lifted = "Where a foot points, by its lifted heel"
        tasks.append(_Task(lifted, len(swings), lambda go: _heels(swings, longest_s, go)))
    for form, name in _FORMS.items():
        files = [data / _SENSORS / f"{trial}_{form}.csv" for trial in published]
        files = [file for file in files if file.exists()][: 2 if quick else None]
        if files:
            tasks.append(_reckoning(name, form, files, published))
            tasks.append(_faster(name, files, form))
        if files and form == _HELD_OUT and not quick:
            tasks.append(_held_out(name, form, files, published))
    detections = sorted((data / _MARKERS).glob("*.csv"))
    if detections:
        most = 500 if quick else None
        tasks.append(_Task("Detected markers", len(detections), lambda go: _markers(detections, most, go)))
    if (data / _WALK).is_dir():
        tasks.append(_Task("Toes on depth pictures", 2, lambda go: _toes(data / _WALK, go)))
    if not tasks:
        raise ConfigError(
            f"{data}: holds none of {_SENSORS}/*{_SWINGS}, {_MARKERS}/*.csv and {_WALK}/; name the folder that does"
        )
    return tasks


@dataclass(frozen=True, slots=True)
class _Trial:
    """What is published of a recording: its error by dead reckoning, metres, and what the person does."""

    error_m: float
    motion: str


def _published(file: Path) -> dict[str, _Trial]:
    """Return what is published of recordings, by name; nothing where there is no such file."""
    if not file.exists():
        return {}
    try:
        trials = json.loads(file.read_text(encoding="utf-8"))
        return {
            str(name): _Trial(float(trial["author_ins_rmse_m"]), str(trial.get("motion_guess", "")))
            for name, trial in trials.items()
        }
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{file}: tells no author_ins_rmse_m of each trial: {error!r}") from error


def _swings(files: Sequence[Path], published: dict[str, _Trial], longest_s: float, advance: Advance) -> list[Row]:
    rows = []
    for file in files:
        name = file.name.removesuffix(_SWINGS)
        does = f"{published[name].motion}; " if name in published else ""
        found = hide_swings(read_step_trial(file, longest_s))
        ends = MM * found.ends_m
        aligned = f"aligned after {found.aligned_s:.1f} s" if np.isfinite(found.aligned_s) else "never aligned"
        rows += [
            Row(f"{name}, mean", _of(np.mean, ends), "mm", note=f"{does}{len(ends)} swings, {aligned}"),
            Row("    worst", _of(np.max, ends), "mm"),
        ]
        advance()
    return rows


def _heels(files: Sequence[Path], longest_s: float, advance: Advance) -> list[Row]:
    off_deg = []
    for file in files:
        off_deg.append(np.degrees(heel_directions(read_step_trial(file, longest_s))))
        advance()
    walks = [(file.name.removesuffix(_SWINGS), off) for file, off in zip(files, off_deg, strict=True) if len(off)]
    least = f"lifted by {math.degrees(LEAST_LIFT_RAD):g}° or more, on the way"
    return [
        Row(f"{name}, root mean square", math.sqrt(_of(np.mean, off**2)), "°", note=f"{len(off)} steps; heels {least}")
        for name, off in walks
    ]


def _reckoning(name: str, form: str, files: Sequence[Path], published: dict[str, _Trial]) -> _Task:
    def make(advance: Advance) -> list[Row]:
        off: dict[str, list[float]] = {"ours": [], "published": [], "SHOE": [], "ARED": []}
        for file in files:
            samples, truth = read_samples(file), read_places(file)
            if len(samples) != len(truth):
                raise ConfigError(f"{file}: {len(truth)} rows, but {len(samples)} samples; remove rows that repeat")
            size = _WINDOW[form]
            tests = {
                "ours": None,
                "SHOE": shoe(samples.specific_force, samples.angular_rate, size) < _THRESHOLD,
                "ARED": ared(samples.angular_rate, size) < _THRESHOLD,
            }
            off["published"].append(MM * published[file.stem.removesuffix(f"_{form}")].error_m)
            for detector, still in tests.items():
                off[detector].append(MM * horizontal_error_m(reckon(samples, still=still), truth))
            advance()
        most = round(_of(np.mean, off["published"]), 1)
        motions = [published[file.stem.removesuffix(f"_{form}")].motion for file in files]
        rows = [Row(f"off on average, {len(files)} trials", _of(np.mean, off["ours"]), "mm", most=most, note=_ARMSE)]
        rows.append(Row("    its worst trial", _of(np.max, off["ours"]), "mm"))
        for text, key in (
            ("published: the best detector, tuned to each trial", "published"),
            ("SHOE, one threshold for all", "SHOE"),
            ("ARED, one threshold for all", "ARED"),
        ):
            rows.append(Row(text, _of(np.mean, off[key]), "mm"))
            rows.append(Row("    its worst trial", _of(np.max, off[key]), "mm"))
        return rows + kind_rows(motions, off["ours"], off["published"])

    return _Task(f"Dead reckoning, {name}", len(files), make)


def _held_out(name: str, form: str, files: Sequence[Path], published: dict[str, _Trial]) -> _Task:
    def make(advance: Advance) -> list[Row]:
        trials: list[Reckoned] = []
        for file in files:
            known = published[file.stem.removesuffix(f"_{form}")]
            trials.append(reckoned(file, known.motion, known.error_m, _FASTER))
            advance()
        return held_out_rows(trials, _FASTER)

    return _Task(f"Leave one trial out, {name}", len(files), make)


def _faster(name: str, files: Sequence[Path], form: str) -> _Task:
    def make(advance: Advance) -> list[Row]:
        off: dict[str, list[float]] = {"ours": [], "SHOE": []}
        for file in files:
            samples, truth = faster(read_samples(file), _FASTER), read_places(file)
            still = shoe(samples.specific_force, samples.angular_rate, _WINDOW[form]) < _THRESHOLD
            off["ours"].append(MM * horizontal_error_m(reckon(samples), truth))
            off["SHOE"].append(MM * horizontal_error_m(reckon(samples, still=still), truth))
            advance()
        rows = []
        for text, key in ((f"off on average, {len(files)} trials", "ours"), ("SHOE, one threshold for all", "SHOE")):
            rows.append(Row(text, _of(np.mean, off[key]), "mm", note=_ARMSE))
            rows.append(Row("    its worst trial", _of(np.max, off[key]), "mm"))
        return rows

    return _Task(f"Dead reckoning, {name}, played {_FASTER:g} times as fast", len(files), make)


def _markers(files: Sequence[Path], most: int | None, advance: Advance) -> list[Row]:
    rows = []
    for file in files:
        test = read_marker_test(file)
        test = test if most is None else test.first(most)
        followed = follow_marker(test)
        figures = marker_figures(test, followed)
        first = f"{100 * figures.first_right:.1f} %"
        nearer = 100.0 * (1.0 - figures.mean_m / figures.first_mean_m)
        note = f"{int(test.known.sum())} detections; the detector's first solution {MM * figures.first_mean_m:.1f} mm"
        rows += [
            Row(f"{file.stem}: the right one of two orientations", 100 * figures.right, "%", least=97.0,
                note=f"the detector's first solution {first}"),
            Row(f"{file.stem}: filtered position, mean", MM * figures.mean_m, "mm", note=note),
            Row("    nearer to the truth than that by", nearer, "%", least=30.0),
        ]  # fmt: skip
        for tilt in tilt_figures(test, followed):
            said = f"{tilt.count} detections, {100 * tilt.clear:.0f} % said to be clear, {100 * tilt.wrong:.0f} % wrong"
            name = f"    clear and wrong, {tilt.from_deg:g} to {tilt.to_deg:g}° from head-on"
            rows.append(Row(name, 100 * tilt.clear_wrong, "%", most=2.0, note=said))
        advance()
    return rows


def _toes(folder: Path, advance: Advance) -> list[Row]:
    walk = ToeWalk(folder)
    ours = follow_toes(walk)
    advance()
    thesis = thesis_toes(walk)
    advance()
    rows = []
    for name, off_px, least in (("ours", ours, 90.0), ("the 2021 thesis's", thesis, None)):
        near = 100.0 * _of(np.mean, (off_px < NEAR_PX).astype(np.float64))
        rows += [
            Row(f"{name}: toes within {NEAR_PX:g} px", near, "%", least=least, note=f"{len(off_px)} marks"),
            Row(f"{name}: median", _of(np.median, off_px), "px"),
        ]
    return rows


def _of(measure: Callable[[FloatArray], float], values: FloatArray | Sequence[float]) -> float:
    return float(measure(np.asarray(values, dtype=np.float64))) if len(values) else float("nan")
