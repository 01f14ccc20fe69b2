"""How a hand moves: sums of minimum-jerk steps, and the gestures of `G1` and the still hand of `K`.

The world frame is that of `cameras`. Times are seconds from the first left picture.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from worlds.hand import (
    ANGLES,
    DIP_OF_PIP,
    FINGERS,
    MARKERS,
    Hand,
    bone_poses,
    rotation_xyz,
)
from worlds.skin import FOREARM_MM

PALM_DOWN: Final = np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
"""World from hand: right hand, palm to the desk, fingers up in the picture."""
POSE: Final = ("x", "y", "z", "pitch", "roll", "yaw")
"""Where the wrist is (mm, world) and how the hand is turned from `PALM_DOWN` (degrees about x, y, z of the world)."""


@dataclass(slots=True)
class Track:
    """Named values over time, each a start value plus minimum-jerk steps (Flash and Hogan 1985); steps may overlap.

    Attributes:
        start: value of each name before its first step.
        steps: name, start time, duration, change.
    """

    start: dict[str, float]
    steps: list[tuple[str, float, float, float]] = field(default_factory=list)

    def to(self, name: str, at_s: float, lasting_s: float, value: float) -> None:
        """Move a value to a new one; steps of one name must be added in order of time."""
        now = self.start[name] + sum(change for n, *_, change in self.steps if n == name)
        self.steps.append((name, at_s, lasting_s, value - now))

    def __call__(self, t_s: FloatArray) -> dict[str, FloatArray]:
        """Return each value at times (N,)."""
        values = {name: np.full(len(t_s), value) for name, value in self.start.items()}
        for name, begin, lasting, change in self.steps:
            s = np.clip((t_s - begin) / lasting, 0.0, 1.0)
            values[name] = values[name] + change * s**3 * (10.0 + s * (6.0 * s - 15.0))
        return values


@dataclass(frozen=True, slots=True)
class States:
    """The hand at several instants.

    Attributes:
        t_s: (N,).
        angles: (N, 20) degrees.
        T_world_hand: (N, 4, 4) mm.
        bones: (N, 16, 4, 4) world from bone, mm.
        T_world_object: (N, 4, 4) mm, or None.
    """

    t_s: FloatArray
    angles: FloatArray
    T_world_hand: FloatArray
    bones: FloatArray
    T_world_object: FloatArray | None = None


def states(hand: Hand, track: Track, t_s: FloatArray) -> States:
    """Return the hand along a track."""
    values = track(t_s)
    for finger in FINGERS:
        values[f"{finger}_dip_flex"] = DIP_OF_PIP * values[f"{finger}_pip_flex"]
    angles = np.stack([values[name] for name in ANGLES], axis=1)
    pose = np.tile(np.eye(4), (len(t_s), 1, 1))
    pose[:, :3, :3] = rotation_xyz(np.stack([values[name] for name in POSE[3:]], axis=1)) @ PALM_DOWN
    pose[:, :3, 3] = np.stack([values[name] for name in POSE[:3]], axis=1)
    return States(t_s, angles, pose, pose[:, None] @ bone_poses(hand, angles))


def forearm_poses(T_world_hand: FloatArray) -> FloatArray:
    """Return (N, 4, 4) poses of the forearm: from the wrist to an elbow that stays low, behind the picture's edge."""
    wrist = T_world_hand[:, :3, 3]
    mean = T_world_hand.mean(axis=0)
    elbow = mean[:3, 3] - FOREARM_MM * np.array([0.5 * mean[0, 1], 1.0, 0.0])
    elbow[2] = 60.0
    y = wrist - elbow
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    x = T_world_hand[:, :3, 0] - (T_world_hand[:, :3, 0] * y).sum(axis=1, keepdims=True) * y
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    pose = np.tile(np.eye(4), (len(wrist), 1, 1))
    pose[:, :3, :3] = np.stack([x, y, np.cross(x, y)], axis=-1)
    pose[:, :3, 3] = wrist
    return pose


def random_rest(rng: np.random.Generator) -> dict[str, float]:
    """Return the angles of an open, relaxed hand."""
    rest = {
        "thumb_cmc_flex": rng.uniform(-10.0, 0.0),
        "thumb_cmc_abd": rng.uniform(-6.0, 6.0),
        "thumb_mcp_flex": rng.uniform(3.0, 14.0),
        "thumb_ip_flex": rng.uniform(4.0, 16.0),
    }
    for finger in FINGERS:
        rest[f"{finger}_mcp_flex"] = rng.uniform(2.0, 14.0)
        rest[f"{finger}_mcp_abd"] = {"index": 2.0, "middle": 0.0, "ring": -2.0, "little": -4.0}[finger] + rng.uniform(
            -2, 2
        )
        rest[f"{finger}_pip_flex"] = rng.uniform(5.0, 18.0)
    return rest


