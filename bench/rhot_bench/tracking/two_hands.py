"""`rhot evaluate two-hands`: both hands that touch and cross, against the truth."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click
import cv2
import numpy as np
from rich.console import Console

from rhot.anatomy.hand import HandModel
from rhot.anatomy.markers import worn_paints
from rhot.anatomy.skeleton import CHAINS, JOINTS
from rhot.arrays import BoolArray, FloatArray
from rhot.cli.options import FiniteRange
from rhot.geometry.camera import CameraModel
from rhot.messages import HandPose, Marker, MarkerFrame, PointSet, Side
from rhot.offline import core, track_smoothly, track_with
from rhot.rig import Rig
from rhot_bench.hands.accuracy import START_NS, against_truth, hand_figures
from rhot_bench.speed.simulated import Moment, moments, world_of
from rhot_bench.tracking.tracking import MM, RATE_HZ, SETTLE_S, scene_frames
from rhot_capture.detection.hand.sharing import SharedPaints, Spot
from rhot_capture.detection.track import MarkerTrack
from rhot_capture.timing import row_time_ns
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.rig.folder import with_motion, write_simulated_rig
from rhot_sim.world.world import World, WorldSample
from rhot_tools.measures.output import counted, duration_option, json_option, show
from rhot_tools.measures.points import PointTrack, false_points, identity_swaps, point_track
from rhot_tools.measures.rows import Row, Section, check_output

# Blobs of two hands without pictures: where the paint is, what hides it, and which hand's it is said to be.
#
# Rendering five minutes of pictures takes far longer than tracking them. Here each marker's true centre is projected
# with noise, is hidden where flesh of either hand lies before it, and two blobs of one paint that touch become one.
# What the blobs of shared paints are called is decided by the detector's own `SharedPaints`.

_BLOCK: Final = 512
_NOISE_PX: Final = 0.15
"""Of a blob's centre, each axis; rendered pictures show 0.1 to 0.2."""
_TIP_LENGTH_M: Final = 0.017
_LOSS: Final = 0.02
"""Share of blobs that are missed for no reason."""


def named_frames(rig: Rig, world: World, to_s: float, seed: int = 0) -> Iterator[MarkerFrame]:
    """Yield the marker frames of all cameras from the world's start on, in order of delivery."""
    streams = [_CameraBlobs(rig, world, name, seed).frames(to_s) for name in rig.config.cameras]
    yield from (frame for _, frame in heapq.merge(*streams, key=lambda each: each[0]))


