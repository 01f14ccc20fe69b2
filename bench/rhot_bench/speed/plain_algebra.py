"""The algebra of `rhot_capture.detection.subpixel.unmixing` in numpy: what the plain numbers there must be faster than.

The functions have the names, arguments and results of those that they stand in for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rhot.arrays import FloatArray, ImageArray
from rhot_bench.speed.interleaved import lockstep
from rhot_capture.detection.subpixel import unmixing
from rhot_capture.detection.subpixel.unmixing import MIN_CONTRAST, MIN_SURROUNDINGS, MISFIT, NOISE, RIDGE, TINY
from rhot_tools.measures.rows import Row

LEAST_SAVING: Final = 0.1
"""Of a frame's cost: what saves less is not worth a second form of the same algebra, and numpy's must return."""
_SYMMETRIC: Final = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def plain_projections(sums: ArrayLike) -> tuple[FloatArray, list[bool]]:
    """Do what `unmixing.projections` does."""
    sums = np.asarray(sums, dtype=np.float64)
    total = sums[:, 0, 3]
    share = 1.0 / np.maximum(total, 1.0)
    mean = sums[:, 0, :3] * share[:, None]
    contrast = sums[:, 1, :3] / np.maximum(sums[:, 1, 3:], 1.0) - mean
    covariance = sums[:, 2:, :3] * share[:, None, None] - mean[:, :, None] * mean[:, None] + NOISE**2 * np.eye(3)
    n = np.linalg.solve(covariance, contrast[..., None])[..., 0]
    n /= np.maximum(np.vecdot(n, contrast), 1e-9)[:, None]
    usable = (total >= MIN_SURROUNDINGS) & (np.vecdot(contrast, contrast) >= MIN_CONTRAST**2)
    return np.column_stack([n, -np.vecdot(n, mean)]), usable.tolist()


def plain_levels(
    lines: FloatArray, moments: ArrayLike, products: ArrayLike, squares: ArrayLike
) -> tuple[FloatArray, list[bool]]:
    """Do what `unmixing.fitted_levels` does."""
    moments, products = np.asarray(moments, dtype=np.float64), np.asarray(products, dtype=np.float64)
    matrices = moments[..., _SYMMETRIC] + np.diag([TINY, RIDGE, RIDGE])
    planes = np.linalg.solve(matrices, products[..., None])[..., 0].swapaxes(0, 1)
    left_over = squares - np.vecdot(planes[1], products[:, 1])
    noise = (MISFIT * NOISE) ** 2 * np.vecdot(lines[:, :3], lines[:, :3]) * moments[:, 1, 0]
    return planes.reshape(-1, 3), (left_over > noise).tolist()


def with_plain_algebra(work: Callable[[ImageArray], object]) -> Callable[[ImageArray], None]:
    """Return some work with the detector, done with the numpy form."""
    unrolled = unmixing.projections, unmixing.fitted_levels

    def run(image: ImageArray) -> None:
        unmixing.projections, unmixing.fitted_levels = plain_projections, plain_levels  # type: ignore[assignment]
        try:
            work(image)
        finally:
            unmixing.projections, unmixing.fitted_levels = unrolled

    return run


def saving_rows(
    ours: Callable[[ImageArray], object], plain: Callable[[ImageArray], object], images: Sequence[ImageArray]
) -> tuple[Row, ...]:
    """Return what the unrolled algebra saves of the processor time that a frame takes with the numpy form.

    Args:
        ours: looks for markers in an image.
        plain: the same, by another detector.
        images: of one camera, in order.
    """
    spreads = lockstep({"ours": ours, "plain": with_plain_algebra(plain)}, {"ours": images, "plain": images})
    plain_s = spreads["plain"].seconds
    # Frame by frame: from one to the next a busy machine slows both.
    saved = float(np.median(1.0 - spreads["ours"].seconds / plain_s)) if plain_s.size else float("nan")
    note = "unrolled 3x3 algebra, processor time; the numpy form returns when it saves less"
    return (Row("saved by unrolled algebra", 100.0 * saved, "%", least=100.0 * LEAST_SAVING, note=note),)
