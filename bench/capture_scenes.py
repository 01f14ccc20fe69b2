"""Painted shapes with a known true centre under one disturbance at a time, for measuring the capture stage.

A shape is drawn four times as fine as the picture at several moments of the exposure and averaged down: a fingertip
(an ellipse, shaded like something round, the end of a skin-coloured finger) or a flat rectangle on the back of a hand.
Light falls on finger and background alike. The truth is the visible paint at mid-exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.rig.config import MarkerConfig
from rhot_sim.world.paint import DESK, OBJECT, PAINTS, SKIN, Bgr

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]
Light = Literal["even", "gradient", "shadow", "highlight"]
Cover = Literal["none", "skin", "object"]

FINE: Final = 4
SIDE: Final = 96
MARKERS: Final[dict[str, MarkerConfig]] = {
    name: MarkerConfig(joint="wrist", kind="patch", size_m=(0.042, 0.026))
    if name == "base"
    else MarkerConfig(joint=f"{name}_tip")
    for name in PAINTS
}


@dataclass(frozen=True, slots=True)
class Case:
    """One shape and what disturbs it.

    Attributes:
        name: marker.
        place: (u, v) of the shape's middle, pixels.
        radius: half of the short axis (of a rectangle: half its short side), pixels.
        stretch: long over short axis.
        angle: of the finger, radians; it leaves the cap along −(sin, cos)-rotated v.
        light: how it falls across the shape, along `direction`.
        light_level: of the whole picture.
        direction: of the light, the cover, the border or the motion, radians.
        cover: what hides a part.
        covered: share of the shape's width along `direction` that is hidden.
        motion_px: length of the motion during the exposure.
        bare: without a finger, on the desk.
        blur_px: of the optics, standard deviation.
        noise: of the sensor, grey levels.
        seed: of the noise.
        size: width and height of the picture.
    """

    name: str = "index"
    place: tuple[float, float] = (SIDE / 2, SIDE / 2)
    radius: float = 7.0
    stretch: float = 1.35
    angle: float = 0.0
    light: Light = "even"
    light_level: float = 1.0
    direction: float = 0.0
    cover: Cover = "none"
    covered: float = 0.3
    motion_px: float = 0.0
    bare: bool = False
    blur_px: float = 0.7
    noise: float = 3.0
    seed: int = 0
    size: tuple[int, int] = (SIDE, SIDE)


@dataclass(frozen=True, slots=True)
class Drawn:
    """A picture and its truth.

    Attributes:
        image: (H, W, 3) uint8 BGR.
        u, v: centre of the visible paint at mid-exposure, pixels.
        area: of the visible paint, square pixels.
        visible: share of the shape that is visible.
        corners: (4, 2) of a rectangle, pixels.
    """

    image: Image
    u: float
    v: float
    area: float
    visible: float
    corners: FloatArray = field(default_factory=lambda: np.zeros((4, 2)))


def draw(case: Case) -> Drawn:
    """Return the picture of a case."""
    count = max(1, round(2.0 * case.motion_px))
    shares = (np.arange(count) + 0.5) / count - 0.5
    moves = case.motion_px * shares[:, None] * np.array([np.cos(case.direction), np.sin(case.direction)])
    total = np.zeros((case.size[1], case.size[0], 3))
    for du, dv in moves:
        fine, *_ = _moment(replace(case, place=(case.place[0] + du, case.place[1] + dv)))
        total += cv2.resize(fine, case.size, interpolation=cv2.INTER_AREA)
    blurred = np.asarray(cv2.GaussianBlur(total / count, (0, 0), case.blur_px), dtype=np.float64)
    noisy = blurred + np.random.default_rng(case.seed).normal(0.0, case.noise, blurred.shape)
    _, visible, painted, u, v = _moment(case)
    return Drawn(
        np.clip(np.rint(noisy), 0, 255).astype(np.uint8),
        float(u[visible].mean()),
        float(v[visible].mean()),
        float(visible.sum()) / FINE**2,
        float(visible.sum()) / max(1.0, float(painted)),
        _corners(case),
    )


def _corners(case: Case) -> FloatArray:
    half = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * (case.stretch * case.radius, case.radius)
    cos, sin = np.cos(case.angle), np.sin(case.angle)
    corners: FloatArray = half @ np.array([[cos, sin], [-sin, cos]]) + case.place
    return corners


def _moment(case: Case) -> tuple[FloatArray, NDArray[np.bool_], float, FloatArray, FloatArray]:
    """Return the fine picture, the visible paint in it, the whole shape's area and the places of its pixels."""
    width, height = case.size
    v, u = np.mgrid[0 : height * FINE, 0 : width * FINE].astype(np.float64)
    u, v = (u + 0.5) / FINE - 0.5 - case.place[0], (v + 0.5) / FINE - 0.5 - case.place[1]
    cos, sin = np.cos(case.angle), np.sin(case.angle)
    x, y = cos * u + sin * v, -sin * u + cos * v
    flat = MARKERS[case.name].kind == "patch"
    picture = np.empty((*u.shape, 3))
    picture[:] = DESK
    if flat:
        painted = (np.abs(x) < case.stretch * case.radius) & (np.abs(y) < case.radius)
        whole = 4.0 * case.stretch * case.radius**2 * FINE**2
        picture[:] = SKIN
        picture[painted] = PAINTS[case.name]
    else:
        long = case.stretch * case.radius
        painted = (x / case.radius) ** 2 + (y / long) ** 2 < 1.0
        whole = np.pi * case.radius * long * FINE**2
        if not case.bare:
            # The finger is the cap's own width and its skin meets the paint across the upper third.
            painted &= y > -0.5 * long
            limb = ((np.abs(x) < case.radius) & (y < 0.0)) & ~painted
            picture[limb] = np.array(SKIN) * _round_shade(x / case.radius)[limb][:, None]
            whole *= 0.80450
        shade = _round_shade(np.hypot(x / case.radius, np.maximum(y, 0.0) / long))
        picture[painted] = np.array(PAINTS[case.name]) * shade[painted][:, None]
    along = (np.cos(case.direction) * u + np.sin(case.direction) * v) / case.radius
    picture *= case.light_level * _light(case.light, along / case.stretch)[..., None]
    if case.light == "highlight":
        away = np.hypot(u / case.radius - 0.4 * np.cos(case.direction), v / case.radius - 0.4 * np.sin(case.direction))
        picture += (painted * 190.0 * np.exp(-0.5 * (away / 0.22) ** 2))[..., None]
    visible = painted
    if case.cover != "none":
        hidden = along > 1.0 - 2.0 * case.covered
        color: Bgr = SKIN if case.cover == "skin" else OBJECT
        picture[hidden] = np.array(color) * case.light_level
        visible = painted & ~hidden
    return np.minimum(picture, 255.0), visible, whole, u + case.place[0], v + case.place[1]


def _round_shade(away: FloatArray) -> FloatArray:
    """Brightness of something round at a distance from its middle in radii: 1.12 at the ridge, 0.72 at the rim."""
    return 0.72 + 0.40 * np.sqrt(np.maximum(0.0, 1.0 - np.minimum(away, 1.0) ** 2))


def _light(light: Light, along: FloatArray) -> FloatArray:
    """Brightness at a place along the light's direction, in half lengths from the middle."""
    if light == "gradient":
        return np.clip(0.8 - 0.25 * along, 0.45, 1.15)
    if light == "shadow":
        return np.where(along > 0.1, 0.6, 1.0)
    return np.ones_like(along)
