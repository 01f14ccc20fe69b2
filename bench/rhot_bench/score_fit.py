"""Fit the score of a detection to simulated pictures, and tell on other seeds whether it means what it says.

    python -m rhot_bench.score_fit [--bursts 40]

Prints the two constants of `rhot_capture.detection.score` and a table of reliability: of the detections with a score in
each range, the share that is right, and the expected calibration error (the mean of |score − share right| over the
ranges, weighted by how many detections fall into each), both for the constants fitted now and for those in the module.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.optimize import minimize

from rhot.arrays import FloatArray
from rhot.rig import Rig, load_rig
from rhot.rig.colors import ColorsFile, nominal_colors
from rhot.rig.template import rig_template
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.detection.result import Detection
from rhot_capture.detection.score import BIAS, RIGHT_PX, WEIGHTS, Evidence
from rhot_sim.rendering.coverage import MarkerCoverage, MarkerView
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.world.paint import SKIN, paints_of
from rhot_sim.world.world import World

# Simulated pictures with all faults on and the true centre of every marker's visible paint, in bursts.
#
# Some bursts carry what leads a detector astray: a marker that wears no paint, spots of a marker's colour on the
# desk, much sensor noise, and pictures moved so far aside that the border cuts a marker. A burst is several frames in
# a row, so that a detector can track.

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


def true_frames(seed: int, bursts: int) -> Iterator[TrueFrame]:
    """Yield bursts of frames of scripted motion, by turns from the rig's cameras.

    Some have bare markers, spots on the desk and more noise.

    Args:
        seed: of motion, cameras and faults.
        bursts: how many.
    """
    rng = np.random.default_rng(seed)
    for burst in range(bursts):
        rig = simulated_rig(seed, noise_sigma=float(rng.uniform(3.0, 6.0)))
        names = list(rig.config.markers)
        camera = list(rig.config.cameras)[burst % len(rig.config.cameras)]
        model = true_cameras(rig)[camera]
        world = World.from_rig(rig)
        bare = set(rng.choice(names, int(rng.integers(0, 3)), replace=False)) if burst % 2 else set()
        renderer = Renderer(
            model, world, rig.config.sim, rig.config.cameras[camera], burst % 2, paints=dict.fromkeys(bare, SKIN)
        )
        coverage = MarkerCoverage(model, world, scale=6, vertices=48)
        spots = _spots(rng, names) if burst % 3 == 0 else []
        begin_s = float(rng.uniform(0.0, 120.0))
        aside = _aside(rng, coverage.at(begin_s)) if burst % 4 == 3 else 0
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


FIT_SEEDS: Final = (11, 12, 13, 14, 15)
CHECK_SEEDS: Final = (21, 22, 23, 24)
_RIDGE: Final = 0.5
_EDGES: Final = np.array([0.0, 0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0])


def samples(seeds: Sequence[int], bursts: int) -> tuple[FloatArray, FloatArray]:
    """Return the evidence (N, 3) of all detections, and whether each is right (N,)."""
    rig = simulated_rig(1)
    names = list(rig.config.markers)
    detector = MarkerDetector(rig.config.markers, build_color_table(rig_colors(rig), names), 640, 480)
    evidence: list[Evidence] = []
    right: list[bool] = []
    for seed in seeds:
        burst = -1
        frames = track(true_frames(seed, bursts), f"seed {seed}", total=BURST * bursts, console=Console(stderr=True))
        for frame in frames:
            if frame.burst != burst:
                detector.reset()
                burst = frame.burst
            found = detector.detect(frame.image)
            evidence += [each.evidence for each in detector.decisions.chosen.values()]
            right += [_right(found[name], frame.views.get(name)) for name in detector.decisions.chosen]
    return np.array(evidence), np.array(right, dtype=np.float64)


def _right(found: Detection, view: MarkerView | None) -> bool:
    if view is None or view.area_px == 0.0:
        return False
    return bool(np.hypot(found.u - view.u, found.v - view.v) <= RIGHT_PX)


def fit(evidence: FloatArray, right: FloatArray) -> FloatArray:
    """Return bias and weights (4,): logistic regression, weights not below 0, a small ridge."""

    def loss(parameters: FloatArray) -> tuple[float, FloatArray]:
        log_odds = parameters[0] + evidence @ parameters[1:]
        value = float(np.sum(np.logaddexp(0.0, log_odds) - right * log_odds)) + 0.5 * _RIDGE * float(
            parameters[1:] @ parameters[1:]
        )
        miss = 1.0 / (1.0 + np.exp(-log_odds)) - right
        return value, np.concatenate([[miss.sum()], evidence.T @ miss + _RIDGE * parameters[1:]])

    bounds = [(None, None), *[(0.0, None)] * evidence.shape[1]]
    return np.asarray(minimize(loss, np.zeros(len(bounds)), jac=True, bounds=bounds, method="L-BFGS-B").x)


def reliability(scores: FloatArray, right: FloatArray, title: str) -> tuple[Table, float]:
    """Return the share right per range of score, and the expected calibration error."""
    shown = Table("score", "detections", "mean score", "right", title=title)
    place = np.clip(np.searchsorted(_EDGES, scores, side="right") - 1, 0, len(_EDGES) - 2)
    error = 0.0
    for bin_, (low, high) in enumerate(pairwise(_EDGES)):
        inside = place == bin_
        if inside.any():
            error += abs(scores[inside].mean() - right[inside].mean()) * inside.mean()
            shown.add_row(
                f"{low:.2f} to {high:.2f}",
                str(inside.sum()),
                f"{scores[inside].mean():.3f}",
                f"{right[inside].mean():.3f}",
            )
    return shown, error


def main() -> None:
    """Fit, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bursts", type=int, default=40, help="bursts of three frames per seed")
    bursts = parser.parse_args().bursts
    console = Console(width=120)
    evidence, right = samples(FIT_SEEDS, bursts)
    parameters = fit(evidence, right)
    names = ", ".join(Evidence._fields)
    console.print(f"fitted to {len(right)} detections, {right.mean():.1%} of them right; weights of {names}:")
    console.print(f"BIAS: Final = {parameters[0]:.3f}", highlight=False)
    console.print(f"WEIGHTS: Final = ({', '.join(f'{weight:.3f}' for weight in parameters[1:])})", highlight=False)
    evidence, right = samples(CHECK_SEEDS, bursts)
    for title, chosen in (("fitted now", parameters), ("rhot_capture.detection.score", np.array([BIAS, *WEIGHTS]))):
        scores = 1.0 / (1.0 + np.exp(-(chosen[0] + evidence @ chosen[1:])))
        shown, error = reliability(scores, right, f"{title}, other seeds")
        console.print(shown)
        console.print(f"expected calibration error {error:.3f}, Brier score {np.mean((scores - right) ** 2):.4f}")


if __name__ == "__main__":
    main()