def random_place(rng: np.random.Generator, hand: Hand) -> dict[str, float]:
    """Return a pose of the wrist such that the open hand lies about the middle of the desk."""
    yaw = rng.uniform(-25.0, 20.0)
    reach = 0.55 * hand.length_mm
    middle = np.array([rng.uniform(-35.0, 35.0), rng.uniform(-25.0, 30.0)])
    wrist = middle - reach * np.array([-np.sin(np.radians(yaw)), np.cos(np.radians(yaw))])
    return {
        "x": float(wrist[0]),
        "y": float(wrist[1]),
        "z": rng.uniform(75.0, 130.0),
        "pitch": rng.uniform(-18.0, 8.0),
        "roll": rng.uniform(-12.0, 12.0),
        "yaw": yaw,
    }


def random_still(rng: np.random.Generator, hand: Hand) -> Track:
    """Draw the open hand of `K`: spread, and flat enough for every paint to show."""
    start = {**random_rest(rng), **random_place(rng, hand)}
    start.update(pitch=rng.uniform(-8.0, 4.0), roll=rng.uniform(-6.0, 6.0), z=rng.uniform(80.0, 110.0))
    return Track(start)


def random_gestures(rng: np.random.Generator, hand: Hand, lasting_s: float) -> Track:
    """Draw the gestures of `G1`: fingers bend in turn, spread, half a fist, open, while the hand moves and turns."""
    track = Track({**random_rest(rng), **random_place(rng, hand)})
    rest = dict(track.start)
    order = list(FINGERS) if rng.random() < 0.5 else list(FINGERS[::-1])
    if rng.random() < 0.3:
        rng.shuffle(order)
    beat = 0.105 * lasting_s
    for place, finger in enumerate([*order, "thumb"]):
        at = (0.02 + 0.075 * place) * lasting_s + rng.uniform(-0.1, 0.1) * beat
        if finger == "thumb":
            ways = {"cmc_flex": rng.uniform(8, 18), "mcp_flex": rng.uniform(18, 35), "ip_flex": rng.uniform(25, 50)}
        else:
            ways = {"mcp_flex": rng.uniform(25, 45), "pip_flex": rng.uniform(35, 62)}
        back = at + rng.uniform(1.5, 2.2) * beat
        for joint, value in ways.items():
            track.to(f"{finger}_{joint}", at, 1.6 * beat, value)
            track.to(f"{finger}_{joint}", back + 0.1 * beat, 1.7 * beat, rest[f"{finger}_{joint}"])
    spread = 0.60 * lasting_s
    for finger, outward in zip(FINGERS, (1.0, 0.2, -0.5, -1.0), strict=True):
        name = f"{finger}_mcp_abd"
        track.to(name, spread, 0.12 * lasting_s, float(np.clip(rest[name] + outward * rng.uniform(5, 9), -12, 12)))
        track.to(name, spread + 0.12 * lasting_s, 0.12 * lasting_s, 0.3 * rest[name])
    fist, again = 0.71 * lasting_s, 0.86 * lasting_s
    for finger in MARKERS[:5]:
        late = rng.uniform(0.0, 0.02) * lasting_s
        if finger == "thumb":
            ways = {"cmc_flex": rng.uniform(0, 12), "mcp_flex": rng.uniform(10, 25), "ip_flex": rng.uniform(10, 35)}
        else:
            ways = {"mcp_flex": rng.uniform(25, 45), "pip_flex": rng.uniform(40, 66)}
        for joint, value in ways.items():
            track.to(f"{finger}_{joint}", fist + late, 0.15 * lasting_s, value)
            track.to(f"{finger}_{joint}", again + late, 0.15 * lasting_s, rest[f"{finger}_{joint}"])
    # Three overlapping sweeps of the whole hand.
    for place in range(3):
        at = (0.30 * place - 0.05) * lasting_s
        for name, span in zip(POSE, (55.0, 40.0, 25.0, 12.0, 12.0, 14.0), strict=True):
            track.to(name, at, 0.45 * lasting_s, rest[name] + rng.uniform(-span, span))
    return track


def fastest_tip(hand: Hand, track: Track, lasting_s: float) -> float:
    """Return the greatest speed of a fingertip, mm/s."""
    t_s = np.arange(0.0, lasting_s, 0.004)
    bones = states(hand, track, t_s).bones
    tips = bones[:, [3, 6, 9, 12, 15]]
    ends = tips[..., :3, 3] + tips[..., :3, 1] * 20.0
    return float((np.linalg.norm(np.diff(ends, axis=0), axis=-1) / 0.004).max())
