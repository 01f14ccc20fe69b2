"""Bias and spread of the capture stage's centres, areas and corners under one disturbance at a time.

    python bench/capture_accuracy.py [--count 60]

Errors are split along and across the direction of the disturbance (light, cover, border, motion); the bias is their
mean, the spread their standard deviation over random places between pixels, turns, sizes, paints and noise.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from rich.console import Console
from rich.table import Table

from capture_scenes import MARKERS, SIDE, Case, draw
from rhot.rig.colors import nominal_colors
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_sim.world.paint import PAINTS

Disturb = Callable[[Case, np.random.Generator], Case]


def _cut(case: Case, rng: np.random.Generator) -> Case:
    """Push the shape over one of the picture's sides by part of its width."""
    side = int(rng.integers(4))
    outside = rng.uniform(-0.5, 0.5) * case.radius
    u, v = case.place
    place = [(outside, v), (SIDE - 1 - outside, v), (u, outside), (u, SIDE - 1 - outside)][side]
    return replace(case, place=place, direction=[np.pi, 0.0, -np.pi / 2, np.pi / 2][side], bare=True)


def _small(case: Case, rng: np.random.Generator) -> Case:
    return replace(case, radius=float(np.sqrt(rng.uniform(12.0, 60.0) / (1.35 * np.pi * 0.8045))))


CONDITIONS: Final[dict[str, Disturb]] = {
    "whole": lambda case, _: case,
    "whole, no finger": lambda case, _: replace(case, bare=True),
    "gradient of light": lambda case, _: replace(case, light="gradient"),
    "edge of a shadow": lambda case, _: replace(case, light="shadow"),
    "highlight": lambda case, _: replace(case, light="highlight"),
    "skin over 20 %": lambda case, _: replace(case, cover="skin", covered=0.2),
    "skin over 40 %": lambda case, _: replace(case, cover="skin", covered=0.4),
    "object over 40 %": lambda case, _: replace(case, cover="object", covered=0.4),
    "cut by the border": _cut,
    "motion 2 px": lambda case, _: replace(case, motion_px=2.0),
    "motion 4 px": lambda case, _: replace(case, motion_px=4.0),
    "motion 8 px": lambda case, _: replace(case, motion_px=8.0),
    "light -20 %": lambda case, _: replace(case, light_level=0.8),
    "light +20 %": lambda case, _: replace(case, light_level=1.2),
    "noise 6": lambda case, _: replace(case, noise=6.0),
    "small, 12 to 60 px": _small,
}


def random_case(rng: np.random.Generator, name: str) -> Case:
    """Return a whole marker somewhere between pixels."""
    return Case(
        name,
        place=(float(SIDE / 2 + rng.uniform(-0.5, 0.5)), float(SIDE / 2 + rng.uniform(-0.5, 0.5))),
        radius=float(rng.uniform(8.0, 12.0) if name == "base" else rng.uniform(5.0, 9.0)),
        stretch=1.6 if name == "base" else float(rng.uniform(1.1, 1.5)),
        angle=float(rng.uniform(-np.pi, np.pi)),
        direction=float(rng.uniform(-np.pi, np.pi)),
        blur_px=float(rng.uniform(0.5, 0.9)),
        seed=int(rng.integers(1 << 31)),
    )


def main() -> None:
    """Measure all conditions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="pictures per condition")
    parser.add_argument("--only", default="", help="conditions that contain this")
    arguments = parser.parse_args()
    count = arguments.count
    table = build_color_table(nominal_colors({name: paint[::-1] for name, paint in PAINTS.items()}), list(PAINTS))
    detector = MarkerDetector(MARKERS, table, SIDE, SIDE)
    shown = Table(
        "condition", "kind", "seen", "bias along", "across", "spread", "p95", "area", "score", "corners", "p95"
    )
    for patch in (False, True):
        names = ["base"] if patch else [name for name in PAINTS if name != "base"]
        for number, (condition, disturb) in enumerate(CONDITIONS.items()):
            if arguments.only not in condition or (patch and condition in ("whole, no finger", "small, 12 to 60 px")):
                continue
            rng = np.random.default_rng(number)
            errors, areas, scores, corners = [], [], [], []
            for place in range(count):
                case = disturb(random_case(rng, names[place % len(names)]), rng)
                drawn = draw(case)
                detector.reset()
                found = detector.detect(drawn.image).get(case.name)
                if found is None:
                    continue
                error = np.array([found.u - drawn.u, found.v - drawn.v])
                cos, sin = np.cos(case.direction), np.sin(case.direction)
                errors.append((cos * error[0] + sin * error[1], cos * error[1] - sin * error[0]))
                areas.append(found.area / drawn.area - 1.0)
                scores.append(found.score)
                if found.corners is not None:
                    turned = [np.roll(drawn.corners, turn, axis=0) for turn in range(4)]
                    corners.append(min(np.linalg.norm(found.corners - true, axis=1).max() for true in turned))
            if not errors:
                shown.add_row(condition, "patch" if patch else "cap", f"0/{count}")
                continue
            both = np.array(errors)
            shown.add_row(
                condition,
                "patch" if patch else "cap",
                f"{len(both)}/{count}",
                *(f"{bias:+.3f}" for bias in both.mean(axis=0)),
                f"{both.std():.3f}",
                f"{np.percentile(np.hypot(*both.T), 95):.3f}",
                f"{100 * np.mean(areas):+.1f} %",
                f"{np.mean(scores):.2f}",
                f"{len(corners)}" if patch else "",
                f"{np.percentile(corners, 95):.2f}" if corners else "",
            )
    Console(width=120).print(shown)


if __name__ == "__main__":
    main()
