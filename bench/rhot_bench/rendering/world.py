"""One world, all of it drawn from a seed: hand, rig, look, timing, motions and boards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np

from rhot.arrays import FloatArray
from rhot_bench.rendering.anatomy import random_hand
from rhot_bench.rendering.cameras import SIZE, Camera, Timing, random_rig
from rhot_bench.rendering.contact import desk_gap, least_gap, object_gap
from rhot_bench.rendering.grasp import Grasp, random_grasp
from rhot_bench.rendering.hand import Hand, marker_positions, rotation_xyz
from rhot_bench.rendering.look import Look, random_look
from rhot_bench.rendering.motion import States, Track, fastest_tip, random_gestures, random_still, states
from rhot_bench.rendering.skin import with_patch

COUNTS: Final = {"G1": 63, "G2": 70, "K": 1, "C": 14}
"""Pairs of each sequence."""
BOARD: Final = (9, 6, 25.0)
"""Inner corners along and across, side of a square in mm."""
_FIRST_NS: Final = {"G1": 210, "G2": 220, "K": 250, "C": 300}
_FASTEST: Final = (700.0, 1200.0)
_MARGIN_PX: Final = 14.0
_DRAWS: Final = 600
_Made = TypeVar("_Made")


@dataclass(frozen=True, slots=True)
class World:
    """A world.

    Attributes:
        seed: that it came from.
        hand, look: what it shows.
        cameras: by name.
        timings: by sequence.
        gestures, grasp, still: the motions of `G1`, `G2` and `K`.
        boards: (14, 4, 4) world from board, mm; origin the middle of the corner grid, z away from the cameras.
    """

    seed: int
    hand: Hand
    look: Look
    cameras: dict[str, Camera]
    timings: dict[str, Timing]
    gestures: Track
    grasp: Grasp
    still: Track
    boards: FloatArray

    def states(self, sequence: str, t_ns: FloatArray) -> States:
        """Return hand and object of `G1`, `G2` or `K` at times (N,) on the recording's clock."""
        t_s = (np.asarray(t_ns, float) - self.timings[sequence].first_ns) * 1e-9
        if sequence == "G2":
            return self.grasp.states(self.hand, t_s)
        return states(self.hand, self.gestures if sequence == "G1" else self.still, t_s)


def make_world(seed: int) -> World:
    """Return the world of a seed."""
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(6)]
    hand = with_patch(random_hand(streams[0]), streams[0])
    cameras = random_rig(streams[1])
    timings = _random_timings(streams[2])
    camera = cameras["left"]
    height = float(np.linalg.inv(camera.T_camera_world)[2, 3])
    look = random_look(streams[3], SIZE[0] * height / camera.K[0, 0])
    spans = {name: (timing.end_ns - timing.first_ns) * 1e-9 for name, timing in timings.items()}
    rng = streams[4]
    still = _first(
        lambda: random_still(rng, hand), lambda track: _seen(cameras, hand, states(hand, track, np.zeros(1)), 25.0)
    )
    gestures = _first(
        lambda: random_gestures(rng, hand, spans["G1"]), lambda track: _possible(cameras, hand, track, spans["G1"])
    )
    grasp = _first(
        lambda: random_grasp(rng, hand, spans["G2"]), lambda made: _graspable(cameras, hand, made, spans["G2"])
    )
    return World(seed, hand, look, cameras, timings, gestures, grasp, still, _random_boards(streams[5], cameras))


def _first(draw: Callable[[], _Made | None], fits: Callable[[_Made], bool]) -> _Made:
    """Return the first draw that fits.

    Raises:
        RuntimeError: none did.
    """
    for _ in range(_DRAWS):
        made = draw()
        if made is not None and fits(made):
            return made
    raise RuntimeError(f"no possible motion in {_DRAWS} draws; take another seed")


