"""Where the page looks from: upright, at what matters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.rig import Rig
from rhot.rig.calibration import CameraCalibration

# Cameras in the scene: where their pictures hang, the lines of their views, and which pixel a ray of sight meets.

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


OVERVIEW_FOV_RAD: Final = float(np.radians(48.0))
_CLOSE_M: Final = 0.45
_HANDS_APART_M: Final = 0.3
"""Palms of two hands at work before a person: about the width of the shoulders less the hands'."""


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """A position to look from, rig frame.

    Attributes:
        position, look_at: (3,) metres.
        up: (3,) unit vector that is upwards on the screen.
        fov_rad: vertical field of view.
    """

    position: FloatArray
    look_at: FloatArray
    up: FloatArray
    fov_rad: float


def up_direction(rig: Rig) -> FloatArray:
    """Return the direction against gravity (3,), unit vector, rig frame.

    A rig with feet says it; otherwise the reference camera, whose frame the rig frame is, looks down at the desk.
    """
    feet = rig.config.feet
    up = np.array(feet.up if feet is not None else (0.0, 0.0, -1.0))
    unit: FloatArray = up / np.linalg.norm(up)
    return unit


def desk_middle(rig: Rig) -> FloatArray:
    """Return the middle of the desk (3,), metres, rig frame: below the cameras; its distance is `[sim] desk_z_m`.

    A rig that has only a camera on the head has none; its origin stands for it, which lies on the floor.
    """
    if not rig.cameras:
        return np.zeros(3)
    centers = np.array([np.array(camera.T_rig_camera)[:3, 3] for camera in rig.cameras.values()])
    middle = centers.mean(axis=0)
    down = -up_direction(rig)
    below: FloatArray = middle + down * (rig.config.sim.desk_z_m - float(middle @ down))
    return below


def overview(rig: Rig) -> Viewpoint:
    """Return the view of the person whose hand it is, who sits at the pictures' upper edge, −y."""
    up = up_direction(rig)
    if rig.config.feet is not None:
        forward = _across(up)
        # Height of what is looked at in a rig that tracks feet, above the floor's origin.
        middle = 1.0 * up
        return Viewpoint(middle + 0.6 * up + 3.2 * forward, middle, up, OVERVIEW_FOV_RAD)
    middle = desk_middle(rig) + 0.46 * up
    position = middle + np.array([-0.5, -1.1, 0.0]) + 0.5 * up
    return Viewpoint(position, middle, up, OVERVIEW_FOV_RAD)


def close_up(rig: Rig, hands: FloatArray) -> Viewpoint:
    """Return a view from near by at hands, as far away as they need; at the desk when there are none.

    Args:
        rig: loaded.
        hands: (N, 3) their palms, metres, rig frame.
    """
    seen = overview(rig)
    target = hands.mean(axis=0) if len(hands) else desk_middle(rig) + 0.1 * seen.up
    apart_m = float(np.linalg.norm(hands - target, axis=1).max()) if len(hands) else 0.0
    # Higher up than the overview: seen level from behind, the wrist hides the fingers.
    away = seen.position - seen.look_at + 0.6 * seen.up
    distance_m = _CLOSE_M + 2.0 * apart_m
    return Viewpoint(target + distance_m * away / np.linalg.norm(away), target, seen.up, OVERVIEW_FOV_RAD)


def first_view(rig: Rig) -> Viewpoint:
    """Return the view that a page opens with: where hands will be, or the whole person in a rig that tracks feet."""
    if rig.config.feet is not None:
        return overview(rig)
    over_desk = desk_middle(rig) + 0.1 * up_direction(rig)
    aside = np.array([_HANDS_APART_M / 2.0, 0.0, 0.0])
    hands = (over_desk - aside, over_desk + aside) if len(rig.config.sides) > 1 else (over_desk,)
    return close_up(rig, np.array(hands))


def through(plane: PicturePlane, aspect: float) -> Viewpoint:
    """Return the camera's own view, in which its picture fills a window of `aspect` (width over height)."""
    to_picture = float(np.linalg.norm(plane.center - plane.eye))
    width, height = plane.size_m
    tall = max(height, width / max(aspect, 0.1))
    up = -plane.down / np.linalg.norm(plane.down)
    return Viewpoint(plane.eye, plane.center, up, 2.0 * float(np.arctan(0.5 * tall / to_picture)))


def volume_lines(low: tuple[float, float, float], high: tuple[float, float, float]) -> FloatArray:
    """Return the edges (12, 2, 3) of the box between two corners, metres."""
    bounds = np.array([low, high])
    corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
    edges: FloatArray = corners[np.array(pairs)]
    return edges


def _across(up: FloatArray) -> FloatArray:
    """Return a unit vector (3,) at right angles to `up`, as near to z as can be (x where `up` is z)."""
    axis = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    level = axis - up * (axis @ up)
    unit: FloatArray = level / np.linalg.norm(level)
    return unit