class _CameraBlobs:
    """What one camera says of the markers, frame after frame."""

    def __init__(self, rig: Rig, world: World, name: str, seed: int) -> None:
        self._rig, self._world, self._name = rig, world, name
        self._camera: CameraModel = true_cameras(rig)[name]
        self._config = rig.config.cameras[name]
        self._names = list(world.markers)
        self._worn = worn_paints(world.markers)
        self._sharing = SharedPaints(world.markers)
        self._tracks = {marker: MarkerTrack() for marker in self._names}
        self._rng = np.random.default_rng([seed, list(rig.config.cameras).index(name)])
        self._reach_m = [_extent_m(world, marker) for marker in self._names]

    def frames(self, to_s: float) -> Iterator[tuple[float, MarkerFrame]]:
        """Yield the time of delivery and the frame."""
        block: list[Moment] = []
        for moment in moments(self._rig, 0.0, to_s):
            if moment.camera == self._name:
                block.append(moment)
            if len(block) == _BLOCK:
                yield from self._named(block)
                block = []
        if block:
            yield from self._named(block)

    def _named(self, block: list[Moment]) -> Iterator[tuple[float, MarkerFrame]]:
        config, camera = self._config, self._camera
        half_s = 0.5 * (config.exposure_s + config.readout_s)
        sample = self._world.sample(np.array([moment.t_first_row_s + half_s for moment in block]))
        centres = np.stack([sample.markers[name] for name in self._names], axis=1)
        seen = self._seen(sample, centres)
        uv = camera.project(centres.reshape(-1, 3)).reshape(*centres.shape[:2], 2)
        seen &= np.array([camera.contains(one) for one in uv]) & (self._rng.random(seen.shape) > _LOSS)
        uv += self._rng.normal(0.0, _NOISE_PX, uv.shape)
        depth = camera.to_camera(centres.reshape(-1, 3))[:, 2].reshape(centres.shape[:2])
        px_m = camera.K[0, 0] / depth
        for row, moment in enumerate(block):
            spots = {
                name: self._spot(k, uv[row, k], float(px_m[row, k]))
                for k, name in enumerate(self._names)
                if seen[row, k]
            }
            yield moment.delivered_s, self._frame(moment, self._given(spots))

    def _seen(self, sample: WorldSample, centres: FloatArray) -> BoolArray:
        """Return which markers (N, M) no flesh hides."""
        eye = self._camera.center
        away = centres - eye
        length = np.linalg.norm(away, axis=-1)
        ray = away / length[..., None]
        seen = np.ones(centres.shape[:2], dtype=bool)
        for side, joints in sample.joints.items():
            radii = self._world.hands[side].radii
            for chain in CHAINS.values():
                index = [JOINTS.index(joint) for joint in chain]
                for a, b in itertools.pairwise(index):
                    for share in (0.0, 0.5, 1.0):
                        ball = (1.0 - share) * joints.positions[:, a] + share * joints.positions[:, b] - eye
                        radius = (1.0 - share) * radii[a] + share * radii[b]
                        along = (ray * ball[:, None]).sum(-1)
                        beside2 = (ball**2).sum(-1)[:, None] - along**2
                        # Flesh hides what lies this much behind its middle: a fingertip's own
                        # flesh does not.
                        seen &= ~((beside2 < radius**2) & (along < length - 0.015))
        return seen

    def _spot(self, k: int, uv: FloatArray, px_m: float) -> Spot:
        across, down = (px_m * reach for reach in self._reach_m[k])
        return Spot(float(uv[0]), float(uv[1]), across, down, across * down, 1.0)

    def _given(self, spots: dict[str, Spot]) -> dict[str, Spot]:
        """Return the spots under the names that they are given."""
        shared = self._sharing.wearers
        named = {name: spot for name, spot in spots.items() if self._worn[name] not in shared}
        self._sharing.see_patches(named)
        for paint, pair in shared.items():
            blobs = _merged([spots[name] for name in pair if name in spots])
            found = self._sharing.match(paint, blobs, {name: self._tracks[name].expected for name in pair})
            named |= {name: blobs[number] for name, number in found.items()}
        for name, track in self._tracks.items():
            if name in named:
                track.update(named[name].u, named[name].v, named[name].area)
            else:
                track.miss()
        self._sharing.remember({name: (spot.u, spot.v) for name, spot in named.items()})
        return named

    def _frame(self, moment: Moment, spots: dict[str, Spot]) -> MarkerFrame:
        config = self._config
        t_ns = START_NS + round(1e9 * moment.t_first_row_s)
        middle_ns = row_time_ns(t_ns, 0.5 * (config.height - 1), config.height, config.exposure_s, config.readout_s)
        # Blobs are those of one moment, that of the middle row, wherever they are.
        markers = {
            name: Marker(u=spot.u, v=spot.v, area=0.0, score=0.9, t_ns=middle_ns) for name, spot in spots.items()
        }
        return MarkerFrame(
            t_ns=middle_ns,
            camera=self._name,
            width=config.width,
            height=config.height,
            markers=markers,
            frame=moment.number,
        )


def _merged(spots: list[Spot]) -> list[Spot]:
    """Return blobs of one paint; two that touch are one."""
    if len(spots) < 2:
        return spots
    a, b = spots
    if abs(a.u - b.u) > 0.5 * (a.across + b.across) or abs(a.v - b.v) > 0.5 * (a.down + b.down):
        return spots
    u, v = 0.5 * (a.u + b.u), 0.5 * (a.v + b.v)
    across, down = abs(a.u - b.u) + 0.5 * (a.across + b.across), abs(a.v - b.v) + 0.5 * (a.down + b.down)
    return [Spot(u, v, across, down, a.area + b.area, 1.0)]


