"""Simulated runs of the foot tracker: one walking person, our tracker and the 2021 thesis's on the same data.

Everything arrives as it would live: pictures late by read-out, USB and our own computing, samples late by their wire,
poses of the head late by a network. A hundred times a second both are asked where the feet are, at the time for which
our service would publish them.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import BoolArray, FloatArray
from rhot.aruco_dictionary import R_FOOT_MARKER, marker_dictionary
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot.messages import BodyPose, FootPose, HeadPose, Side
from rhot.rig import Rig
from rhot.rig.feet_config import FeetConfig, FootConfig, WalkProgram
from rhot_bench.feet.heads import START_NS, Heads
from rhot_bench.thesis.feet import ThesisFeet, ThesisFilter
from rhot_feet.filter.model import FootFilterSettings, FootState
from rhot_feet.foot_core import FootCore
from rhot_feet.frames import DepthFrame, pinhole
from rhot_feet.head_track import HeadTrack
from rhot_feet.imu.samples import ImuSamples
from rhot_ik.body_core import BodyCore
from rhot_sim.sources.imu import SimulatedSource
from rhot_sim.walker.person import person_of
from rhot_sim.walker.pictures.disturbances import Cover, Disturbances
from rhot_sim.walker.world import WalkerWorld

# The 2021 thesis's whole foot tracker behind the calls of `rhot_feet.foot_core.FootCore`, for comparison.

_UNUSED: Final = np.eye(3)
"""The thesis's filter has noise values of its own."""


class ThesisTracker:
    """Its camera stages, and its filter for each foot; the camera is where ours is, at the picture's own time."""

    def __init__(self, config: FeetConfig) -> None:
        ids: dict[Side, int] = {side: foot.marker_id for side, foot in config.feet.items()}
        settings = FootFilterSettings(up=config.up)
        self._T_head_camera = config.camera.T_head_camera
        self._heads = HeadTrack()
        self._feet = ThesisFeet(marker_dictionary(config.dictionary), ids, config.marker_size_m)
        self._filters = {side: ThesisFilter(settings) for side in ids}

    def add_head_pose(self, pose: HeadPose) -> None:
        """Add a pose of the head."""
        self._heads.add(pose)

    def add_imu_samples(self, side: Side, samples: ImuSamples) -> None:
        """Add inertial samples of a foot."""
        self._filters[side].add_imu_samples(samples)

    def process(self, frame: DepthFrame) -> None:
        """Detect the feet in a picture and update their filters."""
        T_rig_head = self._heads.at(frame.t_ns)
        if T_rig_head is None or frame.depth_mm is None:
            return
        T = T_rig_head @ self._T_head_camera
        for side, foot in self._feet.detect(frame.color, frame.depth_mm, frame.camera).items():
            position = T[:3, :3] @ foot.position + T[:3, 3]
            if foot.stage == "depth":
                self._filters[side].update_depth(frame.t_ns, position, _UNUSED)
                continue
            R = foot.R_camera_marker
            turned = None if R is None else quaternion_from_rotation(T[:3, :3] @ R @ R_FOOT_MARKER.T)
            self._filters[side].update_marker(frame.t_ns, position, _UNUSED, turned)

    def states(self, t_ns: int) -> dict[Side, FootState]:
        """Return every foot that was ever seen; reading smooths."""
        states = {side: each.state(t_ns) for side, each in self._filters.items()}
        return {side: state for side, state in states.items() if state is not None}


# The knees in the simulated runs of the foot tracker, against the truth.


