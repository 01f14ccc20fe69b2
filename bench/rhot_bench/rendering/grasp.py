"""The motion of `G2`: reach for an object, close the hand round it from above, lift, carry, put down, open."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_bench.rendering.contact import Solid, finger_points, object_gap
from rhot_bench.rendering.hand import FINGERS, MARKERS, Hand, rotation_xyz
from rhot_bench.rendering.motion import PALM_DOWN, POSE, States, Track, random_rest, states

_CONTACT_MM: Final = 0.4
"""Gap at which a closing finger stops."""


@dataclass(frozen=True, slots=True)
class Grasp:
    """A grasp and its carry.

    Attributes:
        track: of the hand.
        solid: what is grasped.
        T_world_start: (4, 4) of the object before it is lifted.
        held_s: when it starts and when it ceases to move with the hand.
    """

    track: Track
    solid: Solid
    T_world_start: FloatArray
    held_s: tuple[float, float]

    def states(self, hand: Hand, t_s: FloatArray) -> States:
        """Return hand and object at times (N,)."""
        moved = states(hand, self.track, t_s)
        held = states(hand, self.track, np.clip(t_s, *self.held_s)).T_world_hand
        at_start = states(hand, self.track, np.array([self.held_s[0]])).T_world_hand[0]
        return replace(moved, T_world_object=held @ np.linalg.inv(at_start) @ self.T_world_start)


def random_solid(rng: np.random.Generator, hand: Hand) -> Solid:
    """Draw a cylinder, a box or a ball that the hand can hold from above."""
    size = hand.length_mm / 172.0
    kind = str(rng.choice(["cylinder", "box", "ball"]))
    if kind == "ball":
        return Solid(kind, np.full(3, size * rng.uniform(27.0, 34.0)))
    half_height = size * rng.uniform(32.0, 45.0)
    if kind == "cylinder":
        radius = size * rng.uniform(25.0, 33.0)
        return Solid(kind, np.array([radius, radius, half_height]))
    return Solid(kind, np.array([size * rng.uniform(22.0, 28.0), size * rng.uniform(20.0, 28.0), half_height]))


def random_grasp(rng: np.random.Generator, hand: Hand, lasting_s: float) -> Grasp | None:
    """Draw a grasp; None when none of the tried places lets at least three fingers and the thumb touch."""
    solid = random_solid(rng, hand)
    rest = random_rest(rng)
    opened = dict(rest)
    for finger in FINGERS:
        opened[f"{finger}_mcp_flex"] = rng.uniform(8.0, 18.0)
        opened[f"{finger}_pip_flex"] = rng.uniform(12.0, 24.0)
    opened.update(thumb_cmc_flex=rng.uniform(-10, -4), thumb_cmc_abd=rng.uniform(2, 10))
    best: tuple[float, dict[str, float], dict[str, float]] | None = None
    for _ in range(60):
        wrist = _random_wrist(rng, hand, solid)
        closed, score = _close(hand, solid, opened, wrist)
        if best is None or score > best[0]:
            best = score, closed, wrist
    if best is None or best[0] < 4.0:
        return None
    _, closed, wrist = best
    return _scheduled(rng, hand, solid, rest, opened, closed, wrist, lasting_s)


def _random_wrist(rng: np.random.Generator, hand: Hand, solid: Solid) -> dict[str, float]:
    """Return a pose of the wrist about an object that stands at the world's origin, its foot on the desk."""
    size = hand.length_mm / 172.0
    pitch, roll, yaw = rng.uniform(-32.0, -4.0), rng.uniform(-14.0, 8.0), rng.uniform(-20.0, 25.0)
    rotation = rotation_xyz(np.array([pitch, roll, yaw])) @ PALM_DOWN
    # The top of the object in the hand frame: under the palm or a little before the knuckles.
    top = size * np.array([rng.uniform(-8.0, 22.0), rng.uniform(55.0, 100.0), rng.uniform(20.0, 42.0)])
    wrist = np.array([0.0, 0.0, 2.0 * solid.half[2]]) - rotation @ top
    return dict(zip(POSE, (*map(float, wrist), pitch, roll, yaw), strict=True))