def _extent_m(world: World, name: str) -> tuple[float, float]:
    marker = world.markers[name]
    if marker.size_m is not None:
        return marker.size_m
    radius_m = float(world.hands[marker.hand].radii[JOINTS.index(marker.joint)])
    return 2.0 * radius_m, max(2.0 * radius_m, _TIP_LENGTH_M)


SIDES: Final[tuple[Side, Side]] = ("right", "left")
_WRONG_PX: Final = 14.0
"""A blob further than this from its marker's true centre, a fingertip's width in the picture, is not that marker."""


@click.command("two-hands")
@duration_option(
    1,
    3600,
    20.0,
    "Seconds of pictures. Each takes about three of computing: one to draw it and find markers, two to track it. "
    "24 seconds show two cycles.",
)
@click.option(
    "--names-for",
    "names_s",
    type=FiniteRange(0, 36000),
    default=300.0,
    show_default=True,
    help="Seconds of blobs without pictures, for which hand they are said to be; 0 leaves this out.",
)
@click.option(
    "--paints",
    type=click.Choice(["shared", "own"]),
    default="shared",
    show_default=True,
    help="shared: the left fingertips wear the right ones' paints. own: twelve paints, which only a simulated camera "
    "tells apart.",
)
@click.option(
    "--seed", type=click.IntRange(0, 2**63 - 1), default=1, show_default=True, help="Seed of the simulated world."
)
@json_option
def two_hands(duration_s: float, names_s: float, paints: str, seed: int, json_path: Path | None) -> None:
    """Track two simulated hands that touch and cross, and compare with the truth.

    Every twelve seconds the hands turn their fingertips towards each other, touch, part, cross one above the other and
    go back: at 60 fps, with all faults of the simulated rig. Offline is what `rhot process --smooth` makes of it.

    Which hand: the same motion for minutes, as blobs without pictures, through the detector's naming of shared paints
    and through fusion. A swap is a marker that is measured at one of the other hand.
    """
    check_output("--json", json_path)
    cv2.setNumThreads(1)
    console = Console(stderr=True, soft_wrap=True)
    sections: list[Section] = []
    with _crossing_rig(seed, share=paints == "shared") as rig, counted(console) as progress:
        world = world_of(rig)
        rate_hz = sum(camera.rate_hz for camera in rig.config.cameras.values())
        task = progress.add_task("rendering and finding", total=round((SETTLE_S + duration_s) * rate_hz))
        frames = list(scene_frames(rig, world, SETTLE_S + duration_s, lambda: progress.advance(task)))
        for title, smooth in (("Offline, 60 fps", True), ("As they come, 60 fps", False)):
            waiting = progress.add_task(title, total=None)
            sections.append(_section(f"Two hands: {title}", rig, world, frames, smooth=smooth))
            progress.remove_task(waiting)
        sections.append(_naming_section(f"Which hand: {duration_s:g} s of pictures", wrong_names(rig, world, frames)))
        if names_s > 0.0:
            waiting = progress.add_task("blobs without pictures", total=None)
            sections.append(_long_section(rig, world, names_s, seed))
            progress.remove_task(waiting)
    show("evaluate two-hands", sections, json_path, seed=seed, seconds=duration_s, names_s=names_s, paints=paints)


@contextlib.contextmanager
def _crossing_rig(seed: int, *, share: bool) -> Iterator[Rig]:
    with tempfile.TemporaryDirectory(prefix="rhot-bench-") as folder:
        rig = write_simulated_rig(Path(folder) / "rig", rate_hz=RATE_HZ, seed=seed, sides=SIDES, share_paints=share)
        yield with_motion(rig, "crossing")


@dataclass(frozen=True, slots=True)
class Naming:
    """What blobs were called.

    Attributes:
        named: blobs of fingertips that got a name.
        wrong: of these, so many lie elsewhere than the marker of that name.
    """

    named: int
    wrong: int


