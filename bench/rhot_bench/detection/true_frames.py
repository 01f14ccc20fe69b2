"""Simulated pictures with all faults on and the true centre of every marker's visible paint, in bursts.

Some bursts carry what leads a detector astray: a marker that wears no paint, spots of a marker's colour on the desk,
much sensor noise, and pictures moved so far aside that the border cuts a marker. A burst is several frames in a row, so
that a detector can track.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.rig import Rig, load_rig
from rhot.rig.colors import ColorsFile, nominal_colors
from rhot.rig.template import rig_template
from rhot_sim.rendering.coverage import MarkerCoverage, MarkerView
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.folder import true_cameras
from rhot_sim.world.paint import SKIN, paints_of
from rhot_sim.world.world import World

BURST: Final = 3
RATE_HZ: Final = 60.0
EXPOSURE_S: Final = 0.006
READOUT_S: Final = 0.012


@dataclass(frozen=True, slots=True)
class TrueFrame:
    """A picture and what is true in it.

    Attributes:
        burst: number of the burst; a detector starts over with each.
        image: (H, W, 3) uint8 BGR.
        views: of each marker at mid-exposure of its own row; one that wears no paint is absent.
    """

    burst: int
    image: NDArray[np.uint8]
    views: dict[str, MarkerView]


def simulated_rig(seed: int, noise_sigma: float = 3.0) -> Rig:
    """Return the usual two-camera rig with simulated cameras."""
    with tempfile.TemporaryDirectory() as folder:
        text = rig_template(folder="rig", name="bench").replace('"picamera2"', '"simulated"')
        (Path(folder) / "rig.toml").write_text(text)
        rig = load_rig(Path(folder))
    sim = rig.config.sim.model_copy(update={"seed": seed, "noise_sigma": noise_sigma})
    return replace(rig, config=rig.config.model_copy(update={"sim": sim}))


def rig_colors(rig: Rig) -> ColorsFile:
    """Return the colours that the simulated paints have in even light."""
    paints = paints_of(rig.config.markers)
    return nominal_colors({name: (red, green, blue) for name, (blue, green, red) in paints.items()})


def true_frames(seed: int, bursts: int, *, faults: bool = True) -> Iterator[TrueFrame]:
    """Yield bursts of frames of scripted motion, by turns from the rig's cameras.

    Args:
        seed: of motion, cameras and faults.
        bursts: how many.
        faults: with bare markers, spots on the desk and more noise in some bursts.
    """
    rng = np.random.default_rng(seed)
    for burst in range(bursts):
        rig = simulated_rig(seed, noise_sigma=float(rng.uniform(3.0, 6.0)) if faults else 3.0)
        names = list(rig.config.markers)
        camera = list(rig.config.cameras)[burst % len(rig.config.cameras)]
        model = true_cameras(rig)[camera]
        world = World.from_rig(rig)
        bare = set(rng.choice(names, int(rng.integers(0, 3)), replace=False)) if faults and burst % 2 else set()
        renderer = Renderer(
            model, world, rig.config.sim, rig.config.cameras[camera], burst % 2, paints=dict.fromkeys(bare, SKIN)
        )
        coverage = MarkerCoverage(model, world, scale=6, vertices=48)
        spots = _spots(rng, names) if faults and burst % 3 == 0 else []
        begin_s = float(rng.uniform(0.0, 120.0))
        aside = _aside(rng, coverage.at(begin_s)) if faults and burst % 4 == 3 else 0
        for step in range(BURST):
            t_s = begin_s + step / RATE_HZ
            image = renderer.render(t_s, EXPOSURE_S, READOUT_S)
            for u, v, radius, color in spots:
                cv2.ellipse(image, (u, v), radius, 30.0, 0.0, 360.0, color, cv2.FILLED, cv2.LINE_AA)
            middle = coverage.at(t_s + 0.5 * (EXPOSURE_S + READOUT_S))
            views = {}
            for name, view in middle.items():
                if name not in bare:
                    row_s = READOUT_S * view.v / (model.height - 1)
                    views[name] = coverage.at(t_s + row_s + 0.5 * EXPOSURE_S)[name]
            if aside > 0:
                image, views = _moved_left(image, views, aside, rng)
            yield TrueFrame(burst, image, views)


def _aside(rng: np.random.Generator, views: dict[str, MarkerView]) -> int:
    """Return by how many columns to move a picture to the left so that its border runs through a marker."""
    seen = [view.u for view in views.values() if view.area_px > 0.0 and view.inside]
    return max(0, round(float(rng.choice(seen)) + float(rng.uniform(-5.0, 5.0)))) if seen else 0


def _moved_left(
    image: NDArray[np.uint8], views: dict[str, MarkerView], columns: int, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], dict[str, MarkerView]]:
    """Return a picture without its first columns, dark desk instead on the right, and the views in it."""
    moved = np.clip(np.rint(rng.normal(24.0, 3.0, image.shape)), 0, 255).astype(np.uint8)
    moved[:, : image.shape[1] - columns] = image[:, columns:]
    return moved, {name: replace(view, u=view.u - columns) for name, view in views.items()}


def _spots(
    rng: np.random.Generator, names: list[str]
) -> list[tuple[int, int, tuple[int, int], tuple[float, float, float]]]:
    """Return ellipses of markers' colours, more or less lit: u, v, half axes, colour."""
    paints = paints_of(names)
    spots = []
    for _ in range(int(rng.integers(1, 4))):
        blue, green, red = np.array(paints[str(rng.choice(names))]) * rng.uniform(0.6, 1.1) + rng.normal(0.0, 8.0, 3)
        axes = (int(rng.integers(2, 8)), int(rng.integers(2, 8)))
        spots.append((int(rng.integers(20, 620)), int(rng.integers(20, 460)), axes, (blue, green, red)))
    return spots