def _random_timings(rng: np.random.Generator) -> dict[str, Timing]:
    readout = float(np.round(rng.uniform(0.004, 0.016), 4))
    exposure = float(np.round(rng.uniform(0.002, 0.008), 4))
    timings = {}
    for name, count in COUNTS.items():
        rate = 1.0 if name == "C" else float(rng.integers(35, 61) if name == "G1" else rng.integers(25, 36))
        period = round(1e9 / min(rate, 0.95 / readout))
        after = round(rng.uniform(0.0, 0.95) * (period if name != "C" else 30e6))
        timings[name] = Timing(_FIRST_NS[name] * 10**9, period, after, count, exposure, readout)
    return timings


def _seen(cameras: dict[str, Camera], hand: Hand, motion: States, margin: float = _MARGIN_PX) -> bool:
    """Return whether every marker stays within both pictures."""
    at = marker_positions(hand, motion.bones)
    for camera in cameras.values():
        pixels = camera.project(at)
        if pixels.min() < margin or (pixels > np.array(SIZE) - 1 - margin).any():
            return False
    return True


def _possible(cameras: dict[str, Camera], hand: Hand, track: Track, lasting_s: float) -> bool:
    if not _FASTEST[0] <= fastest_tip(hand, track, lasting_s) <= _FASTEST[1]:
        return False
    motion = states(hand, track, np.arange(-0.02, lasting_s + 0.02, 0.02))
    return _seen(cameras, hand, motion) and least_gap(hand, motion) > -0.8 and desk_gap(hand, motion) > 8.0


def _graspable(cameras: dict[str, Camera], hand: Hand, grasp: Grasp, lasting_s: float) -> bool:
    if fastest_tip(hand, grasp.track, lasting_s) > _FASTEST[1]:
        return False
    motion = grasp.states(hand, np.arange(-0.02, lasting_s + 0.02, 0.02))
    if not _seen(cameras, hand, motion) or least_gap(hand, motion) < -1.2 or desk_gap(hand, motion) < 2.0:
        return False
    if motion.T_world_object is None:
        return False
    corners = grasp.solid.half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    foot = (motion.T_world_object[:, :3, :3] @ corners.T)[:, 2].min(axis=1) + motion.T_world_object[:, 2, 3]
    return float(foot.min()) > -1.5 and float(object_gap(hand, motion, grasp.solid, motion.T_world_object).min()) > -1.2


def _random_boards(rng: np.random.Generator, cameras: dict[str, Camera]) -> FloatArray:
    columns, rows, square = BOARD
    u, v = np.meshgrid(np.array([-1, columns]) - (columns - 1) / 2, np.array([-1, rows]) - (rows - 1) / 2)
    outline = np.stack([u.ravel() * square, v.ravel() * square, np.zeros(4)], 1) * 1.06
    boards: list[FloatArray] = []
    while len(boards) < COUNTS["C"]:
        pose = np.eye(4)
        tilt = np.array([*rng.uniform(-28, 28, 2), rng.uniform(-40, 40) + rng.choice([0.0, 0.0, 180.0])])
        pose[:3, :3] = rotation_xyz(tilt) @ np.diag([1.0, -1.0, -1.0])
        pose[:3, 3] = [rng.uniform(-150, 150), rng.uniform(-120, 120), rng.uniform(60, 170)]
        corners = outline @ pose[:3, :3].T + pose[:3, 3]
        pixels = np.concatenate([camera.project(corners) for camera in cameras.values()])
        inside = pixels.min() > 6.0 and (pixels < np.array(SIZE) - 7.0).all()
        if inside and corners[:, 2].min() > 5.0:
            boards.append(pose)
    return np.stack(boards)


def board_corners() -> FloatArray:
    """Return (54, 3) inner corners in the board frame, row-major, mm."""
    columns, rows, square = BOARD
    u, v = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    return np.stack([u.ravel() * square, v.ravel() * square, np.zeros(u.size)], 1)
