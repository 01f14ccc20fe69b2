"""Cameras in the scene: where their pictures hang, the lines of their views, and which pixel a ray of sight meets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.rig.calibration import CameraCalibration

PICTURE_DISTANCE_M: Final = 0.055
"""The picture hangs this far in front of its camera: narrow enough not to cut into that of a neighbour 75 mm away."""


@dataclass(frozen=True, slots=True)
class PicturePlane:
    """A camera's picture as a rectangle in the scene, as its pinhole sees it (the lens's distortion is left in it).

    Attributes:
        width_px, height_px: of the picture.
        center: (3,) its middle, metres, rig frame.
        right, down: (3,) the extent of one pixel along u and along v, metres, rig frame.
        wxyz: (4,) quaternion of the picture's axes (right, down, away from the camera), w first.
        eye: (3,) the camera's optical centre, metres, rig frame.
    """

    width_px: int
    height_px: int
    center: FloatArray
    right: FloatArray
    down: FloatArray
    wxyz: FloatArray
    eye: FloatArray

    @classmethod
    def of(cls, camera: CameraCalibration, distance_m: float = PICTURE_DISTANCE_M) -> PicturePlane:
        """Return where the picture of a calibrated camera hangs."""
        K, T = np.array(camera.K), np.array(camera.T_rig_camera)
        R, eye = T[:3, :3], T[:3, 3]
        right, down = R[:, 0] * distance_m / K[0, 0], R[:, 1] * distance_m / K[1, 1]
        # From the principal point, which the optical axis meets, to the middle of the picture.
        to_middle = right * (0.5 * (camera.width - 1) - K[0, 2]) + down * (0.5 * (camera.height - 1) - K[1, 2])
        x, y, z, w = quaternion_from_rotation(R)
        return cls(
            camera.width,
            camera.height,
            eye + R[:, 2] * distance_m + to_middle,
            right,
            down,
            np.array([w, x, y, z]),
            eye,
        )

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height, metres."""
        return (
            self.width_px * float(np.linalg.norm(self.right)),
            self.height_px * float(np.linalg.norm(self.down)),
        )

    @property
    def corners(self) -> FloatArray:
        """(4, 3) its corners in order, metres, rig frame."""
        signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        half = 0.5 * np.array([self.width_px, self.height_px])
        corners: FloatArray = self.center + (signs * half) @ np.stack([self.right, self.down])
        return corners

    @property
    def lines(self) -> FloatArray:
        """(8, 2, 3) lines of the view: the picture's edges and those to the camera, metres, rig frame."""
        corners = self.corners
        edges = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        sides = np.stack([np.tile(self.eye, (4, 1)), corners], axis=1)
        return np.concatenate([edges, sides])

    def pixel_of_ray(self, origin: FloatArray, direction: FloatArray) -> tuple[float, float] | None:
        """Return the raw pixel (u, v) in which a ray of sight meets the picture; None when it misses.

        Args:
            origin: (3,) metres, rig frame.
            direction: (3,) of any length, rig frame.
        """
        # origin + s · direction = center + a · right + b · down
        system = np.column_stack([self.right, self.down, -np.asarray(direction)])
        try:
            a, b, s = np.linalg.solve(system, np.asarray(origin) - self.center)
        except np.linalg.LinAlgError:
            return None
        u, v = a + 0.5 * (self.width_px - 1), b + 0.5 * (self.height_px - 1)
        inside = -0.5 <= u <= self.width_px - 0.5 and -0.5 <= v <= self.height_px - 0.5
        return (float(u), float(v)) if s > 0.0 and inside else None
