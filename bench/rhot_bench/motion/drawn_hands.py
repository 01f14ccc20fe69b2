"""The hand that is worn on a rig: a clip of a recording, and flesh, paint, patch and object, drawn at random."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from rhot.anatomy.skeleton import JOINTS
from rhot.geometry.rotations import nearest_rotation, rotation_from_vector, rotation_z
from rhot.rig import HandFile
from rhot.rig.calibration import WIDTH_OVER_LENGTH, today
from rhot_bench.motion.hand_motion import HandMotion
from rhot_bench.motion.painted import Flesh, Surface, cap_surface, patch_surface
from rhot_bench.motion.recordings import RecordedHand, list_recordings, read_recording
from rhot_bench.motion.rigs import RigDraw

_FLESH_MM: Final = ((9.5, 9.5, 8.8), (9.5, 8.5, 7.6), (9.5, 8.6, 7.8), (9.0, 8.0, 7.3), (8.0, 7.2, 6.6))
"""Radii of the moving bones of a hand of 185 mm, thumb first; the means of `rhot.hand_anatomy.RADII_MM` along each."""
_HAND_M: Final = 0.185


def draw_clip(rng: np.random.Generator, data: Path, seconds: float, draw: RigDraw) -> tuple[HandMotion, str, bool]:
    """Return a clip of a recording, placed before the cameras with the back of the hand towards them, more or less."""
    sources = list_recordings(data)
    source = str(rng.choice(list(sources)))
    hand: RecordedHand = read_recording(sources[source][rng.integers(len(sources[source]))], source)
    seconds = min(seconds, hand.seconds - 0.1)
    start_s = float(rng.uniform(0.0, hand.seconds - seconds))
    radii = 1e-3 * np.array([row[2] for row in _FLESH_MM])
    motion = HandMotion(hand, start_s, seconds, float(rng.uniform(0.92, 1.08)), radii)
    middle = motion.at(np.linspace(0.0, seconds, 30))
    # The mean hand lies with its back to the cameras; people hold it up to 35° off, and turned any way in the picture.
    mean = nearest_rotation(middle.R.sum(axis=0))
    flat = np.column_stack([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    tilt = rotation_from_vector(np.radians(rng.uniform(-25.0, 25.0, 3)) * [1.0, 1.0, 0.0])
    R = rotation_z(float(np.radians(rng.uniform(-60.0, 60.0)))) @ tilt @ flat @ mean.T
    lenses = np.mean([camera.center for camera in draw.true.values()], axis=0)
    target = np.array([lenses[0], lenses[1], draw.distance_m]) + rng.uniform(-0.03, 0.03, 3)
    motion.place(R, target - R @ middle.joints[:, JOINTS.index("middle_proximal")].mean(axis=0))
    return motion, hand.name, hand.grasps


def draw_hand(
    rng: np.random.Generator, motion: HandMotion, grasps: bool
) -> tuple[Flesh, list[Surface], HandFile, tuple[float, float]]:
    """Return flesh, paint and patch of a hand, and what two measures by a ruler tell of it."""
    scale = motion.length_m / _HAND_M * float(rng.uniform(0.92, 1.12))
    bones_m = np.minimum(1e-3 * scale * np.array(_FLESH_MM), 0.45 * motion.bones[:, 2:])
    bones_m[:, 2] = np.minimum(bones_m[:, 2], bones_m[:, 1])
    tips = bones_m[:, 2]
    motion.tip_radius_m = tips
    lengths = rng.uniform(0.012, 0.022, 5) * scale
    surfaces = [
        cap_surface(max(float(length), 1.2 * float(r)), float(r), float(r) * float(rng.uniform(1.0, 1.15)))
        for length, r in zip(lengths, tips, strict=True)
    ]
    patch_m = (float(rng.uniform(0.030, 0.045)), float(rng.uniform(0.022, 0.032)))
    patch = patch_surface(patch_m)
    tilt = rotation_from_vector(np.radians(rng.normal(0.0, 4.0, 3)))
    to_fingers = motion.knuckles[2] / np.linalg.norm(motion.knuckles[2])
    middle = to_fingers * rng.uniform(0.020, 0.045) + [rng.uniform(-0.005, 0.005), scale * rng.uniform(0.012, 0.018), 0]
    surfaces.append(Surface(patch.points @ tilt.T + middle, patch.normals @ tilt.T, patch.areas, middle))
    palm = np.full(4, 0.011 * scale)
    flesh = Flesh(bones_m, palm, np.zeros(3), np.zeros(3), 0.0)
    if grasps:
        flesh = _with_object(rng, motion, flesh)
    length = motion.length_m + float(rng.normal(0.0, 0.0015))
    across = float(np.linalg.norm(motion.knuckles[1] - motion.knuckles[4])) + 0.024 * scale
    width = float(np.clip(across + rng.normal(0.0, 0.0015), *(length * np.array(WIDTH_OVER_LENGTH) * [1.02, 0.98])))
    measured = HandFile(
        date=today(), length_m=round(length, 4), width_m=round(width, 4), quality={"source": "two measures by a ruler"}
    )
    return flesh, surfaces, measured, patch_m


def _with_object(rng: np.random.Generator, motion: HandMotion, flesh: Flesh) -> Flesh:
    """Return the hand with a round object in it, as thick as the closed fingers leave room for."""
    hand = motion.at(np.linspace(0.0, motion.seconds, 40))
    local = (hand.chain[:, :, 3] - hand.wrist[:, None]) @ hand.R
    thumb, fingers = np.median(local[:, 0], axis=0), np.median(local[:, 1:].mean(axis=1), axis=0)
    middle, axis = 0.5 * (thumb + fingers), np.array([1.0, 0.0, 0.0])
    apart = local - middle
    apart -= axis * (apart @ axis)[..., None]
    room = np.percentile(np.linalg.norm(apart, axis=-1), 10) - float(flesh.bones_m[:, 2].mean())
    radius = float(np.clip(room, 0.006, 0.040))
    return Flesh(flesh.bones_m, flesh.palm_m, middle, axis * float(rng.uniform(0.03, 0.06)), radius)
