"""The picture of the simulated world in one camera.

Outlines are drawn anti-aliased on a canvas of twice the size, group by group from far to near, and averaged down; only
the neighbourhood of hands and objects is drawn. Motion blur is the mean of several moments of the exposure, as many as
the motion needs: a still hand costs one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.anatomy.markers import own_paints, worn_paints
from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.rig.config import CameraConfig, SimConfig
from rhot_sim.rendering.backdrop import Backdrop, Image, SensorNoise
from rhot_sim.rendering.canvas import AA_GROWTH, AA_SEAM, CanvasWindow, disjoint, far_to_near, paint_groups
from rhot_sim.rendering.outline import OutlinePaths, Outliner, row_timed
from rhot_sim.world.board import BOARD, RIM_SQUARES, ChessBoard
from rhot_sim.world.body import Body
from rhot_sim.world.paint import OBJECT, SKIN, Bgr, paints_of, shaded
from rhot_sim.world.parts import Group
from rhot_sim.world.script import seeded
from rhot_sim.world.world import World

# The simulated chessboard in one camera's picture.
#
# Every pixel's ray is met with the board's plane, and the pattern is averaged over the pixel. The average is exact
# for a box in the plane whose sides lie along the board's: with the width w_x = |∇x| it has the variance of the
# pixel's own footprint, and lying evenly about the pixel it shifts no edge and no corner.

Poses = Callable[[FloatArray], FloatArray]

PAPER: Final = 205.0
INK: Final = 28.0
CARDBOARD: Final = 120.0
"""Grey levels in even light: of paper, of ink, and of the back."""


class BoardPainter:
    """Paints a board into the pictures of one camera.

    Args:
        camera: the true camera.
        board: its size.
    """

    def __init__(self, camera: CameraModel, board: ChessBoard) -> None:
        self._camera = camera
        self._board = board
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.undistort(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
        self._rays = np.ascontiguousarray(rays.reshape(camera.height, camera.width, 2).transpose(2, 0, 1))

    def paint(self, image: Image, poses: Poses, moments_s: FloatArray, readout_s: float, light: float) -> None:
        """Paint the board into an image (height, width, 3) in place: the mean over moments of the exposure.

        Args:
            image: as it is without the board.
            poses: gives T_rig_board (N, 4, 4), metres, at times (N,).
            moments_s: (M,) moments of the first row.
            readout_s: from the first to the last row.
            light: the lamp's brightness.
        """
        ends = poses(np.array([moments_s[0], moments_s[-1] + readout_s]))
        still = bool(np.array_equal(ends[0], ends[1]))
        window = self._window(ends)
        if window is None:
            return
        area = (slice(window.top, window.bottom), slice(window.left, window.right))
        row_share = np.arange(window.top, window.bottom) / (self._camera.height - 1)
        total = np.zeros(image[area].shape[:2])
        covered = np.zeros_like(total)
        drawn = moments_s[:1] if still else moments_s
        for moment in drawn:
            at = poses(moments_s[:1] if still else moment + readout_s * row_share)
            share, gray = self._seen(at, area)
            total += share * gray
            covered += share
        board, desk = light * total / len(drawn), 1.0 - covered / len(drawn)
        mixed = image[area] * desk[..., None] + board[..., None]
        image[area] = np.clip(np.rint(mixed), 0.0, 255.0).astype(np.uint8)

    def travel_px(self, poses: FloatArray) -> float:
        """Return how far the board's edge moves in the picture between two poses (2, 4, 4), pixels."""
        first, second = (self._camera.project(self._board.outline @ T[:3, :3].T + T[:3, 3]) for T in poses)
        return float(np.nan_to_num(np.abs(second - first)).max())

    def _window(self, poses: FloatArray) -> CanvasWindow | None:
        points = np.concatenate([self._board.outline @ T[:3, :3].T + T[:3, 3] for T in poses])
        pixels = self._camera.project(points)
        width, height = self._camera.width, self._camera.height
        if np.isnan(pixels).all():
            return None
        # Partly behind the camera, the board's edge is nowhere in the picture.
        return (
            CanvasWindow(0, 0, width, height) if np.isnan(pixels).any() else CanvasWindow.around(pixels, width, height)
        )

    def _seen(self, T_rig_board: FloatArray, area: tuple[slice, slice]) -> tuple[FloatArray, FloatArray]:
        """Return the share of each pixel that the board covers, and its grey level, for one pose or one a row."""
        R = self._camera.R_camera_rig @ T_rig_board[:, :3, :3]
        t = T_rig_board[:, :3, 3] @ self._camera.R_camera_rig.T + self._camera.t_camera_rig
        # With p = (x, y, 1) on the board, metres, and the ray r: λ r = [R_x R_y t] p.
        M = np.linalg.inv(np.stack([R[:, :, 0], R[:, :, 1], t], axis=-1))[:, :, :, None]
        u, v = self._rays[0][area], self._rays[1][area]
        first, second, depth = (M[:, i, 0] * u + M[:, i, 1] * v + M[:, i, 2] for i in range(3))
        ahead = depth > 0.0
        depth = np.where(ahead, depth, np.inf) * self._board.square_m
        x, y = first / depth, second / depth
        across, down = _width(x), _width(y)
        low, right, bottom = -1.0, float(self._board.columns), float(self._board.rows)
        share = _inside(x, across, low - RIM_SQUARES, right + RIM_SQUARES)
        share *= _inside(y, down, low - RIM_SQUARES, bottom + RIM_SQUARES)
        printed = _inside(x, across, low, right) * _inside(y, down, low, bottom)
        signed = _wave(x, across, low, right) * _wave(y, down, low, bottom)
        gray = PAPER + 0.5 * (printed + signed) * (INK - PAPER)
        # Seen from behind where z points at the camera.
        behind = np.einsum("nc,nc->n", R[:, :, 2], t) < 0.0
        return share * ahead, np.where(behind[:, None], CARDBOARD, gray)