def wrong_names(rig: Rig, world: World, frames: list[MarkerFrame]) -> Naming:
    """Compare what fingertips are called in pictures with the truth."""
    t_s = np.array([(frame.t_ns - START_NS) * 1e-9 for frame in frames])
    true = world.sample(t_s).markers
    tips = [name for name, marker in world.markers.items() if marker.kind == "cap"]
    named = wrong = 0
    for name, camera in true_cameras(rig).items():
        for tip in tips:
            rows = [row for row, frame in enumerate(frames) if frame.camera == name and tip in frame.markers]
            seen = np.array([(frames[row].markers[tip].u, frames[row].markers[tip].v) for row in rows]).reshape(-1, 2)
            off = camera.project(true[tip][rows]) - seen
            named += len(rows)
            wrong += int(np.count_nonzero(np.hypot(off[:, 0], off[:, 1]) > _WRONG_PX))
    return Naming(named, wrong)


def _section(title: str, rig: Rig, world: World, frames: list[MarkerFrame], *, smooth: bool) -> Section:
    sets: list[PointSet] = []
    poses: list[HandPose] = []
    messages = track_smoothly(rig, iter(frames)) if smooth else track_with(core("fusion")(rig), core("ik")(rig), frames)
    for _, message in messages:
        if isinstance(message, PointSet):
            sets.append(message)
        elif isinstance(message, HandPose):
            poses.append(message)
    points = point_track(sets, world, START_NS).after(SETTLE_S)
    errors = _tip_errors_mm(points, world)
    limits = (1.5, 5.0) if smooth else (None, None)
    rows = [
        Row("fingertip position, median", _percentile(errors, 50), "mm", most=limits[0]),
        Row("fingertip position, p95", _percentile(errors, 95), "mm", most=limits[1]),
        Row("fingertip position, p99", _percentile(errors, 99), "mm"),
        Row(
            "fingertips measured", 100.0 * float(np.isfinite(errors).mean()), "%", note="of all moments, hidden or not"
        ),
        *_trust_rows(points, world),
    ]
    for side in SIDES:
        mine = [pose for pose in poses if pose.side == side]
        if mine:
            model = HandModel.from_file(rig.hand, side)
            figures = hand_figures(against_truth(mine, world, side, START_NS), model, SETTLE_S)
            rows.append(Row(f"{side} hand, 26 joints, all tips measured, mean", figures.joints_mm, "mm"))
            rows.append(Row(f"{side} hand, 26 joints, p95", figures.joints_p95_mm, "mm"))
    return Section(title, tuple(rows))


def _long_section(rig: Rig, world: World, seconds: float, seed: int) -> Section:
    frames = list(named_frames(rig, world, SETTLE_S + seconds, seed))
    fusion = core("fusion")(rig)
    sets = [points for frame in frames for _, points in fusion.feed(frame)]
    points = point_track(sets, world, START_NS).after(SETTLE_S)
    naming = _naming_section("", wrong_names(rig, world, frames)).rows
    return Section(f"Which hand: {seconds:g} s of blobs without pictures", (*naming, *_trust_rows(points, world)))


def _naming_section(title: str, naming: Naming) -> Section:
    share = 100.0 * naming.wrong / max(naming.named, 1)
    note = f"{naming.wrong} of {naming.named}; {_WRONG_PX:g} px or more from their marker"
    return Section(title, (Row("fingertip blobs of a wrong name", share, "%", note=note),))


def _trust_rows(points: PointTrack, world: World) -> tuple[Row, ...]:
    hands = [world.markers[name].hand for name in points.names]
    seconds = f"in {points.t_s[-1] - points.t_s[0]:.0f} s" if len(points.t_s) else ""
    return (
        Row("swaps between the hands", identity_swaps(points, hands), most=0, note=seconds),
        Row("false points", false_points(points), note=f"{seconds}; no true marker within 20 mm"),
    )


def _tip_errors_mm(points: PointTrack, world: World) -> FloatArray:
    tips = [column for column, name in enumerate(points.names) if world.markers[name].kind == "cap"]
    errors: FloatArray = points.errors_m[:, tips] * MM
    return errors


def _percentile(errors: FloatArray, share: float) -> float:
    finite = errors[np.isfinite(errors)]
    return float(np.percentile(finite, share)) if finite.size else float("nan")
