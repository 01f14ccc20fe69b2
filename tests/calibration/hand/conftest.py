"""Simulated people: hands about the proportions, and the point sets that a rig would publish of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.anatomy.hand_proportions import BONES_MM, METACARPAL_MM, RADII_MM, REFERENCE_LENGTH_M, width_across_knuckles
from rhot.anatomy.skeleton import CHAINS, FINGERS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_vector
from rhot.messages import Point, PointSet, Position
from rhot.rig import CameraConfig, HandFile, MarkerConfig, Rig, RigConfig
from rhot.rig.folder import NO_REGISTRATION, nominal_camera

START_NS = 1_700_000_000_000_000_000
RATE_HZ, DURATION_S = 30.0, 24.0
FLAT_S, KNUCKLES_S, FREE_S = (1.0, 4.0), (5.0, 15.0), (16.0, 24.0)
NOISE_M = np.array([0.0003, 0.0003, 0.0015])
MARKERS = {
    **{finger: MarkerConfig(joint=f"{finger}_tip") for finger in FINGERS},
    "base": MarkerConfig(joint="wrist", kind="patch", size_m=(0.04, 0.03)),
}


@dataclass(frozen=True, slots=True)
class Person:
    """A true hand and the point sets of its recording."""

    hand: HandFile
    points: list[PointSet]


def random_hand(seed: int, length_m: float) -> HandFile:
    rng = np.random.default_rng((seed, 1))
    scale = length_m / REFERENCE_LENGTH_M / 1000.0
    bones: dict[str, float] = {}
    for finger in FINGERS:
        chain = CHAINS[finger]
        lengths = (np.array(BONES_MM[finger]) - (0.0, 0.0, RADII_MM[finger][-1])) * scale
        bones |= dict(zip(chain[-3:], (lengths * np.exp(rng.normal(0.0, 0.05, 3))).tolist(), strict=True))
        if finger != "thumb":
            bones[chain[1]] = METACARPAL_MM[finger] * scale * float(np.exp(rng.normal(0.0, 0.05)))
    bones["middle_proximal"] = length_m - (28.0 + 7.4) * scale - sum(bones[joint] for joint in CHAINS["middle"][-3:])
    hand = HandFile(length_m=length_m, bones_m=bones)
    model = HandModel.from_file(hand, "right")
    shifts = {finger: np.array([0.0, 0.0, rng.normal(0.0, 0.0005)]) for finger in FINGERS}
    shifts["base"] = rng.uniform(-0.006, 0.006, 3) * (1.0, 0.4, 1.0)
    return hand.model_copy(
        update={
            "width_m": width_across_knuckles(hand, float(np.exp(rng.normal(0.05, 0.06)))),
            "marker_offsets_m": {
                name: triple(model.marker_offset(name, MARKERS[name]) + shift) for name, shift in shifts.items()
            },
        }
    )


def triple(values: FloatArray) -> Position:
    x, y, z = values.tolist()
    return x, y, z


def wander(rng: np.random.Generator, t: FloatArray, period_s: float, size: float) -> FloatArray:
    """Smooth steps between random values."""
    knots = rng.normal(0.0, size, int(t[-1] / period_s) + 3)
    place = (t / period_s).astype(int)
    share = 0.5 - 0.5 * np.cos(np.pi * (t / period_s - place))
    return np.asarray(knots[place] * (1.0 - share) + knots[place + 1] * share)


def bump(t: FloatArray, start: float, end: float, ramp: float) -> FloatArray:
    rising = np.clip(np.minimum((t - start) / ramp, (end - t) / ramp), 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * rising))


def finger_angles(rng: np.random.Generator, model: HandModel, t: FloatArray, knuckles: bool) -> FloatArray:
    """Flat and a little spread, knuckles only, then free; nobody holds a finger quite straight or quite flat."""
    thumb = np.array([0.4, 1.0, 1.0, 1.0, 1.0])
    sideways = np.array([1.0, 1.0, 0.3, 1.0, 1.0])
    free = bump(t, *FREE_S, 0.7) + bump(t, -1.0, FLAT_S[0], 0.5)
    knuckle = np.tile(rng.normal(3.0, 4.0, 5), (len(t), 1))
    spread = np.tile(rng.normal((0.0, 2.0, 0.0, -2.0, -5.0), 2.5) * sideways, (len(t), 1))
    slack = np.clip(rng.uniform(0.0, 6.0, 5) + np.stack([wander(rng, t, 0.9, 2.0) for _ in FINGERS], axis=1), 0.0, 8.0)
    hinge = slack
    begin, end = KNUCKLES_S if knuckles else FREE_S
    sweeps = 3 if knuckles else 2
    for start in np.linspace(begin, end, sweeps + 1)[:-1]:
        late = rng.uniform(0.0, 0.5, 5)
        for finger in range(5):
            up = bump(t, start + late[finger], start + late[finger] + (end - begin) / sweeps - 0.6, 1.1)
            knuckle[:, finger] += up * rng.uniform(60.0, 85.0) * thumb[finger]
    for finger in range(5):
        knuckle[:, finger] += free * np.abs(wander(rng, t, 0.8, 30.0)) * thumb[finger]
        hinge[:, finger] += free * np.abs(wander(rng, t, 0.8, 45.0)) * thumb[finger]
        spread[:, finger] += wander(rng, t, 1.1, 3.0) * sideways[finger]
    last = model.coupling * rng.uniform(0.9, 1.1, 5) * hinge
    limit = np.radians(10.0) * sideways
    angles = np.radians(np.stack([knuckle, spread, hinge, last], axis=-1))
    angles[..., 1] = np.clip(angles[..., 1], -limit, limit)
    # A flat hand may bend a little backwards at the knuckles.
    return np.where(np.arange(4) == 0, angles, model.clamp(angles))


def record(seed: int, hand: HandFile, hide: tuple[str, ...] = (), knuckles: bool = True) -> list[PointSet]:
    rng = np.random.default_rng((seed, 2))
    model = HandModel.from_file(hand, "right")
    t = np.arange(int(RATE_HZ * DURATION_S)) / RATE_HZ
    angles = finger_angles(rng, model, t, knuckles)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    turns = np.stack([wander(rng, t, 2.0, 0.2) for _ in range(3)], axis=1)
    facing = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    T[:, :3, :3] = [facing @ rotation_from_vector(turn) for turn in turns]
    T[:, :3, 3] = np.array([0.03, 0.05, 0.75]) + np.stack([wander(rng, t, 2.0, 0.03) for _ in range(3)], axis=1)
    joints = model.forward(T, angles)
    centres, corners = model.marker_positions(joints, MARKERS), model.patch_corners(joints, MARKERS["base"])
    crooked = T[:, :3, :3] @ rotation_from_vector(rng.normal(0.0, np.radians(3.0), 3)) @ np.swapaxes(T[:, :3, :3], 1, 2)
    corners = (corners - centres["base"][:, None]) @ np.swapaxes(crooked, 1, 2) + centres["base"][:, None]
    hidden = {name: wander(rng, t, 0.7, 1.0) > 1.3 for name in MARKERS}
    points = []
    for k in range(len(t)):
        seen = {}
        for name in MARKERS:
            if name in hide or (hidden[name][k] and rng.random() < 0.5):
                continue
            place = centres[name][k] + rng.normal(size=3) * NOISE_M
            if rng.random() < 0.003:
                place = place + rng.normal(0.0, 0.02, 3)
            patch = None
            if name == "base":
                noisy = np.roll(corners[k] + rng.normal(size=(4, 3)) * NOISE_M, rng.integers(4), axis=0)
                patch = (triple(noisy[0]), triple(noisy[1]), triple(noisy[2]), triple(noisy[3]))
            state = "predicted" if hidden[name][k] else "measured"
            seen[name] = Point.model_validate(
                {"position": triple(place), "sigma": 0.0016, "views": 2, "state": state, "corners": patch}
            )
        points.append(PointSet(t_ns=START_NS + round(t[k] * 1e9), frame="rig", points=seen))
    return points


@pytest.fixture(scope="session")
def person() -> Callable[..., Person]:
    def make(seed: int, length_m: float, hide: tuple[str, ...] = (), knuckles: bool = True) -> Person:
        hand = random_hand(seed, length_m)
        return Person(hand, record(seed, hand, hide, knuckles))

    return make


@pytest.fixture(scope="session")
def rig() -> Rig:
    camera = CameraConfig()
    config = RigConfig(cameras={"left": camera}, markers=MARKERS)
    return Rig(Path(), config, {"left": nominal_camera(camera)}, True, HandFile(), NO_REGISTRATION)
