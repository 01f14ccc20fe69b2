"""Simulated persons who look at a marker on the floor: what a camera on the head sees, without drawing it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.aruco_dictionary import marker_corners_m
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation
from rhot.rig.feet_config import BodyConfig
from rhot_calibration.headset.streams import HeadsetView
from rhot_feet.frames import pinhole
from rhot_sim.sources.objects import ORIENTATION_NOISE_RAD, POSITION_NOISE_M
from rhot_sim.walker.programs import LOOK_AT_MARKER
from rhot_sim.walker.world import DEFAULT_FEET, WalkerWorld

SIZE_M = DEFAULT_FEET.marker_size_m
SECONDS = 28.0
CORNER_PX = 0.2
_EDGE_PX = 5.0
_HALF_STEP_S = 0.01


@lru_cache(maxsize=8)
def looked_at(seed: int) -> tuple[WalkerWorld, CameraModel]:
    """Return the world of a person whose camera sits askew, and the camera's lens."""
    world = WalkerWorld(seed, BodyModel.from_config(BodyConfig()), LOOK_AT_MARKER, askew=True)
    config = world.feet_config.camera
    return world, pinhole(config.width, config.height, world.intrinsics, np.empty(0))


def corners_of(world: WalkerWorld) -> FloatArray:
    """Return the corners (4, 3) of the marker on the floor, metres, rig frame."""
    (T,) = (card.T_rig_foot for card in world.on_floor)
    corners: FloatArray = marker_corners_m(SIZE_M) @ T[:3, :3].T + T[:3, 3]
    return corners


def views_of(seed: int, count: int = 120, *, late_s: float = 0.0) -> list[HeadsetView]:
    """Return views with the noise of corners and head.

    Args:
        seed: of person and noise.
        count: moments; the marker is out of sight in some.
        late_s: the head's poses are of so much earlier than they say.
    """
    world, camera = looked_at(seed)
    rng = np.random.default_rng(seed)
    corners = corners_of(world)
    highest = np.array([camera.width, camera.height]) - _EDGE_PX
    views = []
    for t_s in np.linspace(0.7, SECONDS, count).tolist():
        uv = world.project(corners, t_s)
        if not (np.isfinite(uv).all() and (uv > _EDGE_PX).all() and (uv < highest).all()):
            continue
        before, T, after = world.head(t_s - late_s + _HALF_STEP_S * np.arange(-1, 2))
        velocity = np.concatenate(
            [vector_from_rotation(after[:3, :3] @ before[:3, :3].T), after[:3, 3] - before[:3, 3]]
        )
        T = T.copy()
        T[:3, :3] = T[:3, :3] @ rotation_from_vector(rng.normal(0.0, ORIENTATION_NOISE_RAD, 3))
        T[:3, 3] += rng.normal(0.0, POSITION_NOISE_M, 3)
        seen = uv + rng.normal(0.0, CORNER_PX, (4, 2))
        views.append(HeadsetView(round(1e9 * t_s), T, velocity / (2.0 * _HALF_STEP_S), seen, CORNER_PX))
    return views
