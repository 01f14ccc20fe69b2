"""From linear light of an ideal pinhole to the picture of a cheap camera: lens, sensor, JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.arrays import FloatArray
from worlds.cameras import SIZE, Camera, Timing, undistort

_PAD: Final = 6
BLUR_PX: Final = 0.45
JPEG_QUALITY: Final = 95


@dataclass(frozen=True, slots=True)
class Pinhole:
    """The ideal camera that is rendered: without distortion, square pixels, wide enough for the distorted picture.

    Rolling shutter is that of the pinhole's rows, aligned at the centre of the picture. Distortion moves a row by a few
    pixels at most, readout / 480 each (0.01 to 0.03 ms), which is neglected.

    Attributes:
        focal: pixels.
        centre: (2,) principal point, pixel centres at integers.
        size: width, height.
        maps: (480, 640) float32 each: x and y in the pinhole's picture of each pixel of the distorted one.
    """

    focal: float
    centre: FloatArray
    size: tuple[int, int]
    maps: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(cls, camera: Camera) -> Pinhole:
        """Return the pinhole for a camera."""
        u, v = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
        rays = undistort(np.stack([u, v], -1), camera.K, camera.D)
        focal = float(camera.K[1, 1])
        low, high = rays.min((0, 1)) * focal, rays.max((0, 1)) * focal
        centre = np.ceil(_PAD - low)
        width, height = (int(n) for n in np.ceil(high + centre) + _PAD + 1)
        at = rays * focal + centre
        return cls(focal, centre, (width, height), (at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)))

    def shutter_s(self, timing: Timing) -> tuple[float, float]:
        """Return when the shutter of the whole pinhole's picture opens after t_ns, and for how long; seconds.

        Row r of the pinhole starts `(r + 0.5) / height * (length - exposure)` after it opened.
        """
        per_row = timing.readout_s / SIZE[1]
        middle = float(self.maps[1][SIZE[1] // 2, SIZE[0] // 2])
        opens = per_row * ((SIZE[1] // 2 + 0.5) - (middle + 0.5))
        return opens, per_row * self.size[1] + timing.exposure_s

    def project(self, camera: Camera, points: FloatArray) -> FloatArray:
        """Return (..., 2) pixels of the pinhole's picture of (..., 3) world points."""
        return self.focal * camera.normalized(points) + self.centre

    def border(self, camera: Camera, points: FloatArray, room_px: float) -> tuple[int, int, int, int]:
        """Return x0, y0, x1, y1 within the pinhole's picture round world points (N, 3), with a margin."""
        pixels = self.project(camera, points)
        low, high = np.clip([pixels.min(axis=0) - room_px, pixels.max(axis=0) + room_px], 0, self.size).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def to_lens(self, picture: np.ndarray, interpolation: int = cv2.INTER_CUBIC) -> np.ndarray:
        """Return the distorted (480, 640, C) picture of a pinhole's one."""
        return cv2.remap(picture, *self.maps, interpolation)


@dataclass(frozen=True, slots=True)
class Sensor:
    """The electronics of one camera.

    Attributes:
        crosstalk: (3, 3) of linear RGB, rows sum to 1.
        drift: amplitude, period in s and phase of the gains of all, red and blue.
        vignetting: loss at the corners.
        full_well, read_noise: electrons.
        gain: from rendered light to the share of the full well.
    """

    crosstalk: FloatArray
    drift: tuple[tuple[float, float, float], ...]
    vignetting: float
    full_well: float
    read_noise: float
    gain: float

    def picture(self, light: np.ndarray, t_s: float, rng: np.random.Generator) -> np.ndarray:
        """Return an 8-bit (480, 640, 3) RGB picture of linear light."""
        light = cv2.GaussianBlur(np.maximum(light, 0.0), (0, 0), BLUR_PX)
        u, v = np.meshgrid((np.arange(SIZE[0]) - 319.5) / 400.0, (np.arange(SIZE[1]) - 239.5) / 400.0)
        shade = 1.0 - self.vignetting * (u * u + v * v)
        whole, red, blue = (a * np.sin(2 * np.pi * (t_s / period + phase)) for a, period, phase in self.drift)
        gains = (1.0 + whole) * np.array([1.0 + red, 1.0, 1.0 + blue])
        share = (light @ self.crosstalk.T) * gains * shade[..., None] * self.gain
        electrons = share * self.full_well
        noisy = electrons + rng.normal(size=share.shape) * np.sqrt(np.maximum(electrons, 0.0) + self.read_noise**2)
        linear = np.clip(noisy / self.full_well, 0.0, 1.0)
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        return np.asarray(np.round(255.0 * encoded), np.uint8)


def random_sensor(rng: np.random.Generator, gain: float) -> Sensor:
    """Draw a sensor."""
    leak = rng.uniform(0.02, 0.06, (3, 3))
    np.fill_diagonal(leak, 0.0)
    crosstalk = leak + np.diag(1.0 - leak.sum(axis=1))
    drift = tuple((a, rng.uniform(1.2, 4.0), rng.random()) for a in (0.04, 0.025, 0.03))
    return Sensor(crosstalk, drift, 0.10, rng.uniform(4000, 9000), rng.uniform(3, 8), gain * rng.uniform(0.93, 1.07))


def jpeg(picture: np.ndarray) -> bytes:
    """Return an RGB picture as JPEG."""
    _, coded = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return coded.tobytes()
