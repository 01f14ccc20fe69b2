"""The colour picture: floor, shoes, trousers and markers, blurred by their motion, under a lamp that wavers.

Everything is painted from far to near: floor, what lies on it, each foot with its marker, the legs, the trunk. Markers
are drawn finer than the pixels and averaged down, so that their corners are right to a small fraction of a pixel.
Motion blur is the mean of several moments of the exposure, as many as the motion needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.aruco_dictionary import R_FOOT_MARKER, marker_corners_m
from rhot.messages import Side
from rhot_sim.walker.pictures.depth import CARD_SHARE, SHIRT, SHOE, TROUSERS, Cone, Limbs
from rhot_sim.walker.pictures.textures import CELL_PX, FLOOR_M, FLOOR_PX_PER_M, card_texture, floor_texture

Image = NDArray[np.uint8]
Bgr = tuple[float, float, float]

PAINTS: Final[dict[str, Bgr]] = {SHOE: (58.0, 52.0, 50.0), TROUSERS: (96.0, 66.0, 48.0), SHIRT: (70.0, 84.0, 96.0)}
_SHADES: Final = ((1.0, 0.72), (0.75, 0.95), (0.4, 1.12))
"""Width, as a share of the full one, and brightness, from the outline inwards."""
_WALL: Final[Bgr] = (150.0, 158.0, 160.0)
_FINER: Final = 3
_HORIZON: Final = 0.04
"""Rays that fall by less than this end at the wall."""
_CIRCLE: Final = np.stack([f(np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)) for f in (np.cos, np.sin)], axis=-1)
_FIXED_BITS: Final = 4
_NEAREST_M: Final = 0.12


@dataclass(frozen=True, slots=True)
class Card:
    """A marker on its white card.

    Attributes:
        T_rig_foot: (4, 4) pose of the card as of `rhot.messages.FootPose`.
        cells: (n + 2, n + 2) of the marker, 0 black and 1 white.
        size_m: side of the marker's black square.
        covered: share of the card, from the ankle on, that a trouser leg hides.
    """

    T_rig_foot: FloatArray
    cells: NDArray[np.uint8]
    size_m: float
    covered: float = 0.0


@dataclass(frozen=True, slots=True)
class DrawnScene:
    """What there is to paint at one moment.

    Attributes:
        T_rig_camera: (4, 4).
        limbs: the person.
        cards: side to the marker worn there.
        litter: markers that lie about on the floor.
    """

    T_rig_camera: FloatArray
    limbs: Limbs
    cards: dict[Side, Card]
    litter: Sequence[Card] = ()


class ColorRenderer:
    """Colour pictures of one camera, without the sensor's noise.

    Args:
        K: (3, 3) intrinsics, pixels.
        width, height: of the picture.
        rng: chooses the floor.
    """

    def __init__(self, K: FloatArray, width: int, height: int, rng: np.random.Generator) -> None:
        self._K = K
        self._size = (width, height)
        self._canvas: Image = np.zeros((height, width, 3), dtype=np.uint8)
        # A table of a pure function: dropping or keeping an entry changes no result.
        self._textures: dict[bytes, Image] = {}
        self._floor = floor_texture(rng)
        # Texture pixels to floor metres; the floor is the plane (x, z).
        scale = 1.0 / FLOOR_PX_PER_M
        self._floor_from_texture = np.array([[scale, 0.0, -FLOOR_M / 2], [0.0, scale, -FLOOR_M / 2], [0.0, 0.0, 1.0]])
        u = (np.array([0.0, width - 1.0]) - K[0, 2]) / K[0, 0]
        v = (np.array([0.0, height - 1.0]) - K[1, 2]) / K[1, 1]
        self._corner_rays = np.array([[x, y, 1.0] for y in v for x in u])

    def render(self, scenes: Sequence[DrawnScene], light: float) -> Image:
        """Return the mean picture (H, W, 3), uint8 BGR, of one exposure's moments under a lamp of this brightness."""
        if len(scenes) == 1:
            image = self._ground(scenes[0].T_rig_camera)
            self._paint(image, scenes[0])
            return np.asarray(cv2.convertScaleAbs(image, alpha=light), dtype=np.uint8)
        # Two moments of a blurred floor are enough: nobody measures it.
        image = self._blurred_ground(scenes[0].T_rig_camera, scenes[-1].T_rig_camera)
        window = self._window(scenes)
        total = np.zeros(image[window].shape, dtype=np.float32)
        if total.size:
            for scene in scenes:
                self._canvas[window] = image[window]
                self._paint(self._canvas, scene)
                cv2.accumulate(self._canvas[window], total)
            image[window] = cv2.convertScaleAbs(total, alpha=1.0 / len(scenes))
        return np.asarray(cv2.convertScaleAbs(image, alpha=light), dtype=np.uint8)

    def project(self, T_rig_camera: FloatArray, points: FloatArray) -> FloatArray:
        """Return pixels (N, 2) of rig points (N, 3); NaN where a point is not in front of the camera."""
        seen = (points - T_rig_camera[:3, 3]) @ T_rig_camera[:3, :3]
        pixels: FloatArray = (seen @ self._K.T)[:, :2] / seen[:, 2:]
        pixels[seen[:, 2] < _NEAREST_M] = np.nan
        return pixels

    def _window(self, scenes: Sequence[DrawnScene]) -> tuple[slice, slice]:
        """Return the rows and columns between which everything but the floor lies."""
        low, high = np.array(self._size), np.zeros(2, dtype=int)
        for scene in scenes:
            R, t = scene.T_rig_camera[:3, :3], scene.T_rig_camera[:3, 3]
            outlines = [self._outline(cone, R, t) for cone in scene.limbs.cones]
            cards = [_around(card) for card in (*scene.cards.values(), *scene.litter)]
            outlines += [self.project(scene.T_rig_camera, corners) for corners in cards]
            points = np.concatenate(outlines)
            points = points[~np.isnan(points[:, 0])].clip(-9999.0, 9999.0)
            if len(points):
                low = np.minimum(low, np.floor(points.min(axis=0)).astype(int) - 2)
                high = np.maximum(high, np.ceil(points.max(axis=0)).astype(int) + 3)
        low, high = np.maximum(low, 0), np.minimum(high, self._size)
        return slice(int(low[1]), max(int(high[1]), int(low[1]))), slice(int(low[0]), max(int(high[0]), int(low[0])))

    def _paint(self, image: Image, scene: DrawnScene) -> None:
        """Paint all but the floor, from far to near, into an image in place."""
        for card in scene.litter:
            self._paint_card(image, scene.T_rig_camera, card)
        camera = scene.T_rig_camera[:3, 3]
        for side in _far_to_near(scene.limbs.shoes, camera):
            for cone in scene.limbs.shoes[side]:
                self._paint_cone(image, scene.T_rig_camera, cone)
            if side in scene.cards:
                self._paint_card(image, scene.T_rig_camera, scene.cards[side])
        for side in _far_to_near(scene.limbs.legs, camera):
            for cone in scene.limbs.legs[side]:
                self._paint_cone(image, scene.T_rig_camera, cone)
        self._paint_cone(image, scene.T_rig_camera, scene.limbs.trunk)

    def _ground(self, T_rig_camera: FloatArray, scale: float = 1.0) -> Image:
        """Return the floor, and the wall where the picture looks up, at a share of the full size."""
        R, t = T_rig_camera[:3, :3], T_rig_camera[:3, 3]
        # Pixel centres lie on integers, so sizes scale about -0.5.
        shrink = np.array([[scale, 0.0, (scale - 1.0) / 2.0], [0.0, scale, (scale - 1.0) / 2.0], [0.0, 0.0, 1.0]])
        K = shrink @ self._K
        size = (round(self._size[0] * scale), round(self._size[1] * scale))
        image = np.asarray(
            cv2.warpPerspective(
                self._floor,
                K @ np.stack([R[0], R[2], -R.T @ t], axis=-1) @ self._floor_from_texture,
                size,
                flags=cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=_WALL,
            ),
            dtype=np.uint8,
        )
        if (self._corner_rays @ R[1] > -_HORIZON).any():
            line = R[1] @ np.linalg.inv(K)
            rise = line[0] * np.arange(size[0]) + line[1] * np.arange(size[1])[:, None] + line[2]
            image[rise > -_HORIZON] = np.array(_WALL, dtype=np.uint8)
        return image

    def _blurred_ground(self, first: FloatArray, last: FloatArray) -> Image:
        """Return the mean of the floor at two moments."""
        both = cv2.addWeighted(self._ground(first, 0.5), 0.5, self._ground(last, 0.5), 0.5, 0.0)
        return np.asarray(cv2.resize(both, self._size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)

    def _outline(self, cone: Cone, R: FloatArray, t: FloatArray) -> FloatArray:
        """Return pixels (M, 2) whose hull is a cone's picture; empty where it is not in front of the camera."""
        ends, radii = _in_front((cone.ends - t) @ R, cone.radii)
        centers = (ends @ self._K.T)[:, :2] / ends[:, 2:]
        sizes = self._K[0, 0] * radii / ends[:, 2]
        outline: FloatArray = (centers[:, None] + sizes[:, None, None] * _CIRCLE).reshape(-1, 2)
        return outline

    def _paint_cone(self, image: Image, T_rig_camera: FloatArray, cone: Cone) -> None:
        outline = self._outline(cone, T_rig_camera[:3, :3], T_rig_camera[:3, 3])
        if not len(outline):
            return
        rings = outline.reshape(2, -1, 2)
        centers = rings.mean(axis=1, keepdims=True)
        color = PAINTS[cone.paint]
        for width, brightness in _SHADES:
            points = (centers + width * (rings - centers)).reshape(-1, 2)
            hull = cv2.convexHull(np.rint(points * (1 << _FIXED_BITS)).astype(np.int32))
            shade = (brightness * color[0], brightness * color[1], brightness * color[2])
            cv2.fillConvexPoly(image, hull, shade, cv2.LINE_AA, _FIXED_BITS)

    def _paint_card(self, image: Image, T_rig_camera: FloatArray, card: Card) -> None:
        R, t = T_rig_camera[:3, :3], T_rig_camera[:3, 3]
        normal = card.T_rig_foot[:3, 1]
        towards = t - card.T_rig_foot[:3, 3]
        if towards @ normal <= 0.02 * np.linalg.norm(towards):
            return
        count = card.cells.shape[0]
        cell_m = card.size_m / count
        quiet = round((CARD_SHARE - 1.0) / 2.0 * count * CELL_PX) / CELL_PX
        whole = count + 2.0 * quiet
        # Card coordinates in cells from its upper left corner: x right, y down.
        R_rig_marker = card.T_rig_foot[:3, :3] @ R_FOOT_MARKER
        corner = card.T_rig_foot[:3, 3] + R_rig_marker @ (cell_m * whole / 2.0 * np.array([-1.0, 1.0, 0.0]))
        in_camera = R.T @ np.column_stack([cell_m * R_rig_marker[:, 0], -cell_m * R_rig_marker[:, 1], corner - t])
        H = self._K @ in_camera
        outline = H @ np.array([[0.0, whole, whole, 0.0], [0.0, 0.0, whole, whole], [1.0, 1.0, 1.0, 1.0]])
        if (outline[2] < _NEAREST_M).any():
            return
        outline = outline[:2] / outline[2]
        low = np.maximum(np.floor(outline.min(axis=1)).astype(int) - 1, 0)
        high = np.minimum(np.ceil(outline.max(axis=1)).astype(int) + 2, self._size)
        if (low >= high).any():
            return
        key = card.cells.tobytes()
        if key not in self._textures:
            self._textures[key] = card_texture(card.cells, quiet)
        # Pixel centres lie on integers in both pictures.
        cells_from_texture = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, CELL_PX]]) / CELL_PX
        finer = np.array([[_FINER, 0.0, (_FINER - 1) / 2], [0.0, _FINER, (_FINER - 1) / 2], [0.0, 0.0, 1.0]])
        shifted = np.array([[1.0, 0.0, -low[0]], [0.0, 1.0, -low[1]], [0.0, 0.0, 1.0]])
        size = (int(high[0] - low[0]), int(high[1] - low[1]))
        fine = cv2.warpPerspective(
            self._textures[key],
            finer @ shifted @ H @ cells_from_texture,
            (_FINER * size[0], _FINER * size[1]),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(0.0, 0.0),
        )
        patch = np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        # Seen more from the side, paper is a little darker.
        slant = float(towards @ normal / np.linalg.norm(towards))
        alpha = patch[..., 1:] / 255.0
        part = image[low[1] : high[1], low[0] : high[0]]
        blended = part * (1.0 - alpha) + patch[..., :1] * np.float32(0.75 + 0.25 * slant)
        part[:] = (blended + 0.5).astype(np.uint8)
        if card.covered > 0.0:
            self._paint_hem(image, H, whole, card.covered)

    def _paint_hem(self, image: Image, H: FloatArray, whole: float, covered: float) -> None:
        edge = whole * (1.0 - covered)
        quad = np.array([[-0.6, whole + 0.6, whole + 0.6, -0.6], [edge, edge, whole + 1.5, whole + 1.5], [1.0] * 4])
        pixels = H @ quad
        corners = np.rint((pixels[:2] / pixels[2]).T * (1 << _FIXED_BITS)).astype(np.int32)
        cv2.fillConvexPoly(image, corners, PAINTS[TROUSERS], cv2.LINE_AA, _FIXED_BITS)


def _around(card: Card) -> FloatArray:
    """Return four points (4, 3) around a card and the hem over it, rig frame."""
    corners = marker_corners_m(2.0 * card.size_m)
    points: FloatArray = corners @ card.T_rig_foot[:3, :3].T + card.T_rig_foot[:3, 3]
    return points


def _far_to_near(parts: dict[Side, list[Cone]], camera: FloatArray) -> list[Side]:
    """Return the sides, the farther first by the middle of its first cone."""
    return sorted(parts, key=lambda side: -float(np.linalg.norm(parts[side][0].ends.mean(axis=0) - camera)))


def _in_front(ends: FloatArray, radii: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the part of a cone, camera frame, that lies in front of the camera; empty when none does."""
    z = ends[:, 2]
    if (z >= _NEAREST_M).all():
        return ends, radii
    if (z < _NEAREST_M).all():
        return ends[:0], radii[:0]
    near, far = (0, 1) if z[0] < z[1] else (1, 0)
    share = (_NEAREST_M - z[near]) / (z[far] - z[near])
    cut = ends[near] + share * (ends[far] - ends[near])
    radius = radii[near] + share * (radii[far] - radii[near])
    return np.stack([cut, ends[far]]), np.array([radius, radii[far]])
