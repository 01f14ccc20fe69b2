"""The whole tracker over simulated pictures, and every figure of it against the truth."""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from rich.progress import Progress

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGER_ANGLES
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.messages import HandPose, MarkerFrame, PointSet
from rhot.offline import track
from rhot.rig import Rig, load_rig
from rhot.rig.folder import RIG_FILE
from rhot.text import as_argument
from rhot_bench.hands.accuracy import (
    START_NS,
    HandFigures,
    Survival,
    against_truth,
    hand_figures,
    survival,
    visible_markers,
)
from rhot_bench.speed.simulated import Cameras, Capture, moments, world_of
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.rig.folder import write_simulated_rig
from rhot_sim.world.world import World
from rhot_tools.measures.points import PointTrack, false_points, identity_swaps, jitter_m, point_track, true_path
from rhot_tools.measures.rows import Row, Section
from rhot_tools.measures.streams import REACH_S, STEP_S, delay_s

# The simulated rig that is measured: the user's own, or a temporary one.

RATE_HZ: Final = 60.0


@contextlib.contextmanager
def simulated_rig(path: Path | None, progress: Progress, seed: int = 1) -> Iterator[Rig]:
    """Give a simulated rig: the one in a folder, or a temporary one.

    Raises:
        ConfigError: the folder holds no rig, or a real one.
    """
    if path is not None:
        if not (path / RIG_FILE).exists():
            raise ConfigError(
                f"--rig {path}: holds no {RIG_FILE}; `rhot init {as_argument(path)} --sim` makes a simulated rig"
            )
        rig = load_rig(path)
        real = [name for name, camera in rig.config.cameras.items() if camera.source != "simulated"]
        if real or len(rig.config.cameras) < 2:
            raise ConfigError(
                f"--rig {path}: two simulated cameras or more are needed, {', '.join(real) or 'too few'} will not do; "
                "`rhot init RIG --sim` makes a simulated rig"
            )
        yield rig
        return
    task = progress.add_task("preparing the simulated rig", total=None)
    with tempfile.TemporaryDirectory(prefix="rhot-bench-") as folder:
        rig = write_simulated_rig(Path(folder) / "rig", rate_hz=RATE_HZ, seed=seed)
        progress.remove_task(task)
        yield rig


SETTLE_S: Final = 1.0
MM: Final = 1e3

HEADSET: Final = "headsets: about 11 mm"
THESIS_JITTER: Final = "thesis: 2–5 px"
PHONE: Final = "phone-style: 15–22°"
FABRIK: Final = "FABRIK: 6–18 mm (middle joints)"


@dataclass(frozen=True, slots=True)
class TrackingScene:
    """What is played before the cameras.

    Attributes:
        name: of its option.
        motion: `script` or `still`.
        speed: how much faster than usual.
        seconds: how long, after the filters have settled.
    """

    name: str
    motion: str
    speed: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Tracked:
    """One scene, tracked.

    Attributes:
        scene: which.
        points: points beside the truth, settled.
        world: the truth.
        seen: coverage and occlusions; None where nobody asked.
        hand: figures of the first hand; None without one.
    """

    scene: TrackingScene
    points: PointTrack
    world: World
    seen: Survival | None
    hand: HandFigures | None

    def lag_s(self, slowest: float, fastest: float) -> float:
        """Return the delay of measured points whose true speed lies between two, seconds; NaN with too few."""
        points = self.points
        used = points.measured & (points.speeds >= slowest) & (points.speeds <= fastest)
        if not len(points.t_s):
            return float("nan")
        ends = points.t_s[0] - REACH_S - 0.1, points.t_s[-1] + REACH_S + 0.1
        true_t_s, true = true_path(self.world, points.names, ends[0], ends[1], STEP_S)
        count = len(points.t_s)
        return delay_s(
            points.t_s,
            points.positions.reshape(count, -1),
            true_t_s,
            true.reshape(len(true_t_s), -1),
            np.repeat(used, 3, axis=1),
        )


