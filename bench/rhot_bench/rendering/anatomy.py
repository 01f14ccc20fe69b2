"""A random right hand: its proportions, girth, paint and patch."""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.geometry.rotations import nearest_rotation
from rhot_bench.rendering.hand import MARKERS, Hand, rotation_xyz

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
