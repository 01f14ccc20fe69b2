"""What the cameras of one rig see of one clip, as marker frames that capture would publish, and the truth beside."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rhot.messages import MarkerFrame
from rhot.rig import Rig
from rhot_bench.motion.drawn_hands import draw_clip, draw_hand
from rhot_bench.motion.rigs import Family, RigDraw, draw_rig, write_rig
from rhot_bench.motion.sights import MarkerKind, camera_sights
from rhot_bench.motion.truth import MARKERS, START_NS, Truth

__all__ = ["MARKERS", "START_NS", "MarkerKind", "Tracks", "Truth", "make_tracks"]


@dataclass(frozen=True, slots=True)
class Tracks:
    """One rig before one clip.

    Attributes:
        seed: of everything.
        name: of the clip.
        rig: as fusion and ik are given it; its folder holds `cameras.json` with quality figures.
        draw: the rig as it was drawn, with the true cameras.
        frames: marker frames in the order in which they would arrive (by the end of their read-out).
        truth: what was true.
        grasps: whether an object is held.
    """

    seed: int
    name: str
    rig: Rig
    draw: RigDraw
    frames: list[MarkerFrame]
    truth: Truth
    grasps: bool


def make_tracks(
    seed: int,
    data: Path,
    folder: Path,
    *,
    seconds: float = 4.0,
    rate_hz: float | None = None,
    noise_px: float | None = None,
    markers: MarkerKind = "caps",
    family: Family | None = None,
) -> Tracks:
    """Draw a rig, a clip and a hand of the family, and return what its cameras see.

    The same seed gives the same clip, hand and rig whatever the rate, the noise and the kind of marker.

    Args:
        seed: even seeds are for developing, odd ones are held back.
        data: folder with the recorded hands.
        folder: of the rig, to be written.
        seconds: length of the clip, as far as the recording goes.
        rate_hz: of all cameras instead of the drawn one.
        noise_px: instead of the drawn one.
        markers: `caps` gives the middle of the paint that is seen, `points` that of the whole marker, seen or hidden
            alike; both are hidden by flesh and object.
        family: bounds to draw from.
    """
    rng = np.random.default_rng([12, seed])
    streams = rng.spawn(3)
    draw = draw_rig(seed, family or Family(), rate_hz, noise_px)
    motion, hand_name, grasps = draw_clip(streams[0], data, seconds, draw)
    flesh, surfaces, hand_file, patch_m = draw_hand(streams[1], motion, grasps)
    rig = write_rig(draw, folder, hand_file, patch_m)
    gate_px = [rig.config.markers[name].min_area_px for name in MARKERS]
    parts = [
        camera_sights(rng_camera, number, name, draw, motion, surfaces, flesh, gate_px, markers)
        for number, (name, rng_camera) in enumerate(zip(draw.true, streams[2].spawn(len(draw.true)), strict=True))
    ]
    frames = sorted((frame for part in parts for frame in part.frames), key=lambda frame: frame.t_ns)
    truth = Truth(
        motion,
        surfaces,
        tuple(part.t_ns for part in parts),
        tuple(part.visible for part in parts),
        tuple(part.whole for part in parts),
    )
    return Tracks(seed, hand_name, rig, draw, frames, truth, grasps)
