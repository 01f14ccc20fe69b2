"""The head-worn RealSense D435: its lens, where it sits on the head, and when its pictures are taken and arrive.

Intrinsics are those of the colour camera at 848x480 in one real device's factory description (rs-enumerate-devices);
depth is aligned to it, as librealsense's align filter does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.rig.feet_config import DepthCameraConfig
from rhot_sim.rig.schedule import uniforms

COLOR_FOCAL_PX: Final = (613.037, 612.738)
COLOR_CENTER_PX: Final = (429.842, 237.867)
DEPTH_FOCAL_PX: Final = 423.752
BASELINE_M: Final = 0.0500
_WIDTH: Final = 848
_HEIGHT: Final = 480

DELAY_S: Final = 0.025
DELAY_JITTER_S: Final = 0.003
"""From mid-exposure until the picture is there: read-out, USB and the filters of depth."""
DROP_RATE: Final = 0.005
_PHASE_S: Final = 0.004


@dataclass(frozen=True, slots=True)
class FrameTiming:
    """One frame of the camera.

    Attributes:
        index: number from 0; lost frames count.
        t_s: middle of the exposure, seconds since the world's start.
        delivered_s: when the picture is there.
        dropped: whether it is lost before anybody sees it.
    """

    index: int
    t_s: float
    delivered_s: float
    dropped: bool


def intrinsics(config: DepthCameraConfig) -> FloatArray:
    """Return K (3, 3), pixels, of colour and aligned depth at the configured size; the lens has no distortion."""
    scale_x, scale_y = config.width / _WIDTH, config.height / _HEIGHT
    K = np.eye(3)
    K[0, 0], K[1, 1] = COLOR_FOCAL_PX[0] * scale_x, COLOR_FOCAL_PX[1] * scale_y
    # Pixel centres lie on integers, so sizes scale about -0.5.
    K[0, 2] = (COLOR_CENTER_PX[0] + 0.5) * scale_x - 0.5
    K[1, 2] = (COLOR_CENTER_PX[1] + 0.5) * scale_y - 0.5
    return K


def frame_timing(seed: int, rate_hz: float, index: int) -> FrameTiming:
    """Return when a frame is exposed and delivered, the same for everyone who asks."""
    lost, u1, u2 = uniforms(f"{seed} depth camera frame {index}")
    t_s = _PHASE_S + index / rate_hz
    # Jitter only ever delays: the magnitude of a normal variable (Box and Muller 1958).
    late = math.sqrt(-2.0 * math.log(1.0 - u1)) * abs(math.cos(2.0 * math.pi * u2))
    return FrameTiming(index, t_s, t_s + DELAY_S + DELAY_JITTER_S * late, lost < DROP_RATE)