def _width(x: FloatArray) -> FloatArray:
    """Return the length of x's gradient over the picture, at least a little."""
    rows, columns = np.gradient(x)
    width: FloatArray = np.maximum(np.hypot(rows, columns), 1e-6)
    return width


def _inside(x: FloatArray, width: FloatArray, low: float, high: float) -> FloatArray:
    """Return the share of [x − w/2, x + w/2] that lies between low and high."""
    share: FloatArray = (np.clip(x + width / 2.0, low, high) - np.clip(x - width / 2.0, low, high)) / width
    return share


def _wave(x: FloatArray, width: FloatArray, low: float, high: float) -> FloatArray:
    """Return the mean over [x − w/2, x + w/2] of +1 on even squares, −1 on odd ones, 0 outside [low, high]."""
    ends = (np.clip(x + side * width / 2.0, low, high) for side in (1.0, -1.0))
    after, before = (1.0 - np.abs(np.mod(end, 2.0) - 1.0) for end in ends)
    mean: FloatArray = (after - before) / width
    return mean


SCALE: Final = 2
VERTICES: Final = 16
MAX_MOMENTS: Final = 4
_STILL_PX: Final = 0.3


@dataclass(frozen=True, slots=True)
class _Scene:
    """What one picture shows, before it is painted.

    Attributes:
        t_first_row_s: start of the first row's exposure, seconds since the world's start.
        exposure_s, readout_s: exposure of every row; time from the first to the last row.
        paths: of all outlines.
        groups: of the parts that face the camera.
    """

    t_first_row_s: float
    exposure_s: float
    readout_s: float
    paths: OutlinePaths
    groups: list[Group]