def _close(
    hand: Hand, solid: Solid, opened: dict[str, float], wrist: dict[str, float]
) -> tuple[dict[str, float], float]:
    """Close each finger until it touches; return the angles and how many distal bones touch."""
    T_object = np.eye(4)
    T_object[2, 3] = solid.half[2]
    start = states(hand, Track({**opened, **wrist}), np.zeros(1))
    gaps = object_gap(hand, start, solid, T_object)[0]
    if gaps.min() < 1.0:
        return opened, -1.0
    share = np.linspace(0.0, 1.0, 61)
    full = {
        f"{f}_{joint}": value
        for f in FINGERS
        for joint, value in (("mcp_flex", 70.0), ("pip_flex", 85.0), ("mcp_abd", 0.0))
    }
    full.update(thumb_cmc_flex=34.0, thumb_cmc_abd=14.0, thumb_mcp_flex=24.0, thumb_ip_flex=40.0)
    values = {name: value + share * (full.get(name, value) - value) for name, value in opened.items()}
    track = _Sampled({**values, **{name: np.full(61, value) for name, value in wrist.items()}})
    closing = states(hand, track, share)  # type: ignore[arg-type]
    fingers = object_gap(hand, closing, solid, T_object)[:, :5]
    tips, radii = finger_points(hand, closing.bones)
    tip_gaps = (solid.distance(tips[:, :, 10:] - T_object[:3, 3]) - radii[:, 10:]).min(axis=-1)
    low = (tips[..., 2] - radii).min(axis=-1)
    closed, score = dict(opened), 0.0
    for place, finger in enumerate(MARKERS[:5]):
        stops = np.nonzero((fingers[:, place] < _CONTACT_MM) | (low[:, place] < 3.0))[0]
        stop = int(stops[0]) - 1 if len(stops) else int(0.85 * 60)
        stop = max(stop, 0)
        for name in opened:
            if name.startswith(finger):
                closed[name] = float(values[name][stop])
        touches = tip_gaps[stop, place] < 4.0
        score += (1.5 if finger == "thumb" else 1.0) * touches - 0.1 * (len(stops) == 0)
    return closed, score


@dataclass(frozen=True, slots=True)
class _Sampled:
    """Values given at the very times that are asked for."""

    values: dict[str, FloatArray]

    def __call__(self, t_s: FloatArray) -> dict[str, FloatArray]:
        return dict(self.values)


def _scheduled(
    rng: np.random.Generator,
    hand: Hand,
    solid: Solid,
    rest: dict[str, float],
    opened: dict[str, float],
    closed: dict[str, float],
    wrist: dict[str, float],
    lasting_s: float,
) -> Grasp:
    """Lay the grasp out in time and on the desk."""
    way = rng.uniform(110.0, 190.0)
    heading = np.radians(rng.uniform(-30.0, 30.0) + rng.choice([0.0, 180.0]))
    move = way * np.array([np.cos(heading), 0.7 * np.sin(heading)])
    first = -0.5 * move + np.array([rng.uniform(-20, 20), rng.uniform(-10, 25)])
    at = {**wrist, "x": wrist["x"] + first[0], "y": wrist["y"] + first[1]}
    away = {
        **at,
        "x": at["x"] + rng.uniform(-70, 70),
        "y": at["y"] - rng.uniform(20, 60),
        "z": at["z"] + rng.uniform(25, 45),
        "pitch": 0.4 * at["pitch"],
        "yaw": at["yaw"] + rng.uniform(-12, 12),
    }
    T = lasting_s
    track = Track({**rest, **away})
    for name, value in opened.items():
        track.to(name, 0.05 * T, 0.20 * T, value)
    for name in ("x", "y", "pitch", "roll", "yaw"):
        track.to(name, 0.0, 0.24 * T, at[name])
    above = at["z"] + rng.uniform(20.0, 35.0)
    track.to("z", 0.0, 0.18 * T, above)
    track.to("z", 0.16 * T, 0.16 * T, at["z"])
    _move_fingers(rng, track, closed, 0.31 * T, 0.13 * T, 0.025 * T)
    lifted = at["z"] + rng.uniform(30.0, 55.0)
    track.to("z", 0.47 * T, 0.14 * T, lifted)
    for name, change in (("x", move[0]), ("y", move[1]), ("yaw", rng.uniform(-15, 15))):
        track.to(name, 0.52 * T, 0.24 * T, at[name] + change)
    for name in ("pitch", "roll"):
        track.to(name, 0.49 * T, 0.14 * T, at[name] + rng.uniform(-6, 6))
        track.to(name, 0.63 * T, 0.14 * T, at[name])
    track.to("z", 0.65 * T, 0.13 * T, at["z"])
    _move_fingers(rng, track, opened, 0.80 * T, 0.11 * T, 0.02 * T)
    track.to("z", 0.89 * T, 0.14 * T, at["z"] + rng.uniform(40, 70))
    track.to("y", 0.90 * T, 0.14 * T, at["y"] + move[1] - rng.uniform(15, 40))
    T_start = np.eye(4)
    T_start[:2, 3], T_start[2, 3] = first, solid.half[2]
    return Grasp(track, solid, T_start, (0.465 * T, 0.79 * T))


def _move_fingers(
    rng: np.random.Generator, track: Track, angles: dict[str, float], at_s: float, lasting_s: float, latest_s: float
) -> None:
    """Move all fingers to angles, each at its own time, at most `latest_s` late."""
    for finger in MARKERS[:5]:
        late_s = rng.uniform(0.0, latest_s)
        for name, value in angles.items():
            if name.startswith(finger):
                track.to(name, at_s + late_s, lasting_s, value)
