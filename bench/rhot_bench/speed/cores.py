"""Capture, fusion and inverse kinematics, each beside what the thesis did, and all of them in a row."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, cast

import numpy as np
from numpy.typing import ArrayLike

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray, ImageArray
from rhot.messages import MarkerFrame, PointSet, encode
from rhot.rig import Rig
from rhot.types import Vector3
from rhot_bench.speed.interleaved import Spread, interleaved, lockstep, no_collection, ratio_rows, time_rows, timed
from rhot_bench.speed.simulated import Cameras, Capture, Moment, moments
from rhot_bench.thesis.capture import ThesisDetector
from rhot_bench.thesis.hand import HINGES_DEG, ROTOR_DEG, Arrival, ThesisFinger, ThesisFusion, ThesisHand
from rhot_bench.thesis.paint_samples import thesis_boxes
from rhot_capture.detection.subpixel import windows
from rhot_capture.detection.subpixel.windows import MIN_CONTRAST, MIN_SURROUNDINGS, MISFIT, NOISE, RIDGE, TINY
from rhot_fusion.core import FusionCore
from rhot_ik.hand.closed_form import AnalyticFingers, FingerGeometry
from rhot_ik.hand_core import HandCore
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.world.world import World
from rhot_tools.measures.rows import Row, Section

# The algebra of `rhot_capture.detection.subpixel.windows` in numpy: what the plain numbers there must be faster than.
#
# The functions have the names, arguments and results of those that they stand in for.

LEAST_SAVING: Final = 0.1
"""Of a frame's cost: what saves less is not worth a second form of the same algebra, and numpy's must return."""
_SYMMETRIC: Final = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def plain_projections(sums: ArrayLike) -> tuple[FloatArray, list[bool]]:
    """Do what `windows.projections` does."""
    sums = np.asarray(sums, dtype=np.float64)
    total = sums[:, 0, 3]
    share = 1.0 / np.maximum(total, 1.0)
    mean = sums[:, 0, :3] * share[:, None]
    contrast = sums[:, 1, :3] / np.maximum(sums[:, 1, 3:], 1.0) - mean
    covariance = sums[:, 2:, :3] * share[:, None, None] - mean[:, :, None] * mean[:, None] + NOISE**2 * np.eye(3)
    n = np.linalg.solve(covariance, contrast[..., None])[..., 0]
    n /= np.maximum(np.vecdot(n, contrast), 1e-9)[:, None]
    usable = (total >= MIN_SURROUNDINGS) & (np.vecdot(contrast, contrast) >= MIN_CONTRAST**2)
    return np.column_stack([n, -np.vecdot(n, mean)]), usable.tolist()


def plain_levels(
    lines: FloatArray, moments: ArrayLike, products: ArrayLike, squares: ArrayLike
) -> tuple[FloatArray, list[bool]]:
    """Do what `windows.fitted_levels` does."""
    moments, products = np.asarray(moments, dtype=np.float64), np.asarray(products, dtype=np.float64)
    matrices = moments[..., _SYMMETRIC] + np.diag([TINY, RIDGE, RIDGE])
    planes = np.linalg.solve(matrices, products[..., None])[..., 0].swapaxes(0, 1)
    left_over = squares - np.vecdot(planes[1], products[:, 1])
    noise = (MISFIT * NOISE) ** 2 * np.vecdot(lines[:, :3], lines[:, :3]) * moments[:, 1, 0]
    return planes.reshape(-1, 3), (left_over > noise).tolist()


def with_plain_algebra(work: Callable[[ImageArray], object]) -> Callable[[ImageArray], None]:
    """Return some work with the detector, done with the numpy form."""
    unrolled = windows.projections, windows.fitted_levels

    def run(image: ImageArray) -> None:
        windows.projections, windows.fitted_levels = plain_projections, plain_levels  # type: ignore[assignment]
        try:
            work(image)
        finally:
            windows.projections, windows.fitted_levels = unrolled

    return run


def saving_rows(
    ours: Callable[[ImageArray], object], plain: Callable[[ImageArray], object], images: Sequence[ImageArray]
) -> tuple[Row, ...]:
    """Return what the unrolled algebra saves of the processor time that a frame takes with the numpy form.

    Args:
        ours: looks for markers in an image.
        plain: the same, by another detector.
        images: of one camera, in order.
    """
    spreads = lockstep({"ours": ours, "plain": with_plain_algebra(plain)}, {"ours": images, "plain": images})
    plain_s = spreads["plain"].seconds
    # Frame by frame: from one to the next a busy machine slows both.
    saved = float(np.median(1.0 - spreads["ours"].seconds / plain_s)) if plain_s.size else float("nan")
    note = "unrolled 3x3 algebra, processor time; the numpy form returns when it saves less"
    return (Row("saved by unrolled algebra", 100.0 * saved, "%", least=100.0 * LEAST_SAVING, note=note),)


Advance = Callable[[], None]

FROM_S: Final = 0.5
MILLI: Final = 1e3
MICRO: Final = 1e6


class SpeedScene:
    """Pictures of a simulated rig, rendered once, for all measurements.

    Args:
        rig: simulated, two cameras.
        seconds: how long the hand is watched.
        advance: called after each picture.

    Attributes:
        shots: moments and pictures in order of delivery.
        frames: what capture found in them.
        points: what fusion made of that.
    """

    def __init__(self, rig: Rig, seconds: float, advance: Advance) -> None:
        self.rig = rig
        self.world = World.from_rig(rig)
        cameras = Cameras(rig, self.world)
        self.shots: list[tuple[Moment, ImageArray]] = []
        for moment in moments(rig, FROM_S, FROM_S + seconds):
            self.shots.append((moment, cameras.picture(moment)))
            advance()
        capture = Capture(rig)
        self.frames = [capture.frame(moment, image) for moment, image in self.shots]
        self.points = points_of(FusionCore(rig), self.frames)

    @property
    def pictures(self) -> list[ImageArray]:
        """The pictures of the first camera."""
        first = next(iter(self.rig.config.cameras))
        return [image for moment, image in self.shots if moment.camera == first]


def points_of(core: FusionCore, frames: Sequence[MarkerFrame]) -> list[PointSet]:
    """Return what a fusion core publishes of frames."""
    return [cast(PointSet, points) for frame in frames for _, points in core.feed(frame)]


def capture_section(scene: SpeedScene) -> tuple[Section, dict[str, Spread]]:
    """Time the finding of markers in one camera's pictures, tracked and searched, turn by turn."""
    first = next(iter(scene.rig.config.cameras))
    ours, searching, unrolled, plain = (Capture(scene.rig).detectors[first] for _ in range(4))
    boxes = thesis_boxes(scene.rig, scene.pictures)
    thesis, thesis_searching = ThesisDetector(boxes), ThesisDetector(boxes)

    def searched(image: ImageArray) -> None:
        searching.reset()
        searching.detect(image)

    def thesis_searched(image: ImageArray) -> None:
        thesis_searching.reset()
        thesis_searching.detect(image)

    spreads = interleaved(
        scene.pictures,
        {
            "ours tracked": ours.detect,
            "thesis tracked": thesis.detect,
            "ours searched": searched,
            "thesis searched": thesis_searched,
        },
    )
    found = [len(thesis.detect(image)) for image in scene.pictures]
    rows = (
        *time_rows("all markers tracked", spreads["ours tracked"], "ms", MILLI),
        *time_rows("all markers tracked, thesis", spreads["thesis tracked"], "ms", MILLI),
        *ratio_rows("tracked", spreads["ours tracked"], spreads["thesis tracked"], most=1.0),
        *saving_rows(unrolled.detect, plain.detect, scene.pictures),
        *time_rows("all markers searched", spreads["ours searched"], "ms", MILLI),
        *time_rows("all markers searched, thesis", spreads["thesis searched"], "ms", MILLI),
        *ratio_rows("searched", spreads["ours searched"], spreads["thesis searched"], most=0.25),
        Row("markers that the thesis's detector finds", float(np.mean(found)), note=f"of {len(boxes)}, mean"),
    )
    return Section("Capture: one 640x480 frame", rows), spreads


