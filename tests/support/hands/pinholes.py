"""Two cameras side by side before a hand, without distortion, for tests that need no rig."""

from __future__ import annotations

import numpy as np

from rhot.geometry.camera import CameraModel

FOCAL_PX = 530.0


def pinhole(x_m: float) -> CameraModel:
    """Return a camera that looks along z from a place beside the origin."""
    T = np.eye(4)
    T[0, 3] = x_m
    K = np.array([[FOCAL_PX, 0.0, 319.5], [0.0, FOCAL_PX, 239.5], [0.0, 0.0, 1.0]])
    return CameraModel.from_arrays(640, 480, K, np.zeros(0), T)


CAMERAS = (pinhole(0.0), pinhole(0.09))
