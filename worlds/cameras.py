"""A random stereo rig above a desk: two cameras with lens distortion, rolling shutter and their timing.

World frame: x to the right and y up in the picture, z up from the desk; millimetres. Camera frame: x right, y down, z
forward. Pixel centres are at integers (OpenCV).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.distortion import distorted
from worlds.hand import rotation_xyz

SIZE: Final = (640, 480)
"""Width and height of a picture, pixels."""
CAMERAS: Final = ("left", "right")


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole with distortion.

    Attributes:
        K: (3, 3) intrinsics, pixels.
        D: (5,) k1, k2, p1, p2, k3.
        T_camera_world: (4, 4), millimetres.
    """

    K: FloatArray
    D: FloatArray
    T_camera_world: FloatArray

    def normalized(self, points: FloatArray) -> FloatArray:
        """Return (..., 2) image points of (..., 3) world points in mm, as without a lens."""
        seen = points @ self.T_camera_world[:3, :3].T + self.T_camera_world[:3, 3]
        return np.asarray(seen[..., :2] / seen[..., 2:])

    def project(self, points: FloatArray) -> FloatArray:
        """Return (..., 2) pixels in the distorted picture of (..., 3) world points in mm."""
        return distort(self.normalized(points), self.K, self.D)


@dataclass(frozen=True, slots=True)
class Timing:
    """When a sequence's pictures are taken.

    Attributes:
        first_ns: start of exposure of the first row of the first left picture.
        period_ns: between the pictures of a camera.
        right_after_ns: from left to right.
        count: pairs.
        exposure_s, readout_s: of a row, and from the first row's start to the last one's.
    """

    first_ns: int
    period_ns: int
    right_after_ns: int
    count: int
    exposure_s: float
    readout_s: float

    def t_ns(self, camera: str, frame: int) -> int:
        """Return the start of exposure of the first row."""
        return self.first_ns + frame * self.period_ns + (self.right_after_ns if camera == "right" else 0)

    def row_ns(self, v: float) -> float:
        """Return the middle of row v's exposure after the start of the picture, nanoseconds."""
        return ((v + 0.5) / SIZE[1] * self.readout_s + 0.5 * self.exposure_s) * 1e9

    @property
    def end_ns(self) -> int:
        """End of the last exposure of both cameras."""
        return self.t_ns("right", self.count - 1) + int((self.readout_s + self.exposure_s) * 1e9)


def distort(normalized: FloatArray, K: FloatArray, D: FloatArray) -> FloatArray:
    """Return pixels of (..., 2) normalized image points."""
    bent = distorted(normalized[..., 0], normalized[..., 1], D.tolist()).xy
    return np.asarray(bent * K[[0, 1], [0, 1]] + K[[0, 1], [2, 2]])


def undistort(pixels: FloatArray, K: FloatArray, D: FloatArray) -> FloatArray:
    """Return the normalized image points of (..., 2) pixels, by fixed-point iteration."""
    aim = (pixels - K[[0, 1], [2, 2]]) / K[[0, 1], [0, 1]]
    guess = aim.copy()
    for _ in range(25):
        guess = guess + aim - (distort(guess, K, D) - K[[0, 1], [2, 2]]) / K[[0, 1], [0, 1]]
    return guess


def shutter_projection(
    camera: Camera, timing: Timing, start_ns: int, position: Callable[[float], FloatArray]
) -> tuple[float, FloatArray, FloatArray]:
    """Return instant (ns), pixel (2,) and world position (3,) of a moving point as a rolling shutter images it.

    Args:
        camera: that sees it.
        timing: of its sequence.
        start_ns: of the picture.
        position: of the point in the world by time in nanoseconds.
    """
    v = 0.5 * SIZE[1]
    for _ in range(12):
        t_ns = start_ns + timing.row_ns(v)
        at = position(t_ns)
        pixel = camera.project(at)
        v = float(pixel[1])
    return t_ns, pixel, at


