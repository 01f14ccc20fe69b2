"""How well whole hands are solved: joints, angles, limits and steps against a simulated world.

The stage that is judged gets point sets with the errors of a good fusion: known noise sideways and in depth, and only
the markers that two cameras see. What it answers is compared with the world at the same moments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGER_ANGLES, FINGERS, JOINTS
from rhot.arrays import BoolArray, FloatArray
from rhot.messages import HandPose, Side
from rhot_sim.comparison.accuracy import NEAR_FRAMES, visible_to_two
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_sim.world.world import World
from rhot_tools.measures.points import PointTrack

# What could be seen over time against what was reported: coverage, and how occlusions are survived.

SHORT_S: Final = 0.25
"""An occlusion up to this long is to be bridged."""
BACK_S: Final = 0.05
"""A marker is to be measured again this soon after both cameras see it again."""


@dataclass(frozen=True, slots=True)
class Survival:
    """What became of markers that were hidden for a while.

    Attributes:
        samples: (moment, marker) pairs in view of two cameras.
        measured: share of them that was measured.
        occlusions: short ones, with sight before and after.
        survived: share of these that were reported all through, and measured again in time.
        back_s: median time from sight to measurement, of all occlusions; NaN without any.
    """

    samples: int
    measured: float
    occlusions: int
    survived: float
    back_s: float


def visible_markers(cameras: Mapping[str, MarkerCoverage], names: Sequence[str], times_s: FloatArray) -> BoolArray:
    """Return (T, M) which markers at least two cameras see at times (T,), seconds since the world's start."""
    rows = [visible_to_two(cameras, t_s) for t_s in times_s.tolist()]
    return np.array([[name in row for name in names] for row in rows], dtype=np.bool_).reshape(-1, len(names))


def survival(track: PointTrack, times_s: FloatArray, visible: BoolArray, rate_hz: float) -> Survival:
    """Compare what could be seen with what was reported.

    Args:
        track: reported points.
        times_s: (T,) moments, evenly spaced, rising.
        visible: (T, M) which markers could be seen then.
        rate_hz: of the cameras.
    """
    reported, measured = _states(track, times_s, NEAR_FRAMES / rate_hz)
    samples = int(visible.sum())
    short, survived = 0, 0
    back: list[float] = []
    step_s = float(times_s[1] - times_s[0]) if len(times_s) > 1 else BACK_S
    for column in range(visible.shape[1]):
        for begin, end in _gaps(visible[:, column]):
            again = np.flatnonzero(measured[end:, column])
            wait_s = float(again[0]) * step_s if again.size else float("inf")
            back.append(wait_s)
            if (end - begin) * step_s <= SHORT_S:
                short += 1
                survived += bool(reported[begin:end, column].all() and wait_s <= BACK_S)
    return Survival(
        samples=samples,
        measured=float((measured & visible).sum() / samples) if samples else float("nan"),
        occlusions=short,
        survived=survived / short if short else float("nan"),
        back_s=float(np.median(back)) if back else float("nan"),
    )


def _states(track: PointTrack, times_s: FloatArray, near_s: float) -> tuple[BoolArray, BoolArray]:
    """Return (T, M) whether a marker was reported, and measured, in a set at most so near to each moment."""
    reported = np.zeros((len(times_s), len(track.names)), dtype=np.bool_)
    measured = reported.copy()
    there = np.isfinite(track.positions[:, :, 0])
    after = np.searchsorted(track.t_s, times_s)
    for index in (after - 1, after):
        row = np.clip(index, 0, max(len(track.t_s) - 1, 0))
        if not len(track.t_s):
            break
        near = (np.abs(track.t_s[row] - times_s) <= near_s)[:, None]
        reported |= there[row] & near
        measured |= track.measured[row] & near
    return reported, measured


def _gaps(visible: BoolArray) -> list[tuple[int, int]]:
    """Return first and past-the-last index of each stretch without sight that has sight before and after."""
    change = np.diff(visible.astype(np.int8))
    begins, ends = np.flatnonzero(change == -1) + 1, np.flatnonzero(change == 1) + 1
    gaps = []
    for begin in begins.tolist():
        later = ends[ends > begin]
        if later.size:
            gaps.append((begin, int(later[0])))
    return gaps


START_NS: Final = 1_700_000_000_000_000_000
"""Rig time of the world's time 0 in generated point sets."""
_GAP_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class HandRun:
    """Poses of one hand with the truth at the same moments; N poses.

    Attributes:
        t_s: (N,) seconds since the start of the world.
        positions, true_positions: (N, 26, 3) metres, rig frame, in the order of `rhot.anatomy.skeleton.JOINTS`.
        angles, true_angles: (N, 5, 4) radians; columns as in `FINGER_ANGLES`.
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
    step_mm: float
    step_off_mm: float
    beyond_limits_deg: float


def against_truth(poses: Sequence[HandPose], world: World, side: Side, start_t_ns: int) -> HandRun:
    """Return poses of one hand beside the truth at their own moments."""
    t_s = np.array([(pose.t_ns - start_t_ns) / 1e9 for pose in poses])
    if not poses:
        nothing = np.empty((0, 26, 3)), np.empty((0, 5, 4))
        return HandRun(t_s, nothing[0], nothing[0], nothing[1], nothing[1], np.empty((0, 5), dtype=np.bool_))
    sample = world.sample(t_s)
    positions = np.array([[pose.joints[name].position for name in JOINTS] for pose in poses])
    angles = np.array(
        [[[getattr(pose.angles[finger], angle) for angle in FINGER_ANGLES] for finger in FINGERS] for pose in poses]
    )
    measured = np.array([[pose.fingers.get(finger) == "measured" for finger in FINGERS] for pose in poses])
    return HandRun(t_s, positions, sample.joints[side].positions, angles, sample.angles[side], measured)


def hand_figures(run: HandRun, model: HandModel, settle_s: float = 0.5) -> HandFigures:
    """Return the figures of a run, without its first `settle_s` seconds."""
    late = run.t_s >= run.t_s[:1].sum() + settle_s
    error = np.linalg.norm(run.positions - run.true_positions, axis=-1) * 1e3
    hidden = 5 - run.measured.sum(axis=1)
    most_hidden = 2
    full, partly = late & (hidden == 0), late & (hidden > 0) & (hidden <= most_hidden)
    wrong_deg = np.degrees(run.angles - run.true_angles)
    longer, off = (steps[late[1:]] * 1e3 for steps in excess_steps_m(run))
    excess = np.maximum(model.angle_min - run.angles, run.angles - model.angle_max)
    return HandFigures(
        poses=int(late.sum()),
        joints_mm=_mean(error[full]),
        joints_hidden_mm=_mean(error[partly]),
        joints_p95_mm=float(np.percentile(error[late], 95.0)) if late.any() else float("nan"),
        angles_deg={name: _rms(wrong_deg[full][..., k]) for k, name in enumerate(FINGER_ANGLES)},
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


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if values.size else float("nan")


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")