def knee_errors(bodies: Sequence[BodyPose], world: WalkerWorld) -> tuple[FloatArray, int]:
    """Return the knees' distances from the truth, metres, and how many frames have a knee bent backwards."""
    if not bodies:
        return np.empty(0), 0
    t_s = np.array([1e-9 * (body.t_ns - START_NS) for body in bodies])
    truth = world.joints(t_s)
    errors: list[float] = []
    backwards = 0
    for k, body in enumerate(bodies):
        wrong = False
        for side in body.legs:
            knee, hip = body.joints[f"{side}_knee"], body.joints[f"{side}_hip"]
            errors.append(float(np.linalg.norm(np.array(knee.position) - truth[f"{side}_knee"][k, :3, 3])))
            R_thigh, R_shank = (rotation_from_quaternion(np.array(joint.orientation)) for joint in (hip, knee))
            # Both have their hinge along x; a bent knee turns the shank backwards, which is about -x.
            wrong |= not bool((R_thigh.T @ R_shank)[2, 1] < 1e-6)
        backwards += wrong
    return np.array(errors), backwards


SIDES: Final[tuple[Side, Side]] = ("left", "right")
STEP_S: Final = 0.01
COMPUTE_S: Final = 0.008
"""Between the arrival of a picture and the use of what it shows; the measured time is a figure of its own."""
LEARN_S: Final = 4.0
"""For so long everything is seen before markers are covered or pictures withheld."""
BLACKOUT_S: Final = 1.0
_BLACKOUT_EVERY_S: Final = 2.5
_NOWHERE: Final = np.full(3, np.nan)
STAGES: Final = ("none", "lost", "inertial", "depth", "marker")


@dataclass(frozen=True, slots=True)
class Run:
    """What is played.

    Attributes:
        name: of the run.
        program: what the person does.
        hems: trousers slide over the markers now and then.
        false_markers: markers turn up where no foot is.
        covered: the markers are covered after `LEARN_S`.
        blackouts: now and then, when a foot lifts off, no picture comes for `BLACKOUT_S`; where no foot ever does, at
            regular times.
        height_m: of the person; None = of the rig.
        without_imu: feet that wear no sensor.
    """

    name: str
    program: WalkProgram
    hems: bool = True
    false_markers: bool = False
    covered: bool = False
    blackouts: bool = False
    height_m: float | None = None
    without_imu: tuple[Side, ...] = ()


@dataclass(frozen=True)
class FootTrajectory:
    """One foot through a run, by one tracker.

    Attributes:
        position: (N, 3) metres, rig frame; NaN = not known.
        truth: (N, 3) the same of the true foot.
        measured: (N,) state is `measured`.
        stage: (N,) index into `STAGES`.
        stands: (N,) the foot truly stands.
        speed: (N,) true speed, m/s.
    """

    position: FloatArray
    truth: FloatArray
    measured: BoolArray
    stage: NDArray[np.int64]
    stands: BoolArray
    speed: FloatArray

    @cached_property
    def error_m(self) -> FloatArray:
        """(N,) distance from the truth; NaN = not known."""
        error: FloatArray = np.linalg.norm(self.position - self.truth, axis=1)
        return error


@dataclass(frozen=True, slots=True)
class Played:
    """One run with one seed.

    Attributes:
        run: what was played.
        seed: of the world.
        t_s: (N,) times that were asked for.
        late_s: (N,) from those times until the poses were there, without computing.
        ours, thesis: side to its track.
        blackouts: (M, 2) beginning and end of the times without pictures, seconds; the foot that lifted off is
            `blackout_sides`.
        blackout_sides: which foot.
        picture_s: processor seconds per picture.
        pose_s: processor seconds per publication of both feet, samples included.
        knee_error_m: all knees at all times.
        knees_backwards: number of frames with a knee that bends the wrong way, or a value that is not finite.
        counts: of the stage.
    """

    run: Run
    seed: int
    t_s: FloatArray
    late_s: FloatArray
    ours: dict[Side, FootTrajectory]
    thesis: dict[Side, FootTrajectory]
    blackouts: FloatArray
    blackout_sides: list[Side]
    picture_s: FloatArray
    pose_s: FloatArray
    knee_error_m: FloatArray
    knees_backwards: int
    counts: dict[str, int]