def random_rig(rng: np.random.Generator) -> dict[str, Camera]:
    """Draw a pair of cameras 50 to 95 cm above the desk."""
    while True:
        height, focal = rng.uniform(500.0, 950.0), rng.uniform(450.0, 650.0)
        if 0.95 <= (height - 110.0) / focal <= 1.55:
            break
    baseline = rng.uniform(60.0, 140.0)
    # The rig as a whole leans a little; each camera toes in by its own share and has its own small errors.
    lean = np.array([rng.uniform(-9.0, 9.0), rng.uniform(-6.0, 6.0), rng.uniform(-4.0, 4.0)])
    toe = rng.choice([0.0, rng.uniform(0.3, 1.0)]) * np.degrees(np.arctan(0.5 * baseline / (height - 80.0)))
    down = np.diag([1.0, -1.0, -1.0])
    centre = np.array([height * np.tan(np.radians(-lean[1])), height * np.tan(np.radians(-lean[0])), height])
    cameras = {}
    for name, side in zip(CAMERAS, (-1.0, 1.0), strict=True):
        body = rotation_xyz(lean * [1, -1, 1])
        own = rotation_xyz(
            np.array([rng.uniform(-0.6, 0.6), -side * -toe + rng.uniform(-0.4, 0.4), rng.uniform(-1.2, 1.2)])
        )
        world_camera = body @ own @ down
        at = centre + body @ np.array([0.5 * side * baseline, *rng.uniform(-2.0, 2.0, 2)])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = world_camera.T, -world_camera.T @ at
        fx = focal * rng.uniform(0.985, 1.015)
        K = np.array(
            [
                [fx, 0, 319.5 + rng.uniform(-12, 12)],
                [0, fx * rng.uniform(0.997, 1.003), 239.5 + rng.uniform(-12, 12)],
                [0, 0, 1],
            ]
        )
        D = np.array([rng.uniform(-0.10, 0.03), rng.uniform(-0.02, 0.06), *rng.uniform(-0.0008, 0.0008, 2), 0.0])
        cameras[name] = Camera(K, D, pose)
    return cameras


def rig_json(cameras: dict[str, Camera], timings: dict[str, Timing]) -> dict[str, Any]:
    """Return the rig in the form of `calib.json`."""
    left, right = (cameras[name] for name in CAMERAS)
    T = right.T_camera_world @ np.linalg.inv(left.T_camera_world)
    normal = left.T_camera_world[:3, :3] @ np.array([0.0, 0.0, -1.0])
    height = float(np.linalg.inv(left.T_camera_world)[2, 3])
    any_timing = timings["G1"]
    return {
        "image_size": list(SIZE),
        "units": "mm",
        "frame": "left camera: x right, y down, z forward (optical axis)",
        "left": {"K": left.K.tolist(), "D": left.D.tolist()},
        "right": {"K": right.K.tolist(), "D": right.D.tolist()},
        "R": T[:3, :3].tolist(),
        "T": T[:3, 3].tolist(),
        "right_camera_centre_in_left_frame": (-T[:3, :3].T @ T[:3, 3]).tolist(),
        "convention": "X_right = R * X_left + T (as cv2.stereoCalibrate). D=[k1,k2,p1,p2,k3]. "
        "Pixel centres at integer coordinates (OpenCV).",
        "desk_plane": {
            "note": "normal . X = distance_mm, X in the left-camera frame",
            "normal": normal.tolist(),
            "distance_mm": height,
        },
        "timing": {
            "t_ns": "start of exposure of the first row",
            "row_readout_total_s": any_timing.readout_s,
            "row_delay_s": f"(row+0.5)/480*{any_timing.readout_s:g}",
            "exposure_s": any_timing.exposure_s,
            "sequences": {
                name: {
                    "frame_period_ns": timing.period_ns,
                    "right_starts_after_left_ns": timing.right_after_ns,
                    "first_left_t_ns": timing.first_ns,
                }
                for name, timing in timings.items()
            },
            "static_sequences": ["C", "K"],
        },
    }
