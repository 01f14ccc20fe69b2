"""Fit the score of a detection to simulated pictures, and tell on other seeds whether it means what it says.

    python -m rhot_bench.detection.score_fit [--bursts 40]

Prints the two constants of `rhot_capture.detection.score` and a table of reliability: of the detections with a score in
each range, the share that is right, and the expected calibration error (the mean of |score − share right| over the
ranges, weighted by how many detections fall into each), both for the constants fitted now and for those in the module.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.optimize import minimize

from rhot.arrays import FloatArray
from rhot_bench.detection.true_frames import BURST, rig_colors, simulated_rig, true_frames
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.detection.result import Detection
from rhot_capture.detection.score import BIAS, RIGHT_PX, WEIGHTS, Evidence
from rhot_sim.rendering.coverage import MarkerView

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
