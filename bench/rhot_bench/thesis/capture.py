"""How the 2018 thesis found its markers, as its program did it, step by step.

Per colour: threshold of the RGB box inside a region of interest, 3x3 Gaussian blur, opening and closing with 4x4
kernels, all contours, the largest one, the centre of its rotated box. The next region is the box plus 40 px; a colour
that is not found is searched in the whole picture. Two of its mistakes are left out because they change values and no
cost: the centre is offset with the region it was found in, and regions stay inside the picture.

Source: `detect_color`, `image_optimizations` and `detectContour` of the program that accompanies the thesis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import ImageArray

REGION_MARGIN_PX: Final = 40
_KERNEL: Final = cv2.getStructuringElement(cv2.MORPH_RECT, (4, 4))


@dataclass(frozen=True, slots=True)
class RgbBox:
    """Thresholds of one colour, inclusive, blue green red."""

    low: tuple[int, int, int]
    high: tuple[int, int, int]


class ThesisDetector:
    """Finds each colour by itself, in a region about its last place.

    Args:
        boxes: thresholds by marker name.
    """

    def __init__(self, boxes: Mapping[str, RgbBox]) -> None:
        self._boxes = dict(boxes)
        self._regions: dict[str, tuple[int, int, int, int]] = {}

    def reset(self) -> None:
        """Forget all regions; every colour is searched in the whole picture next."""
        self._regions.clear()

    def detect(self, image: ImageArray) -> dict[str, tuple[float, float]]:
        """Return the centre (u, v), pixels, of each colour found in a picture (H, W, 3) uint8 BGR."""
        found = {}
        height, width = image.shape[:2]
        for name, box in self._boxes.items():
            left, top, right, bottom = self._regions.pop(name, (0, 0, width, height))
            contour = _largest_contour(cleaned_mask(image[top:bottom, left:right], box))
            if contour is None:
                continue
            rotated = cv2.minAreaRect(contour)
            (u, v), _, _ = rotated
            found[name] = (u + left, v + top)
            x, y, w, h = cv2.boundingRect(cv2.boxPoints(rotated))
            self._regions[name] = (
                max(0, left + x - REGION_MARGIN_PX),
                max(0, top + y - REGION_MARGIN_PX),
                min(width, left + x + w + REGION_MARGIN_PX),
                min(height, top + y + h + REGION_MARGIN_PX),
            )
        return found


def cleaned_mask(region: ImageArray, box: RgbBox) -> ImageArray:
    """Return the threshold mask (H, W) uint8 after blur, opening and closing.

    The anchor of a 4x4 kernel is not its middle: opening and closing each shift the mask by (+1, +1) px.
    """
    mask = cv2.inRange(region, np.array(box.low, np.uint8), np.array(box.high, np.uint8))
    mask = cv2.GaussianBlur(mask, (3, 3), 0)
    mask = cv2.dilate(cv2.erode(mask, _KERNEL), _KERNEL)
    return np.asarray(cv2.erode(cv2.dilate(mask, _KERNEL), _KERNEL), dtype=np.uint8)


def _largest_contour(mask: ImageArray) -> NDArray[np.int32] | None:
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    largest, largest_area = None, 0.0
    for contour in contours:
        area = cv2.contourArea(contour)
        if area > largest_area:
            largest, largest_area = np.asarray(contour, dtype=np.int32), area
    return largest


def rgb_boxes(samples: Mapping[str, NDArray[np.uint8]], others: NDArray[np.uint8]) -> dict[str, RgbBox]:
    """Return thresholds as a person sets them with sliders: wide about the samples, but clear of everything else.

    Args:
        samples: marker name to colours (N, 3) of its paint, BGR.
        others: (M, 3) colours of the picture that are no paint.
    """
    boxes = {}
    for name, colors in samples.items():
        low, high = np.percentile(colors.astype(float), (2, 98), axis=0)
        # Grey levels beyond the samples, where that lets in nothing of the others.
        for slack in (12, 6, 0):
            least, most = np.maximum(low - slack, 0).astype(int), np.minimum(high + slack, 255).astype(int)
            inside = ((others >= least) & (others <= most)).all(axis=1)
            if not inside.any():
                break
        a, b, c = least.tolist()
        d, e, f = most.tolist()
        boxes[name] = RgbBox((a, b, c), (d, e, f))
    return boxes
