"""How the cameras of a rig differ in white balance and exposure, from the paints that several of them show.

Two cameras with an automatic white balance of their own show one paint in two colours. One class for both would be as
wide as they are apart, and take in what lies between. So what a camera does to all colours alike is told apart from
the paints: it multiplies red, green and blue by three factors (von Kries).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray, ImageArray
from rhot.rig.colors import Gains
from rhot_calibration.colors.model.samples import inner
from rhot_capture.detection.color_table import in_balance

_LEAST_PAINTS: Final = 3
"""Paints that tell a camera's factors: of two that disagree none is known to be the wrong one."""
_SURE: Final = 3.0
"""Standard errors by which cameras must differ: two views of a paint differ in light and shade, too."""
_LEAST_ERROR: Final = 0.005
"""Half a per cent: rounding to whole grey levels of a dark channel."""
_CUT_OFF: Final = 250.0
"""Grey levels; brighter ones may be cut off, and their ratios say nothing."""


def camera_gains(
    images: Sequence[ImageArray], found: Sequence[Mapping[str, BoolArray]], cameras: Sequence[str | None]
) -> dict[str, Gains]:
    """Return by what to multiply red, green and blue of each camera's pictures to have them alike.

    Args:
        images: (H, W, 3) uint8 BGR each.
        found: for each image paint to its pixels, (H, W) bool.
        cameras: of each image; None = not known.

    Returns:
        factors by camera, relative to the mean of the cameras; nothing where cameras are surely not unlike, share too
        few paints, or when a picture's camera is not known, as it could not be balanced alike.
    """
    names = sorted({camera for camera in cameras if camera is not None})
    if len(names) < 2 or None in cameras:
        return {}
    paints = sorted({paint for shown in found for paint in shown})
    levels = np.full((len(names), len(paints), 3), np.nan)
    for row, name in enumerate(names):
        own = [(image, shown) for image, shown, camera in zip(images, found, cameras, strict=True) if camera == name]
        for column, paint in enumerate(paints):
            if parts := [image[inner(shown[paint])] for image, shown in own if paint in shown]:
                levels[row, column] = np.log(np.maximum(np.median(np.concatenate(parts), axis=0)[::-1], 1.0))
    levels[levels > np.log(_CUT_OFF)] = np.nan
    seen_by_all = np.isfinite(levels).all(axis=0)
    if np.any(np.count_nonzero(seen_by_all, axis=0) < _LEAST_PAINTS):
        return {}
    relative = np.where(seen_by_all, levels - levels.mean(axis=0), np.nan)
    middle = np.nanmedian(relative, axis=1)
    # Of a median, by the median of the deviations from it, for a normal distribution.
    deviation = np.nanmedian(np.abs(relative - middle[:, None]), axis=1)
    error = 1.2533 * 1.4826 * deviation / np.sqrt(np.count_nonzero(seen_by_all, axis=0))
    if np.all(np.abs(middle) <= _SURE * np.maximum(error, _LEAST_ERROR)):
        return {}
    factors = np.exp(-middle)
    return {name: _rounded(each) for name, each in zip(names, factors, strict=True)}


def balanced(
    images: Sequence[ImageArray], cameras: Sequence[str | None], gains: Mapping[str, Gains]
) -> list[ImageArray]:
    """Return pictures as a camera between all of them would have taken them; one without factors as it is."""
    return [
        image
        if camera is None or camera not in gains
        else np.rint(in_balance(image[..., ::-1].astype(np.float64), gains[camera])).astype(np.uint8)[..., ::-1]
        for image, camera in zip(images, cameras, strict=True)
    ]


def _rounded(factors: FloatArray) -> Gains:
    red, green, blue = (round(float(factor), 4) for factor in factors)
    return red, green, blue
