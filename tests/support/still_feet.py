"""A person who stands: a few pictures of the feet, drawn once, and the head and the sensors to go with them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.messages import HeadPose
from rhot.rig.feet_config import BodyConfig, DepthCameraConfig, FeetConfig, FootConfig, ImuConfig
from rhot_feet.frames import DepthFrame, pinhole
from rhot_feet.imu.samples import ImuSamples
from rhot_sim.walker.pictures.disturbances import Disturbances
from rhot_sim.walker.world import WalkerWorld

AT_S = 1.0
"""The moment of the still program that all pictures show; only their noise differs."""
FEET = FeetConfig(
    camera=DepthCameraConfig(source="simulated", rate_hz=30.0),
    left=FootConfig(marker_id=0, imu=ImuConfig(source="simulated")),
    right=FootConfig(marker_id=1),
)


@lru_cache(maxsize=1)
def world() -> WalkerWorld:
    return WalkerWorld(
        3, BodyModel.from_config(BodyConfig()), "still", feet=FEET, disturbances=Disturbances(hems=False)
    )


@lru_cache(maxsize=1)
def pictures() -> list[DepthFrame]:
    """Six pictures, at times 0."""
    camera = pinhole(FEET.camera.width, FEET.camera.height, world().intrinsics, np.empty(0))
    drawn = [world().render(AT_S + 1e-4 * k) for k in range(6)]
    return [DepthFrame(0, color, depth_mm, camera, 0) for color, depth_mm in drawn]


def picture(index: int, t_ns: int) -> DepthFrame:
    shown = pictures()[index % len(pictures())]
    return DepthFrame(t_ns, shown.color, shown.depth_mm, shown.camera, index)


def head(t_ns: int, shift_m: FloatArray | None = None) -> HeadPose:
    T = world().head(np.array([AT_S]))[0]
    position = tuple((T[:3, 3] + (0.0 if shift_m is None else shift_m)).tolist())
    orientation = tuple(quaternion_from_rotation(T[:3, :3]).tolist())
    return HeadPose.model_validate(
        {"t_ns": t_ns, "frame": "rig", "position": position, "orientation": orientation, "state": "measured"}
    )


def positions() -> dict[str, FloatArray]:
    """Where the markers are, metres, rig frame."""
    return {side: T[0, :3, 3] for side, T in world().feet(np.array([AT_S])).items()}


def standing_samples(first_ns: int, count: int) -> ImuSamples:
    """A hundred samples a second of a sensor at rest."""
    t_ns = first_ns + 10_000_000 * np.arange(count, dtype=np.int64)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    return ImuSamples(t_ns, np.tile([0.0, 0.0, 9.81], (count, 1)), np.zeros((count, 3)), upright)
