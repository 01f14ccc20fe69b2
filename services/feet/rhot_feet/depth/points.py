"""From depth pixels to points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.region import Region
from rhot_feet.frames import DepthImage

Mask = NDArray[np.bool_]

FINE_PX: Final = 2
"""Distance of the pixels that feet are cut out of: the camera's depth is decimated by two, there is nothing between."""
COARSE_PX: Final = 12
"""Distance of the pixels that the floor is fitted to."""


@dataclass(frozen=True, slots=True)
class PointGrid:
    """The points of a region, one for every few pixels.

    Attributes:
        region: of the picture.
        points: (h, w, 3) metres, camera frame; meaningless where not valid.
        valid: (h, w) there is a believable depth.
    """

    region: Region
    points: FloatArray
    valid: Mask


class PixelRays:
    """The viewing directions (x, y, 1) of a camera's pixels, kept because lenses are slow to undo."""

    def __init__(self, camera: CameraModel, stride_px: int) -> None:
        """Undo the lens once.

        Args:
            camera: the lens.
            stride_px: distance of the pixels.
        """
        u, v = np.meshgrid(np.arange(0, camera.width, stride_px), np.arange(0, camera.height, stride_px))
        self._stride = stride_px
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
        self.camera = camera
        self._xy = camera.undistort(pixels).reshape(*u.shape, 2)

    def points(self, depth_mm: DepthImage, region: Region, depth_range_m: tuple[float, float]) -> PointGrid:
        """Return the points of a region.

        Args:
            depth_mm: (H, W) depth image.
            region: of the picture.
            depth_range_m: nearest and farthest depth that is believed.
        """
        stride = self._stride
        left, top = region.left // stride, region.top // stride
        right, bottom = -(-region.right // stride), -(-region.bottom // stride)
        z = 1e-3 * depth_mm[::stride, ::stride][top:bottom, left:right].astype(np.float64)
        xy = self._xy[top:bottom, left:right]
        points = np.empty((*z.shape, 3))
        points[..., :2], points[..., 2] = xy * z[..., None], z
        snapped = Region(left * stride, top * stride, right * stride, bottom * stride)
        return PointGrid(snapped, points, (z >= depth_range_m[0]) & (z <= depth_range_m[1]))