@dataclass(slots=True)
class _TrackerOutput:
    """What a tracker said, tick by tick."""

    position: dict[Side, list[FloatArray]] = field(default_factory=lambda: {side: [] for side in SIDES})
    stage: dict[Side, list[int]] = field(default_factory=lambda: {side: [] for side in SIDES})
    measured: dict[Side, list[bool]] = field(default_factory=lambda: {side: [] for side in SIDES})

    def add(self, feet: Mapping[Side, tuple[FloatArray, str, bool]]) -> None:
        """Take position, stage and whether it is measured, of the feet that are known."""
        for side in SIDES:
            position, stage, measured = feet.get(side, (_NOWHERE, "none", False))
            self.position[side].append(position)
            self.stage[side].append(STAGES.index(stage))
            self.measured[side].append(measured)

    def track(self, side: Side, world: WalkerWorld, t_s: FloatArray) -> FootTrajectory:
        """Return one foot against the truth."""
        truth = world.feet(t_s)[side][:, :3, 3]
        ahead = world.feet(t_s + 1e-3)[side][:, :3, 3]
        return FootTrajectory(
            np.array(self.position[side]),
            truth,
            np.array(self.measured[side]),
            np.array(self.stage[side], dtype=np.int64),
            world.flat(side, t_s),
            np.linalg.norm(ahead - truth, axis=1) / 1e-3,
        )


def play(run: Run, rig: Rig, seed: int, seconds: float) -> Played:
    """Play one run.

    Args:
        run: what is played.
        rig: with `[feet]`; its seed and program do not count.
        seed: of the world.
        seconds: how long.
    """
    rig = rig if run.height_m is None else _of_height(rig, run.height_m)
    playing = _Playing(run, rig, seed, seconds)
    for tick in range(round(seconds / STEP_S)):
        playing.step(tick * STEP_S)
    return playing.result()


class _Playing:
    """A run in progress."""

    def __init__(self, run: Run, rig: Rig, seed: int, seconds: float) -> None:
        feet = _without_imus(rig.config.feet or FeetConfig(), run.without_imu)
        self._run, self._seed = run, seed
        self._world = _world(run, rig, feet, seed, seconds)
        self._blackouts, self._blackout_sides = _blackouts(run, self._world, seconds)
        self._camera = pinhole(feet.camera.width, feet.camera.height, self._world.intrinsics, np.empty(0))
        self._stage, self._thesis, self._body = FootCore(feet), ThesisTracker(feet), BodyCore(rig)
        self._heads = Heads(self._world, seed)
        self._sensors = {side: SimulatedSource(self._world, side) for side in feet.feet if side not in run.without_imu}
        for sensor in self._sensors.values():
            sensor.open(START_NS)
        self._ours, self._theirs = _TrackerOutput(), _TrackerOutput()
        self._bodies: list[BodyPose] = []
        self._t_s: list[float] = []
        self._late_s: list[float] = []
        self._picture_s: list[float] = []
        self._pose_s: list[float] = []
        self._index = 0

    def step(self, now_s: float) -> None:
        """Hand over what has arrived by now, and ask for the feet."""
        now_ns = START_NS + round(1e9 * now_s)
        for head in self._heads.until(now_s):
            self._stage.add_head_pose(head)
            self._thesis.add_head_pose(head)
            self._body.feed(head)
        imu_samples = {side: sensor.read(now_ns) for side, sensor in self._sensors.items()}
        for side, samples in imu_samples.items():
            self._thesis.add_imu_samples(side, samples)
        begun = time.process_time()
        for side, samples in imu_samples.items():
            self._stage.add_imu_samples(side, samples)
        imu_s = time.process_time() - begun
        while self._world.timing(self._index).delivered_s + COMPUTE_S <= now_s:
            self._picture()
        begun = time.process_time()
        due_ns = self._stage.due_ns(now_ns)
        feet = [message for _, message in self._stage.poses(due_ns) if isinstance(message, FootPose)]
        self._pose_s.append(imu_s + time.process_time() - begun)
        self._t_s.append(1e-9 * (due_ns - START_NS))
        self._late_s.append(now_s - self._t_s[-1])
        self._ours.add({foot.side: (np.array(foot.position), foot.stage, foot.state == "measured") for foot in feet})
        states = self._thesis.states(due_ns)
        self._theirs.add({side: (state.position, state.stage, state.stage != "lost") for side, state in states.items()})
        for foot in feet:
            self._bodies += [body for _, body in self._body.feed(foot) if isinstance(body, BodyPose)]

    def _picture(self) -> None:
        timing = self._world.timing(self._index)
        dark = bool(((self._blackouts[:, 0] <= timing.t_s) & (timing.t_s < self._blackouts[:, 1])).any())
        if not (timing.dropped or dark):
            color, depth_mm = self._world.render(timing.t_s)
            frame = DepthFrame(START_NS + round(1e9 * timing.t_s), color, depth_mm, self._camera, self._index)
            self._thesis.process(frame)
            begun = time.process_time()
            self._stage.process(frame)
            self._picture_s.append(time.process_time() - begun)
        self._index += 1

    def result(self) -> Played:
        """Compare with the truth."""
        world, times = self._world, np.array(self._t_s)
        knee_error_m, backwards = knee_errors(self._bodies, world)
        return Played(
            self._run,
            self._seed,
            times,
            np.array(self._late_s),
            {side: self._ours.track(side, world, times) for side in SIDES},
            {side: self._theirs.track(side, world, times) for side in SIDES},
            self._blackouts,
            self._blackout_sides,
            np.array(self._picture_s),
            np.array(self._pose_s),
            knee_error_m,
            backwards,
            dict(self._stage.counts),
        )


