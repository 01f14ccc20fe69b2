"""Colour thresholds for the thesis's detector, set on the pictures that it is then measured on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rhot.arrays import ImageArray
from rhot.rig import Rig
from rhot_bench.speed.simulated import Capture
from rhot_bench.thesis.capture import RgbBox, rgb_boxes
from rhot_capture.detection.cutouts import marker_mask

_PICTURES = 12


def thesis_boxes(rig: Rig, pictures: Sequence[ImageArray]) -> dict[str, RgbBox]:
    """Return an RGB box per marker from the pixels that our own detector says are its paint."""
    detector = next(iter(Capture(rig).detectors.values()))
    names = list(rig.config.markers)
    paint: dict[str, list[ImageArray]] = {name: [] for name in names}
    others: list[ImageArray] = []
    for image in pictures[:: max(1, len(pictures) // _PICTURES)]:
        found = detector.detect(image)
        masks = {name: marker_mask(image, detector.table, name) > 0 for name in names}
        for name in found:
            paint[name].append(image[masks[name]])
        others.append(image[~np.any(list(masks.values()), axis=0)][::37])
    samples = {name: np.concatenate(colors) for name, colors in paint.items() if colors}
    return rgb_boxes(samples, np.concatenate(others))