def fusion_section(scene: SpeedScene) -> tuple[Section, dict[str, Spread]]:
    """Time one camera frame through fusion."""
    core = FusionCore(scene.rig)
    first = next(iter(true_cameras(scene.rig).values()))
    thesis = ThesisFusion(float(first.K[0, 0]), (float(first.K[0, 2]), float(first.K[1, 2])))
    names = dict(zip(scene.rig.config.cameras, ("left", "right"), strict=False))

    def thesis_feed(frame: MarkerFrame) -> None:
        markers = {name: (marker.u, marker.v) for name, marker in frame.markers.items()}
        thesis.feed(names[frame.camera], Arrival((frame.t_ns - scene.frames[0].t_ns) * 1e-9, markers))

    spreads = interleaved(scene.frames, {"ours": core.feed, "thesis": thesis_feed})
    method = scene.rig.config.fusion.method
    rows = (
        *time_rows(f"one camera frame, {method}", spreads["ours"], "µs", MICRO, most=250.0),
        *time_rows("one camera frame, thesis", spreads["thesis"], "µs", MICRO),
        *ratio_rows("one camera frame", spreads["ours"], spreads["thesis"]),
    )
    return Section("Fusion: six markers of one camera", rows), spreads


def thesis_fingers(model: HandModel) -> list[ThesisFinger]:
    """Return the thesis's chains with the bone lengths of a hand."""
    fingers = []
    for k, frame in enumerate(model.frames):
        a, b, c = model.bones[k].tolist()
        limits = HINGES_DEG[k]
        fingers.append(
            ThesisFinger(
                base=_vector(model.knuckles[k]),
                lengths=(a, b, c),
                axis=_vector(-frame[:, 0]),
                forward=_vector(-frame[:, 2]),
                rotor_rad=math.radians(ROTOR_DEG[k]),
                hinges_rad=(math.radians(limits[0]), math.radians(limits[1])),
            )
        )
    return fingers