def _of_height(rig: Rig, height_m: float) -> Rig:
    body = rig.config.body.model_copy(update={"height_m": height_m})
    return replace(rig, config=rig.config.model_copy(update={"body": body}))


def _without_imus(feet: FeetConfig, sides: Sequence[Side]) -> FeetConfig:
    bare: dict[str, FootConfig] = {
        side: feet.feet[side].model_copy(update={"imu": None}) for side in sides if side in feet.feet
    }
    return feet.model_copy(update=bare)


def _world(run: Run, rig: Rig, feet: FeetConfig, seed: int, seconds: float) -> WalkerWorld:
    covers = tuple(Cover(side, LEARN_S, seconds) for side in SIDES) if run.covered else ()
    disturbances = Disturbances(hems=run.hems, false_markers=run.false_markers, covers=covers)
    body = person_of(BodyModel.from_config(rig.config.body), seed)
    return WalkerWorld(seed, body, run.program, feet=feet, disturbances=disturbances)


def _blackouts(run: Run, world: WalkerWorld, seconds: float) -> tuple[FloatArray, list[Side]]:
    """Return times (M, 2) without pictures, which begin when a foot lifts off, and that foot.

    Where no foot lifts off they come at regular times, for either foot in turn.
    """
    spans: list[tuple[float, float]] = []
    sides: list[Side] = []
    if run.blackouts:
        t_s = np.arange(LEARN_S, seconds - BLACKOUT_S - 0.5, 0.01)
        flat = {side: world.flat(side, t_s) for side in SIDES}
        for k in range(1, len(t_s)):
            lifting = [side for side in SIDES if flat[side][k - 1] and not flat[side][k]]
            if lifting and (not spans or t_s[k] >= spans[-1][0] + _BLACKOUT_EVERY_S):
                spans.append((float(t_s[k]), float(t_s[k]) + BLACKOUT_S))
                sides.append(lifting[0])
        if not spans:
            starts = np.arange(LEARN_S, seconds - BLACKOUT_S, _BLACKOUT_EVERY_S)
            spans = [(float(start), float(start) + BLACKOUT_S) for start in starts]
            sides = [SIDES[k % 2] for k in range(len(spans))]
    return np.array(spans).reshape(-1, 2), sides
