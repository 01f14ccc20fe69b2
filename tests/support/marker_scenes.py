"""Pictures and depth images of feet and their markers with known truth, small enough for unit tests."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.aruco_dictionary import marker_cells
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import rotation_from_vector, rotation_z
from rhot_feet.frames import ColorImage, DepthImage, pinhole
from rhot_feet.marker.pose import square_corners

SIZE_M = 0.06
DICTIONARY = "3X3_32"
_FINE = 4
_CARD = 1.3


def depth_camera() -> CameraModel:
    """A D435's colour camera at 848x480."""
    return pinhole(848, 480, np.array([[613.0, 0.0, 429.8], [0.0, 612.7, 237.9], [0.0, 0.0, 1.0]]), np.empty(0))


def tilted(tilt_deg: float, azimuth_rad: float, rotation_rad: float = 0.0) -> FloatArray:
    """R_camera_marker of a marker that faces the camera, turned in its plane and tilted about an axis in it."""
    axis = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    facing: FloatArray = np.diag([1.0, -1.0, -1.0])
    return rotation_from_vector(np.radians(tilt_deg) * axis) @ rotation_z(rotation_rad) @ facing


def draw_marker(
    color: ColorImage, camera: CameraModel, marker_id: int, R: FloatArray, t: FloatArray, size_m: float = SIZE_M
) -> None:
    """Draw a marker on its white card into a picture, blurred as a lens does."""
    cells = marker_cells(DICTIONARY, marker_id).astype(np.uint8)
    texture: NDArray[np.integer[Any] | np.floating[Any]] = np.where(cells > 0, 225, 30).astype(np.uint8)
    texture = np.repeat(np.repeat(texture, 40, axis=0), 40, axis=1)
    rim = round(0.5 * (_CARD - 1.0) * len(texture))
    texture = cv2.copyMakeBorder(texture, rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=225)
    corners = camera.project(square_corners(size_m * len(texture) / (len(texture) - 2 * rim)) @ R.T + t)
    left, top = np.floor(corners.min(axis=0)).astype(int) - 4
    right, bottom = np.ceil(corners.max(axis=0)).astype(int) + 5
    size = (int(right - left) * _FINE, int(bottom - top) * _FINE)
    # Pixel centres lie on integers, in the fine picture too.
    fine = (corners - (left, top) + 0.5) * _FINE - 0.5
    span = float(len(texture))
    source = np.array([[0, 0], [span, 0], [span, span], [0, span]], np.float32) - 0.5
    H = cv2.getPerspectiveTransform(source, fine.astype(np.float32))
    cover = cv2.warpPerspective(np.full_like(texture, 255), H, size, flags=cv2.INTER_AREA)
    drawn = cv2.warpPerspective(texture, H, size, flags=cv2.INTER_AREA)
    small = (int(right - left), int(bottom - top))
    share = cv2.resize(cover, small, interpolation=cv2.INTER_AREA).astype(float)[..., None] / 255.0
    grey = cv2.resize(drawn, small, interpolation=cv2.INTER_AREA).astype(float)[..., None]
    part = color[top:bottom, left:right]
    part[...] = np.clip((1.0 - share) * part + share * grey, 0, 255).astype(np.uint8)


def background(camera: CameraModel, seed: int = 0) -> ColorImage:
    """A grey floor with some grain."""
    grain = np.random.default_rng(seed).normal(120.0, 3.0, (camera.height, camera.width, 1))
    return np.repeat(np.clip(grain, 0, 255), 3, axis=2).astype(np.uint8)


def with_noise(color: ColorImage, seed: int = 0) -> ColorImage:
    """The picture after a sensor: blurred a little, noisy."""
    blurred = cv2.GaussianBlur(color, (0, 0), 0.6).astype(float)
    noisy = blurred + np.random.default_rng(seed).normal(0.0, 2.0, blurred.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def plane_depths(camera: CameraModel, normal: FloatArray, point: FloatArray) -> FloatArray:
    """Depths (H, W), metres, of the plane through a point; 0 where it is not in front."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    K = camera.K
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    inverse = (normal[0] * x + normal[1] * y + normal[2]) / float(normal @ point)
    return np.where(inverse > 0.05, 1.0 / np.maximum(inverse, 0.05), 0.0)


def ball_depths(camera: CameraModel, center: FloatArray, radius: float) -> FloatArray:
    """Depths (H, W), metres, of a ball; infinite where it is not."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    K = camera.K
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
    a, b, c = (rays * rays).sum(axis=-1), rays @ center, float(center @ center) - radius**2
    root = b * b - a * c
    return np.where(root > 0.0, (b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)


def depth_image(depths: FloatArray, seed: int = 0, noise: float = 0.004) -> DepthImage:
    """A depth image (H, W), millimetres, with noise that is even in inverse depth and shared by neighbours."""
    grain = cv2.GaussianBlur(np.random.default_rng(seed).normal(0.0, 1.0, depths.shape), (0, 0), 1.6)
    inverse = np.where(depths > 0.0, 1.0 / np.maximum(depths, 0.05), 0.0) + noise * grain / grain.std()
    millimetres = np.where((depths > 0.0) & (inverse > 0.1), 1e3 / np.maximum(inverse, 0.1), 0.0)
    return np.clip(np.rint(millimetres), 0, 65535).astype(np.uint16)