def _vector(values: FloatArray) -> Vector3:
    x, y, z = values.tolist()
    return (x, y, z)


def ik_section(scene: SpeedScene) -> tuple[Section, dict[str, Spread]]:
    """Time five fingers, and a whole hand from a point set, beside FABRIK finger by finger."""
    side = scene.rig.config.sides[0]
    model = HandModel.from_file(scene.rig.hand, side)
    geometry = FingerGeometry.of(model, scene.rig.config.markers)
    solver, core, thesis = AnalyticFingers(geometry), HandCore(scene.rig), ThesisHand(thesis_fingers(model))
    t_s = FROM_S + np.linspace(0.0, scene.shots[-1][0].t_first_row_s - FROM_S, len(scene.points))
    angles = scene.world.sample(t_s).angles[side]
    targets = geometry.marker_points(angles)
    tips = model.finger_chains(angles)[0][..., 3, :]
    triples = [[_vector(tip) for tip in row] for row in tips]
    work = list(zip(targets, triples, scene.points, strict=True))
    spreads = interleaved(
        work,
        {
            "fingers": lambda item: solver.solve(item[0]),
            "hand": lambda item: core.feed(item[2]),
            "thesis": lambda item: thesis.solve(item[1]),
        },
    )
    found = np.array([thesis.solve(triple) for triple in triples])
    true = model.finger_chains(angles)[0]
    mine = model.finger_chains(solver.solve(targets).angles)[0]
    rows = (
        *time_rows("five fingers, closed form", spreads["fingers"], "µs", MICRO, most=150.0),
        *time_rows("five fingers, thesis's FABRIK", spreads["thesis"], "µs", MICRO),
        *ratio_rows("five fingers", spreads["fingers"], spreads["thesis"]),
        *time_rows("whole hand from a point set", spreads["hand"], "µs", MICRO),
        Row("middle joints from exact tips, closed form", _middle_mm(mine, true), "mm", note="PIP and DIP, mean"),
        Row("middle joints from exact tips, thesis's FABRIK", _middle_mm(found, true), "mm", note="PIP and DIP, mean"),
    )
    return Section("Inverse kinematics", rows), spreads


def _middle_mm(found: FloatArray, true: FloatArray) -> float:
    return float(np.linalg.norm(found - true, axis=-1)[..., 1:3].mean() * 1e3)


def pipeline_section(scene: SpeedScene) -> tuple[Section, Spread]:
    """Time the way from a picture in memory to the encoded pose in one process, both cameras' frames in a row."""
    capture, fusion, ik = Capture(scene.rig), FusionCore(scene.rig), HandCore(scene.rig)
    sent: list[int] = []

    def run(moment: Moment, image: ImageArray) -> None:
        for _, points in fusion.feed(capture.frame(moment, image)):
            for _, pose in ik.feed(cast(PointSet, points)):
                sent.append(len(encode(pose)))

    seconds = []
    with no_collection():
        for turn, (moment, image) in enumerate(scene.shots):
            before = len(sent)
            spent = timed(partial(run, moment, image))
            if turn >= 10 and len(sent) > before:
                seconds.append(spent)
    spread = Spread(np.array(seconds))
    rows = (
        Row("picture in memory to encoded pose, p50", spread.median * MILLI, "ms", most=4.0),
        Row("picture in memory to encoded pose, p99", spread.percentile(99.0) * MILLI, "ms", most=10.0),
        Row("poses for 100 camera frames", 100.0 * len(seconds) / max(len(scene.shots) - 10, 1)),
        Row("one pose encoded", float(np.mean(sent)) if sent else float("nan"), "bytes"),
    )
    return Section("End to end in one process, two cameras", rows), spread
