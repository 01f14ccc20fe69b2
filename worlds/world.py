"""One world, all of it drawn from a seed: hand, rig, look, timing, motions and boards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import nearest_rotation
from worlds.cameras import SIZE, Camera, Timing, random_rig
from worlds.contact import Solid, desk_gap, finger_points, least_gap, object_gap
from worlds.hand import FINGERS, MARKERS, Hand, marker_positions, rotation_xyz
from worlds.look import Look, random_look
from worlds.motion import (
    PALM_DOWN,
    POSE,
    States,
    Track,
    fastest_tip,
    random_gestures,
    random_rest,
    random_still,
    states,
)
from worlds.skin import with_patch

# The motion of `G2`: reach for an object, close the hand round it from above, lift, carry, put down, open.

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


KINDS: Final = ("cylinder", "box", "ball", "plate", "ring", "handle")
"""What is grasped: each worlds of its own."""


def random_solid(rng: np.random.Generator, hand: Hand, kind: str) -> Solid:
    """Draw an object of `KINDS` that the hand can hold from above; a plate is a thin box."""
    size = hand.length_mm / 172.0
    if kind == "ball":
        return Solid(kind, np.full(3, size * rng.uniform(27.0, 34.0)))
    if kind == "ring":
        bar = size * rng.uniform(6.0, 11.0)
        outer = size * rng.uniform(50.0, 65.0)
        return Solid(kind, np.array([outer, bar, outer]))
    if kind == "handle":
        return Solid(kind, size * np.array([rng.uniform(55.0, 70.0), rng.uniform(6.0, 11.0), rng.uniform(45.0, 55.0)]))
    half_height = size * rng.uniform(32.0, 45.0)
    if kind == "cylinder":
        radius = size * rng.uniform(25.0, 33.0)
        return Solid(kind, np.array([radius, radius, half_height]))
    if kind == "plate":
        return Solid("box", np.array([size * rng.uniform(30.0, 55.0), size * rng.uniform(4.0, 9.0), 1.2 * half_height]))
    return Solid(kind, np.array([size * rng.uniform(22.0, 28.0), size * rng.uniform(20.0, 28.0), half_height]))


def random_grasp(rng: np.random.Generator, hand: Hand, lasting_s: float, kind: str) -> Grasp | None:
    """Draw a grasp; None when none of the tried places lets at least three fingers and the thumb touch."""
    solid = random_solid(rng, hand, kind)
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
    closed = _wrapped(rng, hand, solid, opened, closed, wrist)
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
        touches = (fingers if solid.barred else tip_gaps)[stop, place] < 4.0
        score += (1.5 if finger == "thumb" else 1.0) * touches - 0.1 * (len(stops) == 0)
    return closed, score


def _wrapped(
    rng: np.random.Generator,
    hand: Hand,
    solid: Solid,
    opened: dict[str, float],
    closed: dict[str, float],
    wrist: dict[str, float],
) -> dict[str, float]:
    """Close the long fingers as tendons do: each joint goes on until a bone beyond it touches, then the tip slides.

    A knuckle stops when the proximal bone touches, the hinges when an outer bone does. A tip that has met the object
    first may slide along it: the knuckle bends on while the hinges give way. The thumb stays as `closed` has it.
    """
    T_object = np.eye(4)
    T_object[2, 3] = solid.half[2]
    angles = {**opened, **{name: value for name, value in closed.items() if name.startswith("thumb")}}

    def gaps(tried: dict[str, float]) -> FloatArray:
        """Return (4, 3) least distances of each bone of the long fingers, and below the desk, mm."""
        points, radii = finger_points(hand, states(hand, Track({**tried, **wrist}), np.zeros(1)).bones)
        apart = np.minimum(solid.distance(points[0] - T_object[:3, 3]) - radii, points[0, ..., 2] - radii - 2.6)
        return np.asarray(apart.reshape(5, 3, -1).min(axis=-1)[1:])

    # Fingers close alike: in recorded grasps (FPHA) knuckles and hinges of neighbours correlate by 0.85.
    slide = rng.uniform(0.0, 35.0) * (rng.random() < 0.6)
    rates = rng.uniform((0.6, 0.8), (1.6, 2.0))
    rate = {finger: rates * rng.uniform(0.8, 1.2, 2) for finger in FINGERS}
    slides = {finger: slide * rng.uniform(0.6, 1.4) for finger in FINGERS}
    for finger in FINGERS:
        knuckle, hinge = f"{finger}_mcp_flex", f"{finger}_pip_flex"
        row = FINGERS.index(finger)
        moving = {knuckle: rate[finger][0], hinge: rate[finger][1]}
        for _ in range(90):
            for name in list(moving):
                tried = {**angles, name: angles[name] + moving[name]}
                gap = gaps(tried)[row]
                beyond = gap if name == knuckle else gap[1:]
                if beyond.min() < _CONTACT_MM or tried[name] > (85.0 if name == knuckle else 105.0):
                    del moving[name]
                else:
                    angles = tried
            if not moving:
                break
        # Slide: what the knuckle bends more, the hinges give way by, until the proximal bone touches.
        left = slides[finger]
        while left > 0.0 and angles[knuckle] < 80.0:
            tried = {**angles, knuckle: angles[knuckle] + 1.0}
            while gaps(tried)[row, 1:].min() < _CONTACT_MM and tried[hinge] > 5.0:
                tried[hinge] -= 0.5
            if gaps(tried)[row].min() < _CONTACT_MM:
                break
            angles, left = tried, left - 1.0
    return angles


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


# A random right hand: its proportions, girth, paint and patch.

# Proportions of a hand of length 1, wrist to the tip of the middle finger; each hand varies about them.
_LENGTHS: Final = {
    "thumb": (0.225, 0.163, 0.157),
    "index": (0.226, 0.127, 0.128),
    "middle": (0.245, 0.148, 0.138),
    "ring": (0.230, 0.139, 0.136),
    "little": (0.177, 0.104, 0.118),
}
_MCP: Final = {
    "index": (0.125, 0.456, -0.010),
    "middle": (0.021, 0.470, -0.024),
    "ring": (-0.075, 0.444, -0.017),
    "little": (-0.158, 0.396, 0.005),
}
_CMC: Final = (0.107, 0.077, 0.036)
_RADII: Final = {
    "thumb": (0.068, 0.055, 0.050, 0.042),
    "index": (0.051, 0.045, 0.039, 0.034),
    "middle": (0.052, 0.046, 0.040, 0.035),
    "ring": (0.050, 0.044, 0.038, 0.033),
    "little": (0.045, 0.039, 0.034, 0.029),
}
_FAN_DEG: Final = {"index": 4.0, "middle": 0.5, "ring": -4.5, "little": -10.0}
_THUMB_BASE: Final = ((0.573, 0.571, -0.588), (-0.681, 0.731, 0.045), (0.456, 0.375, 0.807))


def random_hand(rng: np.random.Generator) -> Hand:
    """Draw a hand of 155 to 205 mm; its patch still lies at the wrist (see `skin.with_patch`)."""
    scale = rng.uniform(155.0, 205.0)
    girth = rng.uniform(0.90, 1.12)
    lengths, radii, painted, pulp = {}, {}, {}, {}
    for finger in MARKERS[:5]:
        first, second, third = (scale * part * rng.uniform(0.93, 1.07) for part in _LENGTHS[finger])
        lengths[finger] = (first, second, third)
        own = girth * rng.uniform(0.95, 1.05)
        a, b, c, d = (scale * part * own for part in _RADII[finger])
        radii[finger] = (a, b, c, d)
        painted[finger] = float(np.clip(rng.uniform(11.0, 24.0), 10.0, 0.86 * third))
        pulp[finger] = rng.uniform(0.2, 0.8)
    mcp = {finger: scale * np.array(place) + rng.uniform(-2.0, 2.0, 3) for finger, place in _MCP.items()}
    # The three measures by which length is told must add up to the length that was drawn.
    stretch = scale / (float(np.linalg.norm(mcp["middle"])) + sum(lengths["middle"]))
    first, second, third = lengths["middle"]
    lengths["middle"] = (stretch * first, stretch * second, stretch * third)
    mcp["middle"] = stretch * mcp["middle"]
    painted["middle"] = min(painted["middle"], 0.86 * lengths["middle"][2])
    turn = rng.uniform(-14.0, 14.0, 3) * np.array([1.0, 0.8, 1.0])
    fan = {finger: angle * rng.uniform(0.6, 1.3) + rng.uniform(-1.0, 1.0) for finger, angle in _FAN_DEG.items()}
    return Hand(
        lengths=lengths,
        mcp=mcp,
        cmc=scale * np.array(_CMC) + rng.uniform(-2.5, 2.5, 3),
        thumb_base=rotation_xyz(turn) @ nearest_rotation(np.array(_THUMB_BASE)),
        fan_deg=fan,
        radii=radii,
        painted=painted,
        pulp=pulp,
        patch=(float(rng.integers(28, 43)), float(rng.integers(20, 31)), 0.5),
        T_hand_patch=np.eye(4),
    )


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
    """Return the world of a seed; seeds in turn grasp each of `KINDS`."""
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
        lambda: random_grasp(rng, hand, spans["G2"], KINDS[seed % len(KINDS)]),
        lambda made: _graspable(cameras, hand, made, spans["G2"]),
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
    return is_possible(hand, grasp, lasting_s) and _seen(cameras, hand, _moments(hand, grasp, lasting_s))


def is_possible(hand: Hand, grasp: Grasp, lasting_s: float) -> bool:
    """Return whether a grasp is slow enough, and nothing passes through anything else."""
    if fastest_tip(hand, grasp.track, lasting_s) > _FASTEST[1]:
        return False
    motion = _moments(hand, grasp, lasting_s)
    if least_gap(hand, motion) < -1.2 or desk_gap(hand, motion) < 2.0 or motion.T_world_object is None:
        return False
    corners = grasp.solid.half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    foot = (motion.T_world_object[:, :3, :3] @ corners.T)[:, 2].min(axis=1) + motion.T_world_object[:, 2, 3]
    return float(foot.min()) > -1.5 and float(object_gap(hand, motion, grasp.solid, motion.T_world_object).min()) > -1.2


def _moments(hand: Hand, grasp: Grasp, lasting_s: float) -> States:
    return grasp.states(hand, np.arange(-0.02, lasting_s + 0.02, 0.02))


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
