"""Frames of a depth camera, and the interface between all kinds of depth cameras and the rest of feet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel

ColorImage = NDArray[np.uint8]
DepthImage = NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class DepthFrame:
    """One picture with its depth.

    Attributes:
        t_ns: middle of the colour picture's exposure, rig clock.
        color: (H, W, 3) uint8 BGR.
        depth_mm: (H, W) uint16, millimetres along the optical axis, aligned to the colour picture, 0 = none; None when
            the camera gave no depth with this picture.
        camera: lens of the colour picture; its rig frame is the camera's own frame.
        index: the source's frame counter; a gap means frames that never arrived.
    """

    t_ns: int
    color: ColorImage
    depth_mm: DepthImage | None
    camera: CameraModel
    index: int


class DepthSource(Protocol):
    """A depth camera, a recording of one, or a simulated one.

    `open` and `read` are called from one thread at a time; `close` may come from another thread while `read` waits.
    """

    def open(self, start_ns: int) -> None:
        """Connect and make ready.

        Args:
            start_ns: rig time at which the session starts; recordings and the simulated world begin there.

        Raises:
            DeviceError: the camera is absent or refuses; calling `open` again later may succeed.
            ConfigError: a file or a setting cannot be used; calling again does not help.
        """
        ...

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Wait for the next frame and return the newest; None when none came in time or there are no more.

        Args:
            timeout_s: longest wait.

        Raises:
            DeviceError: the camera went away; `close`, then `open` again.
        """
        ...

    @property
    def finished(self) -> bool:
        """Whether there are no more frames: a recording is over."""
        ...

    def close(self) -> None:
        """Release the device; may be called repeatedly."""
        ...


def pinhole(width: int, height: int, K: NDArray[np.float64], distortion: NDArray[np.float64]) -> CameraModel:
    """Return a camera whose rig frame is its own frame.

    Args:
        width, height: pixels.
        K: (3, 3) intrinsics, pixels.
        distortion: (n,) OpenCV's coefficients; empty = none.
    """
    return CameraModel.from_arrays(width, height, K, distortion, np.eye(4))
