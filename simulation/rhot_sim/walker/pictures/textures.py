"""What is printed on the floor and on the markers' cards."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

FLOOR_M: Final = 12.0
"""Side of the floor, a square around the origin."""
FLOOR_PX_PER_M: Final = 150.0
CELL_PX: Final = 12
"""Side of a marker's cell in the texture."""
_INK: Final = 28.0
_PAPER: Final = 214.0


def card_texture(cells: Image, quiet: float) -> Image:
    """Return the card's picture (h, w, 2): grey level times 1, and how much of it is there."""
    margin = round(quiet * CELL_PX)
    marker = np.kron(cells, np.ones((CELL_PX, CELL_PX)))
    grey = np.full((marker.shape[0] + 2 * margin, marker.shape[1] + 2 * margin), _PAPER)
    grey[margin : margin + marker.shape[0], margin : margin + marker.shape[1]] = _INK + marker * (_PAPER - _INK)
    texture: Image = np.stack([grey, np.full(grey.shape, 255.0)], axis=-1).astype(np.uint8)
    return texture


def floor_texture(rng: np.random.Generator) -> Image:
    """Return a floor of boards with grain, seams and a few rugs, BGR."""
    side = round(FLOOR_M * FLOOR_PX_PER_M)
    image = np.full((side, side, 3), (104.0, 126.0, 148.0), dtype=np.float32)
    board = round(0.14 * FLOOR_PX_PER_M)
    for number, left in enumerate(range(0, side, board)):
        image[:, left : left + board] *= rng.uniform(0.85, 1.12)
        image[:, left : left + 1] *= 0.55
        for seam in range(int(rng.integers(0, 300)), side, round(1.6 * FLOOR_PX_PER_M)):
            image[seam : seam + 1, left : left + board] *= 0.55 if number % 2 else 0.65
    grain = cv2.resize(rng.normal(0.0, 1.0, (side // 12, side // 2)).astype(np.float32), (side, side))
    image += 6.0 * np.asarray(grain)[..., None]
    for _ in range(4):
        corner = rng.integers(0, side - 300, 2)
        color = rng.uniform(50.0, 190.0, 3)
        size = rng.integers(120, 300, 2)
        image[corner[0] : corner[0] + size[0], corner[1] : corner[1] + size[1]] = color
    return np.clip(image, 0.0, 255.0).astype(np.uint8)
