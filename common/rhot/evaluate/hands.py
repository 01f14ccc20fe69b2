"""How well whole hands are solved: joints, angles, limits and steps against a simulated world.

The stage that is judged gets point sets with the errors of a good fusion: known noise sideways and in depth, and only
the markers that two cameras see. What it answers is compared with the world at the same moments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.camera import CameraModel
from rhot.evaluate.coverage import visible_to_two
from rhot.hand import HandJoints, HandModel
from rhot.messages import HandPose, Point, PointSet, Position, Side
from rhot.sim.coverage import MarkerCoverage
from rhot.sim.world import World
from rhot.skeleton import FINGERS, JOINTS
from rhot.stage import Output
from rhot.wire_vectors import wire_position

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

START_NS: Final = 1_700_000_000_000_000_000
"""Rig time of the world's time 0 in generated point sets."""
ANGLES: Final = ("mcp_flexion", "mcp_abduction", "pip_flexion", "dip_flexion")
_MOST_HIDDEN: Final = 2
_GAP_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class PointNoise:
    """Errors of generated points, standard deviations, metres.

    Attributes:
        sideways_m, depth_m: of a marker's centre, across and along the line of sight from the rig's origin.
        corner_sideways_m, corner_depth_m: of a patch's corner about the patch's centre.
        bridge_s: how long a marker that hides is still sent, predicted.
    """

    sideways_m: float = 0.0003
    depth_m: float = 0.0012
    corner_sideways_m: float = 0.0002
    corner_depth_m: float = 0.0015
    bridge_s: float = 0.25


@dataclass(frozen=True, slots=True)
class HandRun:
    """Poses of one hand with the truth at the same moments; N poses.

    Attributes:
        t_s: (N,) seconds since the start of the world.
        positions, true_positions: (N, 26, 3) metres, rig frame, in the order of `rhot.skeleton.JOINTS`.
        angles, true_angles: (N, 5, 4) radians; columns as in `ANGLES`.
        measured: (N, 5) whether each finger was.
    """

    t_s: FloatArray
    positions: FloatArray
    true_positions: FloatArray
    angles: FloatArray
    true_angles: FloatArray
    measured: BoolArray


@dataclass(frozen=True, slots=True)
class HandFigures:
    """What a run shows; empty selections give NaN.

    Attributes:
        poses: how many were judged.
        joints_mm: mean error over all joints with every tip measured.
        joints_hidden_mm: the same with one or two tips hidden.
        joints_p95_mm: 95th percentile over all joints and poses.
        angles_deg: root mean square error of each kind of angle, over all fingers, every tip measured.
        angles_long_deg: the same without the thumb.
        step_mm: largest step of any joint from pose to pose, less the length of its true step; of poses at most 50 ms
            apart.
        step_off_mm: largest difference of a joint's step from its true step, in any direction.
        beyond_limits_deg: largest excess over a limit.
    """

    poses: int
    joints_mm: float
    joints_hidden_mm: float
    joints_p95_mm: float
    angles_deg: dict[str, float]
    angles_long_deg: dict[str, float]
    step_mm: float
    step_off_mm: float
    beyond_limits_deg: float


def simulated_points(
    world: World, cameras: Mapping[str, CameraModel], times_s: FloatArray, noise: PointNoise, seed: int = 0
) -> Iterator[PointSet]:
    """Yield what a good fusion would publish of a world at times (N,), seconds, in rising order.

    Args:
        world: the truth.
        cameras: the true cameras; a marker is measured when two of them see it.
        times_s: seconds since the start of the world.
        noise: errors of the points.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    coverages = {name: MarkerCoverage(camera, world) for name, camera in cameras.items()}
    sample = world.sample(times_s)
    last: dict[str, tuple[float, FloatArray, FloatArray]] = {}
    for row, t_s in enumerate(times_s.tolist()):
        visible = visible_to_two(coverages, t_s)
        points: dict[str, Point] = {}
        for name, centres in sample.markers.items():
            if name in visible:
                position = centres[row] + _noise(rng, centres[row], noise.sideways_m, noise.depth_m)
                before = last.get(name)
                velocity = np.zeros(3)
                if before is not None and 0.0 < t_s - before[0] < 0.1:
                    true_velocity = (centres[row] - centres[row - 1]) / (times_s[row] - times_s[row - 1])
                    velocity = true_velocity
                last[name] = (t_s, position, velocity)
                corners = _corners(world, sample.joints[world.markers[name].hand], row, name, position, rng, noise)
                sigma = float(np.sqrt(2.0 * noise.sideways_m**2 + noise.depth_m**2))
                points[name] = Point(
                    position=wire_position(position), sigma=sigma, views=2, state="measured", corners=corners
                )
            elif name in last and t_s - last[name][0] <= noise.bridge_s:
                gone_s, position, velocity = t_s - last[name][0], last[name][1], last[name][2]
                carried = position + velocity * 0.05 * (1.0 - np.exp(-gone_s / 0.05))
                points[name] = Point(
                    position=wire_position(carried), sigma=min(0.002 + 0.1 * gone_s, 1.0), views=0, state="predicted"
                )
        yield PointSet(t_ns=START_NS + round(t_s * 1e9), frame="rig", points=points)


def run_hand(
    feed: Callable[[PointSet], Sequence[Output]], world: World, side: Side, points: Iterable[PointSet]
) -> HandRun:
    """Give point sets to a stage's `feed` and keep its poses of one hand beside the truth."""
    poses = [pose for sample in points for _, pose in feed(sample) if isinstance(pose, HandPose) and pose.side == side]
    return against_truth(poses, world, side, START_NS)