def scene_frames(rig: Rig, world: World, to_s: float, advance: Callable[[], None]) -> Iterator[MarkerFrame]:
    """Render, find the markers and yield their frames from the world's start on, in order of delivery."""
    cameras, capture = Cameras(rig, world), Capture(rig)
    for moment in moments(rig, 0.0, to_s):
        yield capture.frame(moment, cameras.picture(moment))
        advance()


def run_scene(rig: Rig, scene: TrackingScene, advance: Callable[[], None], *, look: bool) -> Tracked:
    """Track one scene.

    Args:
        rig: simulated.
        scene: what is played.
        advance: called after each picture.
        look: also tell what could be seen, which takes as long again as rendering a third of the pictures.
    """
    sim = rig.config.sim.model_copy(update={"motion": scene.motion})
    rig = dataclasses.replace(rig, config=rig.config.model_copy(update={"sim": sim}))
    world = world_of(rig, scene.speed)
    end_s = SETTLE_S + scene.seconds
    sets: list[PointSet] = []
    poses: list[HandPose] = []
    for _, message in track(rig, scene_frames(rig, world, end_s, advance)):
        if isinstance(message, PointSet):
            sets.append(message)
        elif isinstance(message, HandPose):
            poses.append(message)
    points = point_track(sets, world, START_NS).after(SETTLE_S)
    seen = None
    if look:
        look_hz = 30.0
        times_s = np.arange(SETTLE_S, end_s - 0.1, 1.0 / look_hz)
        cameras = {name: MarkerCoverage(camera, world) for name, camera in true_cameras(rig).items()}
        rate_hz = next(iter(rig.config.cameras.values())).rate_hz
        seen = survival(points, times_s, visible_markers(cameras, points.names, times_s), rate_hz)
    hand = None
    sides = rig.config.sides
    if sides and poses:
        mine = [pose for pose in poses if pose.side == sides[0]]
        run = against_truth(mine, world, sides[0], START_NS)
        hand = hand_figures(run, HandModel.from_file(rig.hand, sides[0]), SETTLE_S)
    return Tracked(scene, points, world, seen, hand)


def accuracy_rows(tracked: Tracked, *, slow: bool) -> tuple[Row, ...]:
    """Return errors of measured points; `slow` = against the targets of slow and normal motion."""
    errors = tracked.points.errors_m * MM
    most = (1.5, 4.0) if slow else (None, None)
    rows = [
        Row("fingertip position, median", _percentile(_tips(tracked, errors), 50), "mm", most=most[0], peer=HEADSET),
        Row("fingertip position, p95", _percentile(_tips(tracked, errors), 95), "mm", most=most[1]),
        Row("fingertip position, p99", _percentile(_tips(tracked, errors), 99), "mm"),
    ]
    for column, name in enumerate(tracked.points.names):
        for share in (50, 95, 99):
            label = "median" if share == 50 else f"p{share}"
            rows.append(Row(f"{name}, {label}", _percentile(errors[:, column], share), "mm"))
    return tuple(rows)


def trust_rows(tracked: Tracked) -> tuple[Row, ...]:
    """Return swaps, false points, coverage and occlusions."""
    seconds = f"in {tracked.scene.seconds:g} s"
    rows = [
        Row("identity swaps", identity_swaps(tracked.points), most=0, note=f"{seconds}; --duration 600 for 10 minutes"),
        Row("false points", false_points(tracked.points), most=0, note=f"{seconds}; no true marker within 20 mm"),
    ]
    seen = tracked.seen
    if seen is not None:
        rows += [
            Row("coverage", 100.0 * seen.measured, "%", note=f"measured, of {seen.samples} in view of two cameras"),
            Row("short occlusions", seen.occlusions, note="up to 0.25 s"),
            Row(
                "short occlusions survived", 100.0 * seen.survived, "%", note="reported all through, measured in 50 ms"
            ),
            Row("measured again after an occlusion, median", seen.back_s * 1e3, "ms", note="in steps of 33 ms"),
        ]
    return tuple(rows)


