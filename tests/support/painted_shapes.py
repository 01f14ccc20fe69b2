"""Painted shapes whose true centroid is known, and a rig folder to see them with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.arrays import FloatArray, ImageArray
from rhot.rig import MarkerConfig
from rhot.rig.colors import RgbColor, nominal_colors
from rhot_capture.detection.color_table import ColorTable, build_color_table

PAINTS: dict[str, RgbColor] = {
    "thumb": (30, 120, 60),
    "index": (60, 180, 230),
    "middle": (180, 230, 90),
    "ring": (40, 60, 200),
    "little": (150, 70, 200),
    "base": (230, 60, 140),
}
SKIN: RgbColor = (215, 170, 140)
CLOTH: RgbColor = (30, 30, 32)
_FINE = 8


@dataclass(frozen=True)
class Shape:
    """One painted shape on a finger: an ellipse or a rectangle, turned, centred anywhere between pixels."""

    name: str
    u: float
    v: float
    radius: float = 8.0
    angle: float = 0.0
    kind: Literal["ellipse", "rectangle"] = "ellipse"
    on_skin: bool = True
    paint: RgbColor | None = None

    @property
    def corners(self) -> FloatArray:
        """(4, 2) true corners of a rectangle."""
        half = np.array([[-1.5, -1.0], [1.5, -1.0], [1.5, 1.0], [-1.5, 1.0]]) * self.radius
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        placed: FloatArray = half @ np.array([[cos, sin], [-sin, cos]]) + (self.u, self.v)
        return placed


@dataclass(frozen=True)
class Scene:
    """A picture and what is true in it: (u, v, area) by marker name."""

    image: ImageArray
    truth: dict[str, tuple[float, float, float]]


def draw_scene(
    shapes: Sequence[Shape],
    *,
    size: tuple[int, int] = (640, 480),
    blur: float = 0.7,
    noise: float = 0.0,
    seed: int = 0,
    skin: RgbColor = SKIN,
    cloth: RgbColor = CLOTH,
) -> Scene:
    """Draw shapes at eight times the resolution and average down; truth is measured on the fine grid."""
    width, height = size
    canvas = np.empty((height, width, 3), np.float32)
    canvas[:] = cloth[::-1]
    truth = {}
    for shape in shapes:
        reach = int(2.2 * shape.radius) + 8
        left, top = round(shape.u) - reach, round(shape.v) - reach
        right, bottom = left + 2 * reach + 1, top + 2 * reach + 1
        fine_v, fine_u = np.mgrid[0 : (bottom - top) * _FINE, 0 : (right - left) * _FINE].astype(np.float32)
        u = (fine_u + 0.5) / _FINE - 0.5 + left
        v = (fine_v + 0.5) / _FINE - 0.5 + top
        across = np.cos(shape.angle) * (u - shape.u) + np.sin(shape.angle) * (v - shape.v)
        along = -np.sin(shape.angle) * (u - shape.u) + np.cos(shape.angle) * (v - shape.v)
        if shape.kind == "ellipse":
            painted = (across / shape.radius) ** 2 + (along / (1.4 * shape.radius)) ** 2 < 1.0
        else:
            painted = (np.abs(across) < 1.5 * shape.radius) & (np.abs(along) < shape.radius)
        inside = painted & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        truth[shape.name] = (float(u[inside].mean()), float(v[inside].mean()), float(inside.sum()) / _FINE**2)
        rows = slice(max(top, 0), min(bottom, height))
        columns = slice(max(left, 0), min(right, width))
        tile_rows = slice(rows.start - top, rows.stop - top)
        tile_columns = slice(columns.start - left, columns.stop - left)
        tile = canvas[rows, columns]
        if shape.on_skin:
            limb = _averaged((np.abs(across) < shape.radius) & (along < 0.0))[tile_rows, tile_columns]
            tile += limb * (np.array(skin[::-1], np.float32) - tile)
        paint = np.array((shape.paint or PAINTS[shape.name])[::-1], np.float32)
        tile += _averaged(painted)[tile_rows, tile_columns] * (paint - tile)
    if blur > 0.0:
        canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), blur), dtype=np.float32)
    if noise > 0.0:
        canvas = canvas + np.random.default_rng(seed).normal(0.0, noise, canvas.shape).astype(np.float32)
    return Scene(np.clip(np.rint(canvas), 0, 255).astype(np.uint8), truth)


def _averaged(fine: NDArray[np.bool_]) -> NDArray[np.float32]:
    rows, columns = fine.shape
    blocks = fine.reshape(rows // _FINE, _FINE, columns // _FINE, _FINE)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)[..., None]


DrawScene = Callable[..., Scene]


@pytest.fixture(scope="session")
def scene() -> DrawScene:
    return draw_scene


@pytest.fixture(scope="session")
def shape() -> type[Shape]:
    return Shape


@pytest.fixture(scope="session")
def paints() -> dict[str, RgbColor]:
    return PAINTS


@pytest.fixture(scope="session")
def markers() -> dict[str, MarkerConfig]:
    caps = {name: MarkerConfig(joint=f"{name}_tip") for name in PAINTS if name != "base"}
    return {**caps, "base": MarkerConfig(joint="wrist", kind="patch", size_m=(0.04, 0.025))}


@pytest.fixture(scope="session")
def table(paints: Mapping[str, RgbColor]) -> ColorTable:
    return build_color_table(nominal_colors(paints), list(paints))


@pytest.fixture(scope="session")
def six_shapes() -> Callable[[int], list[Shape]]:
    """Six shapes of random size, turn and sub-pixel place, by seed."""

    def make(seed: int) -> list[Shape]:
        rng = np.random.default_rng(seed)
        return [
            Shape(
                name,
                100 + 85 * index + rng.uniform(-0.5, 0.5),
                200 + 40 * (index % 2) + rng.uniform(-0.5, 0.5),
                radius=rng.uniform(5.0, 10.0),
                angle=rng.uniform(-1.0, 1.0),
                kind="rectangle" if name == "base" else "ellipse",
            )
            for index, name in enumerate(PAINTS)
        ]

    return make


@pytest.fixture
def write_rig(tmp_path: Path) -> Callable[..., Path]:
    """Writes a rig of some cameras (name to lines of its table) with the six markers."""

    def make(cameras: Mapping[str, str], extra: str = "") -> Path:
        folder = tmp_path / "rig"
        folder.mkdir(exist_ok=True)
        lines = [f"[cameras.{name}]\n{text}" for name, text in cameras.items()]
        lines += [f'[markers.{name}]\njoint = "{name}_tip"' for name in PAINTS if name != "base"]
        lines.append('[markers.base]\njoint = "wrist"\nkind = "patch"\nsize_m = [0.04, 0.025]')
        (folder / "rig.toml").write_text("\n".join([*lines, extra]))
        return folder

    return make