def against_truth(poses: Sequence[HandPose], world: World, side: Side, start_t_ns: int) -> HandRun:
    """Return poses of one hand beside the truth at their own moments."""
    t_s = np.array([(pose.t_ns - start_t_ns) / 1e9 for pose in poses])
    if not poses:
        nothing = np.empty((0, 26, 3)), np.empty((0, 5, 4))
        return HandRun(t_s, nothing[0], nothing[0], nothing[1], nothing[1], np.empty((0, 5), dtype=np.bool_))
    sample = world.sample(t_s)
    positions = np.array([[pose.joints[name].position for name in JOINTS] for pose in poses])
    angles = np.array(
        [[[getattr(pose.angles[finger], angle) for angle in ANGLES] for finger in FINGERS] for pose in poses]
    )
    measured = np.array([[pose.fingers.get(finger) == "measured" for finger in FINGERS] for pose in poses])
    return HandRun(t_s, positions, sample.joints[side].positions, angles, sample.angles[side], measured)


def hand_figures(run: HandRun, model: HandModel, settle_s: float = 0.5) -> HandFigures:
    """Return the figures of a run, without its first `settle_s` seconds."""
    late = run.t_s >= run.t_s[:1].sum() + settle_s
    error = np.linalg.norm(run.positions - run.true_positions, axis=-1) * 1e3
    hidden = 5 - run.measured.sum(axis=1)
    full, partly = late & (hidden == 0), late & (hidden > 0) & (hidden <= _MOST_HIDDEN)
    wrong_deg = np.degrees(run.angles - run.true_angles)
    longer, off = (steps[late[1:]] * 1e3 for steps in excess_steps_m(run))
    excess = np.maximum(model.angle_min - run.angles, run.angles - model.angle_max)
    return HandFigures(
        poses=int(late.sum()),
        joints_mm=_mean(error[full]),
        joints_hidden_mm=_mean(error[partly]),
        joints_p95_mm=float(np.percentile(error[late], 95.0)) if late.any() else float("nan"),
        angles_deg={name: _rms(wrong_deg[full][..., k]) for k, name in enumerate(ANGLES)},
        angles_long_deg={name: _rms(wrong_deg[full][:, 1:, k]) for k, name in enumerate(ANGLES)},
        step_mm=float(longer.max()) if longer.size else float("nan"),
        step_off_mm=float(off.max()) if off.size else float("nan"),
        beyond_limits_deg=float(np.degrees(excess.max(initial=0.0))),
    )


def excess_steps_m(run: HandRun) -> tuple[FloatArray, FloatArray]:
    """Return how far the steps of the joints depart from the true ones, both (N − 1, 26), metres; 0 across gaps.

    First by how much each step is longer, then the length of the difference of the two, so that a step sideways counts
    as one forwards does. A gap is more than 50 ms.
    """
    steps, true_steps = np.diff(run.positions, axis=0), np.diff(run.true_positions, axis=0)
    longer: FloatArray = np.linalg.norm(steps, axis=-1) - np.linalg.norm(true_steps, axis=-1)
    off: FloatArray = np.linalg.norm(steps - true_steps, axis=-1)
    longer[np.diff(run.t_s) > _GAP_S] = off[np.diff(run.t_s) > _GAP_S] = 0.0
    return longer, off


def _noise(rng: np.random.Generator, at: FloatArray, sideways_m: float, depth_m: float) -> FloatArray:
    """Return noise (3,), metres, of a point as seen from the origin."""
    sight = at / np.sqrt(at @ at)
    white = rng.normal(size=3)
    along = float(white @ sight)
    noise: FloatArray = sideways_m * (white - along * sight) + depth_m * along * sight
    return noise


def _corners(
    world: World,
    joints: HandJoints,
    row: int,
    name: str,
    centre: FloatArray,
    rng: np.random.Generator,
    noise: PointNoise,
) -> tuple[Position, Position, Position, Position] | None:
    """Return the corners of a patch about its measured centre, with noise; none for a cap."""
    marker = world.markers[name]
    if marker.kind != "patch":
        return None
    now = HandJoints(joints.positions[row], joints.rotations[row])
    corners = world.hands[marker.hand].patch_corners(now, marker, name)
    noisy = np.array(
        [corner + _noise(rng, corner, noise.corner_sideways_m, noise.corner_depth_m) for corner in corners]
    )
    a, b, c, d = (wire_position(corner) for corner in noisy - noisy.mean(axis=0) + centre)
    return (a, b, c, d)


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if values.size else float("nan")


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")