def speed_rows(tracked: Tracked) -> tuple[Row, ...]:
    """Return error and lag by speed."""
    errors, points = tracked.points.errors_m * MM, tracked.points
    rows = []
    for low, high, most in ((0.0, 0.5, None), (0.5, 1.2, None), (1.2, 1.8, 8.0)):
        inside = (points.speeds >= low) & (points.speeds < high) & np.isfinite(errors)
        note = f"{int(inside.sum())} points"
        rows.append(
            Row(
                f"all markers at {low:g} to {high:g} m/s, p95",
                _percentile(errors[inside], 95),
                "mm",
                most=most,
                note=note,
            )
        )
    rows.append(
        Row(
            "lag at 1 m/s",
            tracked.lag_s(0.7, 1.3) * 1e3,
            "ms",
            most=4.0,
            peer="headsets: about 45 ms in all",
            note="delay that fits the truth best, speeds of 0.7 to 1.3 m/s; negative = ahead",
        )
    )
    return tuple(rows)


def still_rows(tracked: Tracked) -> tuple[Row, ...]:
    """Return the static jitter of the worst marker and of each."""
    sideways, depth = (values * MM for values in jitter_m(tracked.points))
    rows = [
        Row("sideways, worst marker", _worst(sideways), "mm", most=0.15, peer=THESIS_JITTER, note="standard deviation"),
        Row("in depth, worst marker", _worst(depth), "mm", most=0.6, note="standard deviation"),
    ]
    for name, across, along in zip(tracked.points.names, sideways.tolist(), depth.tolist(), strict=True):
        rows += [Row(f"{name}, sideways", across, "mm"), Row(f"{name}, in depth", along, "mm")]
    return tuple(rows)


def hand_rows(hand: HandFigures | None) -> tuple[Row, ...]:
    """Return how well the whole hand is solved."""
    nan = float("nan")
    return (
        Row("26 joints, all tips measured, mean", hand.joints_mm if hand else nan, "mm", most=5.0, peer=FABRIK),
        Row("26 joints, one or two tips hidden, mean", hand.joints_hidden_mm if hand else nan, "mm", most=10.0),
        Row("26 joints, p95", hand.joints_p95_mm if hand else nan, "mm"),
        *(
            Row(
                f"{name.replace('_', ' ')}, RMS",
                hand.angles_deg[name] if hand else nan,
                "°",
                most=8.0,
                peer=PHONE,
            )
            for name in FINGER_ANGLES
        ),
        Row("largest step beyond true motion", hand.step_mm if hand else nan, "mm", most=8.0),
        Row("largest difference from the true step", hand.step_off_mm if hand else nan, "mm"),
        Row("largest excess over a joint limit", round(hand.beyond_limits_deg, 6) if hand else nan, "°", most=0.0),
    )


def tracking_sections(scenes: dict[str, Tracked]) -> tuple[Section, ...]:
    """Return all tables of the scenes `script`, `still` and `fast`, as far as they are there."""
    sections = []
    if "script" in scenes:
        script = scenes["script"]
        sections.append(Section("Points, slow and normal motion", accuracy_rows(script, slow=True)))
        sections.append(Section("Trust, slow and normal motion", trust_rows(script)))
        sections.append(Section("Whole hand, slow and normal motion", hand_rows(script.hand)))
    if "still" in scenes:
        sections.append(Section("Static jitter, still world", still_rows(scenes["still"])))
    if "fast" in scenes:
        fast = scenes["fast"]
        title = f"Points, the same motion {fast.scene.speed:g} times as fast"
        sections.append(Section(title, (*speed_rows(fast), *trust_rows(fast))))
    return tuple(sections)


def _tips(tracked: Tracked, errors: FloatArray) -> FloatArray:
    """Return the errors of painted fingertips alone."""
    world = tracked.world
    columns = [k for k, name in enumerate(tracked.points.names) if world.markers[name].kind == "cap"]
    return errors[:, columns]


def _percentile(values: FloatArray, share: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, share)) if finite.size else float("nan")


def _worst(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else float("nan")