class Renderer:
    """Renders the world as one simulated camera sees it; the same arguments give the same bytes in any process.

    Args:
        camera: the true camera.
        world: what it looks at.
        config: noise and light.
        camera_config: exposure and read-out unless given with the frame.
        seed: of this camera's own noise and desk; cameras differ in it.
        paints: colours by marker name, `skin` and `object`, in place of the usual ones.
    """

    def __init__(
        self,
        camera: CameraModel,
        world: World,
        config: SimConfig,
        camera_config: CameraConfig,
        seed: int = 0,
        *,
        paints: Mapping[str, Bgr] | None = None,
    ) -> None:
        self.camera = camera
        self.world = world
        self._config = config
        self._camera_config = camera_config
        self._seed = seed
        self._body = Body(world)
        self._board = None if world.board is None else BoardPainter(camera, world.board)
        self._outliner = Outliner(camera, VERTICES, AA_GROWTH / SCALE, AA_SEAM)
        self._backdrop = Backdrop(camera.width, camera.height, SCALE, config.light_drift, seeded(config.seed, 10, seed))
        self._noise = SensorNoise(camera.width, camera.height, config.noise_sigma, seeded(config.seed, 11, seed))
        self._lamp_phase = seeded(config.seed, 12).uniform(0.0, 2.0 * np.pi, 2)
        # Two sensors of one kind still differ a little in colour.
        gain = 1.0 + (0.015 if config.light_drift > 0.0 else 0.0) * seeded(config.seed, 13, seed).uniform(-1, 1, 3)
        bought = paints_of(own_paints(world.markers))
        worn = {name: bought[paint] for name, paint in worn_paints(world.markers).items()}
        colors: dict[str, Bgr] = {"skin": SKIN, "object": OBJECT, **worn, **(paints or {})}
        self._paints: dict[str, Bgr] = {
            name: (color[0] * gain[0], color[1] * gain[1], color[2] * gain[2]) for name, color in colors.items()
        }
        self._canvas: Image = self._backdrop.at(1.0)[1].copy()

    def light(self, t_s: float) -> float:
        """Return the lamp's brightness at a time, 1 on average: a slow drift of `light_drift` at most."""
        first, second = self._lamp_phase
        wave = 0.7 * np.sin(2.0 * np.pi * t_s / 23.0 + first) + 0.3 * np.sin(2.0 * np.pi * t_s / 5.3 + second)
        return 1.0 + self._config.light_drift * float(wave)

    def render(self, t_first_row_s: float, exposure_s: float | None = None, readout_s: float | None = None) -> Image:
        """Return the picture (height, width, 3), uint8, blue green red.

        Args:
            t_first_row_s: start of the first row's exposure, seconds since the world's start.
            exposure_s: exposure of every row; the camera's own when not given.
            readout_s: time from the first to the last row; the camera's own when not given.
        """
        exposure = self._camera_config.exposure_s if exposure_s is None else exposure_s
        readout = self._camera_config.readout_s if readout_s is None else readout_s
        image: Image = np.empty((self.camera.height, self.camera.width, 3), dtype=np.uint8)
        for scene in self._scenes([t_first_row_s], exposure, readout):
            self._draw(scene, image)
        return image

    def render_all(self, t_first_rows_s: Sequence[float], out: Sequence[Image]) -> Iterator[Image]:
        """Draw several pictures with the camera's own exposure and read-out, one at each step.

        Together they cost a sixth less than one by one: where everything is in all of them is worked out at once.

        Args:
            t_first_rows_s: as for `render`.
            out: where to draw them.
        """
        config = self._camera_config
        for scene, image in zip(self._scenes(t_first_rows_s, config.exposure_s, config.readout_s), out, strict=True):
            self._draw(scene, image)
            yield image

    def _scenes(self, t_first_rows_s: Sequence[float], exposure_s: float, readout_s: float) -> list[_Scene]:
        begin, span = np.array(t_first_rows_s), exposure_s + readout_s
        sample = self.world.sample((begin[:, None] + span * np.array([0.0, 0.5, 1.0])).ravel())
        rings, groups = self._body.rings(sample, self.camera.center, len(begin))
        paths = self._outliner.paths(rings, len(begin))
        return [
            _Scene(t_s, exposure_s, readout_s, path, drawn)
            for t_s, path, drawn in zip(begin.tolist(), paths, groups, strict=True)
        ]

    def _draw(self, scene: _Scene, image: Image) -> None:
        exposure, readout, paths = scene.exposure_s, scene.readout_s, scene.paths
        span = exposure + readout
        light = self.light(scene.t_first_row_s + span / 2.0)
        plain, large = self._backdrop.at(light)
        np.copyto(image, plain)
        if paths.middle.size:
            groups = far_to_near(scene.groups, paths.distances)
            moments = self._moments(paths, exposure, span)
            drawn = [row_timed(paths, moment, exposure, readout, self.camera.height) for moment in moments]
            shades = {stroke.color for group in groups for stroke in group.strokes}
            colors = {(paint, shade): self._color(paint, shade * light) for paint, shade in shades}
            windows = self._windows(drawn)
            for window in disjoint(windows.values()):
                area = (slice(window.top, window.bottom), slice(window.left, window.right))
                here = [group for group in groups if group.owner in windows and windows[group.owner].overlaps(window)]
                image[area] = self._exposed(window, drawn, here, colors, large)
        if self._board is not None:
            self._paint_board(self._board, image, scene.t_first_row_s, (exposure, readout), light)
        digest = hashlib.blake2b(f"{self._seed} {round(scene.t_first_row_s * 1e9)}".encode(), digest_size=4).digest()
        self._noise.add(image, int.from_bytes(digest, "big"))

    def _paint_board(
        self, painter: BoardPainter, image: Image, t_first_row_s: float, spans_s: tuple[float, float], light: float
    ) -> None:
        """Paint the board into an image in place; `spans_s` are exposure and read-out."""
        exposure_s, readout_s = spans_s

        def poses(t_s: FloatArray) -> FloatArray:
            return self.world.motion.sample(t_s).objects[BOARD]

        begin = t_first_row_s + 0.5 * readout_s
        moved_px = painter.travel_px(poses(np.array([begin, begin + exposure_s])))
        moments_s = t_first_row_s + exposure_s * _shares_of_exposure(moved_px)
        painter.paint(image, poses, moments_s, readout_s, light)

    def _color(self, paint: str, brightness: float) -> Bgr:
        return shaded(self._paints[paint], brightness)

    def _moments(self, paths: OutlinePaths, exposure_s: float, span_s: float) -> FloatArray:
        """Return the moments of the exposure to draw, as shares of it: the mean of equal parts."""
        if span_s <= 0.0:
            return np.array([0.5])
        # The forearm's far end swings widely, out of the picture.
        seen = self.camera.contains(paths.middle.reshape(-1, 2)).reshape(paths.middle.shape[:2])
        moved_px = float(np.abs(paths.end - paths.start).max(axis=-1)[seen].max(initial=0.0)) * exposure_s / span_s
        return _shares_of_exposure(moved_px)

    def _windows(self, drawn: list[FloatArray]) -> dict[str, CanvasWindow]:
        """Return the window around each hand and object that is in the picture."""
        windows: dict[str, CanvasWindow] = {}
        for owner, rings in self._body.owner_rings.items():
            points = np.concatenate([points[rings] for points in drawn])
            window = CanvasWindow.around(points, self.camera.width, self.camera.height)
            if window is not None:
                windows[owner] = window
        return windows

    def _exposed(
        self,
        window: CanvasWindow,
        drawn: list[FloatArray],
        groups: list[Group],
        colors: Mapping[tuple[str, float], Bgr],
        desk: Image,
    ) -> Image:
        """Return the part of the picture in a window: the mean over the drawn moments."""
        enlarged = (
            slice(window.top * SCALE, window.bottom * SCALE),
            slice(window.left * SCALE, window.right * SCALE),
        )
        canvas, background = self._canvas[enlarged], desk[enlarged]
        size = (window.right - window.left, window.bottom - window.top)
        total = np.zeros((size[1], size[0], 3), dtype=np.float32)
        for points in drawn:
            np.copyto(canvas, background)
            paint_groups(canvas, points, groups, colors, window=window, scale=SCALE)
            small: Image = np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
            if len(drawn) == 1:
                return small
            cv2.accumulate(small, total)
        return np.asarray(cv2.convertScaleAbs(total, alpha=1.0 / len(drawn)), dtype=np.uint8)


def _shares_of_exposure(moved_px: float) -> FloatArray:
    """Return the moments of an exposure to draw, as shares of it: as many as a motion of so many pixels needs."""
    count = 1 if moved_px < _STILL_PX else min(MAX_MOMENTS, 1 + int(np.ceil(moved_px / 0.6)))
    shares: FloatArray = (np.arange(count) + 0.5) / count
    return shares
