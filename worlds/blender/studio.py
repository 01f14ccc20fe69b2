"""Render the pictures of a world; what is there already stays, so an interrupted run goes on. Needs `bpy`."""

from __future__ import annotations

import json
import logging
import shutil
import time
from dataclasses import asdict
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from worlds.blender.scene import Scene
from worlds.cameras import CAMERAS
from worlds.look import Colour
from worlds.sensor import Pinhole, Sensor, jpeg, random_sensor
from worlds.truth import Seen, write_fixed, write_seen
from worlds.world import World, board_corners

_LOG = logging.getLogger(__name__)
_KEPT: Final = ".render"
"""Folder in a set for what a later run needs: empty pictures, gain, and what each picture shows."""
_FEATHER_PX: Final = 14
_STILL_SAMPLES: Final = 32
"""A pixel, of pictures in which nothing moves: corners and boxes are measured in them."""
_BOARD_REACH, _BOARD_ROOM_PX = 1.7, 20.0
"""Border of the board: its corner grid, stretched, and a margin for the shadow."""
_WHITE: Final = 0.75
"""Reflectance of the chessboard's white, which must not saturate."""
_LUMINANCE: Final = np.array([0.2126, 0.7152, 0.0722])


class Studio:
    """Renders one world into a folder."""

    def __init__(self, world: World, root: Path, samples: int) -> None:
        """Build the scene.

        Args:
            world: to render.
            root: of the set.
            samples: a pixel.
        """
        self._world, self._root, self._samples = world, root, samples
        self._kept = root / _KEPT
        self._kept.mkdir(parents=True, exist_ok=True)
        self._scene = Scene(world)
        self._pinholes = {name: Pinhole.of(camera) for name, camera in world.cameras.items()}
        write_fixed(world, self._scene.skin, root)
        self._empty = {name: self._empty_picture(name) for name in CAMERAS}
        self._sensors = self._random_sensors()

    def sequence(self, name: str) -> None:
        """Render a sequence and write its truth."""
        timing = self._world.timings[name]
        seen: dict[tuple[str, int], list[Seen]] = {}
        staged = False
        for frame in range(timing.count):
            for camera in CAMERAS:
                picture = self._root / name / camera / f"{frame:06d}.jpg"
                note = self._kept / f"{name}_{camera}_{frame:06d}.json"
                if not (picture.exists() and note.exists()):
                    if not staged or name == "C":
                        self._scene.stage(name, self._world.boards[frame] if name == "C" else None)
                        staged = True
                    began = time.monotonic()
                    parts = self._picture(name, camera, frame, picture)
                    note.write_text(json.dumps([asdict(part) for part in parts]), encoding="utf-8")
                    _LOG.info("%s %s %d: %.1f s", name, camera, frame, time.monotonic() - began)
                kept = json.loads(note.read_text(encoding="utf-8"))
                seen[camera, frame] = [Seen(p["area"], tuple(p["centroid"]), tuple(p["box"])) for p in kept]
        if name != "C":
            write_seen(self._world, self._scene.skin, name, seen, self._root)

    def _picture(self, name: str, camera: str, frame: int, path: Path) -> list[Seen]:
        light, masks = self._light(name, camera, frame)
        t_ns = self._world.timings[name].t_ns(camera, frame)
        rng = np.random.default_rng([self._world.seed, t_ns // 1000, CAMERAS.index(camera)])
        picture = self._sensors[camera].picture(light, 1e-9 * t_ns, rng)
        path.write_bytes(jpeg(picture))
        return [Seen.of(masks[..., place]) for place in range(6)]

    def _light(self, name: str, camera: str, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return linear light (480, 640, 3) and the markers' coverage (480, 640, 6) in the distorted picture."""
        world, pinhole = self._world, self._pinholes[camera]
        view, timing = world.cameras[camera], world.timings[name]
        after_s = 1e-9 * (timing.t_ns(camera, frame) - timing.first_ns)
        if name == "C":
            board = world.boards[frame]
            outline = _BOARD_REACH * board_corners() @ board[:3, :3].T + board[:3, 3]
            x0, y0, x1, y1 = pinhole.border(view, outline, _BOARD_ROOM_PX)
            layers = self._scene.render(view, pinhole, None, after_s, (x0, y0, x1, y1), _STILL_SAMPLES)
        else:
            x0, y0, x1, y1 = self._scene.border(view, pinhole, timing, after_s)
            moving = (None, _STILL_SAMPLES) if name == "K" else (timing, self._samples)
            layers = self._scene.render(view, pinhole, moving[0], after_s, (x0, y0, x1, y1), moving[1])
        part = layers["Combined"][..., :3]
        if part.shape[:2] != (y1 - y0, x1 - x0):
            raise RuntimeError(f"Blender rendered {part.shape[:2]} instead of {(y1 - y0, x1 - x0)}")
        whole = self._empty[camera].copy()
        blend = _feathered(part.shape[:2], (x0, y0, x1, y1), pinhole.size)[..., None]
        whole[y0:y1, x0:x1] = blend * part + (1.0 - blend) * whole[y0:y1, x0:x1]
        masks = np.zeros((*whole.shape[:2], 6), np.float32)
        masks[y0:y1, x0:x1] = np.concatenate([layers["maskA"][..., :3], layers["maskB"][..., :3]], axis=-1)
        coverage = [pinhole.to_lens(masks[..., i : i + 3].copy(), cv2.INTER_LINEAR) for i in (0, 3)]
        return pinhole.to_lens(whole), np.concatenate(coverage, axis=-1)

    def _empty_picture(self, camera: str) -> np.ndarray:
        path = self._kept / f"empty_{camera}.npy"
        if not path.exists():
            self._scene.stage("empty")
            layers = self._scene.render(
                self._world.cameras[camera], self._pinholes[camera], None, samples=_STILL_SAMPLES
            )
            np.save(path, layers["Combined"][..., :3])
        return np.asarray(np.load(path))

    def _random_sensors(self) -> dict[str, Sensor]:
        path = self._kept / "gain.json"
        if not path.exists():
            self._scene.stage("K")
            light, masks = self._light("K", "left", 0)
            base = masks[..., 5] > 0.99
            lit = float((light[base] @ _LUMINANCE).mean()) / _luminance(self._world.look.paints["base"].colour)
            path.write_text(json.dumps(lit), encoding="utf-8")
        lit = json.loads(path.read_text(encoding="utf-8"))
        rng = np.random.default_rng([self._world.seed, 77])
        look = self._world.look
        grey = max(0.5 * _luminance(look.skin) + 0.17, 0.9 * _luminance(look.desk[1]))
        gain = min(rng.uniform(0.32, 0.46) / grey, 0.85 / _WHITE) / lit
        return {camera: random_sensor(rng, gain) for camera in CAMERAS}


def render_world(world: World, root: Path, samples: int, scorer: Path | None) -> None:
    """Render a world as a set of pictures.

    Args:
        world: to render.
        root: of the set; made when it is not there.
        samples: a pixel.
        scorer: `score.py` to put beside it.
    """
    studio = Studio(world, root, samples)
    if scorer is not None:
        shutil.copyfile(scorer, root / "score.py")
    for name in ("K", "C", "G1", "G2"):
        studio.sequence(name)


def _feathered(shape: tuple[int, int], border: tuple[int, int, int, int], size: tuple[int, int]) -> np.ndarray:
    """Return the share of a part in the whole: 1 inside, 0 at the edges that are not those of the whole."""
    x0, y0, x1, y1 = border
    x, y = np.arange(shape[1]), np.arange(shape[0])
    far = np.float32(1e3)
    across = np.minimum(np.where(x0 > 0, x, far), np.where(x1 < size[0], shape[1] - 1 - x, far))
    down = np.minimum(np.where(y0 > 0, y, far), np.where(y1 < size[1], shape[0] - 1 - y, far))
    ramp = np.clip(np.minimum(down[:, None], across) / _FEATHER_PX, 0.0, 1.0)
    return (ramp * ramp * (3.0 - 2.0 * ramp)).astype(np.float32)


def _luminance(colour: Colour) -> float:
    return float(np.array(colour) @ _LUMINANCE)
