"""Sub-pixel centres of blobs from the painted share of each pixel at the rim.

A pixel at the rim is a mixture of paint and surroundings, and the surroundings may vary, for example from black cloth
to bright skin. Let c be its colour, P the mean of the pure paint inside, μ and Σ mean and covariance of the colours
around the blob. The projection t = n·(c − μ) with n = (Σ + σ²I)⁻¹·(P − μ) suppresses the directions in which the
surroundings vary (the matched filter of spectral unmixing). With its levels outside (t₀) and inside (t₁),
α = (t − t₀)/(t₁ − t₀) is the painted share of a pixel. The centre is the centroid of α, which symmetric blur does not
change.

Illumination is uneven, so both levels are planes over the image, fitted to the surroundings and to the pure paint; the
fits need only the sums of t times 1, x, y over both. Where a plane does not fit the paint of a large blob, as at the
edge of a shadow, both levels are local means, on the full grid.

Paint in shadow, in a highlight or with motion blur may have no label. Beside a large blob it is added to the mask by t,
which separates paint from the surroundings better than the label.

As t is linear, the mean of four pixels has their mean share, so large windows are measured on a coarser grid to save
time. Windows of similar size are copied into one array, so that each step is one call for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rhot.arrays import ImageArray
from rhot_capture.detection.subpixel import unmixing
from rhot_capture.detection.subpixel.batch import Batch
from rhot_capture.detection.subpixel.shares import Shares, local_share
from rhot_capture.detection.subpixel.windows import Centre, Grid, Window, grid_of

_ALIKE: Final = 2.0
"""Largest ratio between the sizes of windows that are measured together."""
_ROUNDS: Final = 2
"""Largest number of enlargements of a mask."""
_LOCAL_FROM_PX: Final = 600
"""Smallest window for local levels, pixels; smaller ones have too little pure paint on the lit and the shaded side."""


def find_centres(windows: Sequence[Window], skin: ImageArray | None = None) -> list[Centre]:
    """Return the centres of blobs, in the order of the windows.

    Round surfaces are darker towards their edge, so that paint there looks like a mixture with a dark background, and
    the shaded side would get less weight. Shares of 1 / `ROUND_GAIN` and more therefore count as 1. This corrects most
    of the bias, and moves the rim outwards by the same small amount on all sides.

    Args:
        windows: with a blob each.
        skin: (65536,) uint8, 1 for 5-6-5 colours of skin; None = not known.
    """
    if not windows:
        return []
    grids = [grid_of(window) for window in windows]
    sizes = [grid.mask.size for grid in grids]
    limit = _ALIKE * min(sizes)
    if max(sizes) <= limit:
        return _measure(grids, skin)
    alike = [size <= limit for size in sizes]
    small = iter(find_centres([window for window, is_small in zip(windows, alike, strict=True) if is_small], skin))
    large = iter(find_centres([window for window, is_small in zip(windows, alike, strict=True) if not is_small], skin))
    return [next(small if is_small else large) for is_small in alike]


def _measure(grids: Sequence[Grid], skin: ImageArray | None) -> list[Centre]:
    """Return the centres of the blobs on grids of similar size."""
    batch = Batch(grids)
    lines, usable = unmixing.projections(batch.color_sums())
    t = batch.projected(lines)
    batch.enlarge(t, _ROUNDS)
    planes, misfits = unmixing.fitted_levels(lines, batch.sums, *batch.products(t))
    share = batch.shares(t, planes)
    finer: list[int] = []
    for k, (is_usable, misfit) in enumerate(zip(usable, misfits, strict=True)):
        if not is_usable:
            share[k] = batch.insides[k]
        elif misfit and grids[k].window.mask.size >= _LOCAL_FROM_PX:
            if grids[k].scale > 1:
                finer.append(k)
            else:
                share[k] = local_share(t[k], batch.weights[k], batch.shape[1:])
    batch.clip(share)
    totals = batch.totals(share)
    x, y = batch.middle
    # If the painted area is a smaller share of the mask, or the centre is outside the window, the shares are
    # invalid and the mask is used.
    invalid = [
        k
        for k, (painted, (m00, m10, m01)) in enumerate(totals)
        if painted < 0.5 * batch.area[k] or not _within(grids[k], m10 + x * m00, m01 + y * m00, m00)
    ]
    if invalid:
        share[invalid] = batch.insides[invalid]
        totals = batch.totals(share)
    middles = [(m10 / m00, m01 / m00) for _, (m00, m10, m01) in totals]
    sides: list[tuple[tuple[float, float] | None, float]] = [(None, 0.0)] * len(grids)
    if skin is not None:
        found = batch.skin_sides(skin, np.array(middles, np.float32)).tolist()
        sides = [((to_right, down), part) for to_right, down, part in found]
    centres = []
    for k, (grid, (painted, _)) in enumerate(zip(grids, totals, strict=True)):
        window, scale, left, top = grid[:4]
        shares: Shares | None = None
        if window.shared:
            height, width = grid.mask.shape
            own = share[k].reshape(batch.shape[1:])[:height, :width]
            shares = Shares(own, scale, left, top)
        u = left + scale * (middles[k][0] + x + 0.5) - 0.5
        v = top + scale * (middles[k][1] + y + 0.5) - 0.5
        centres.append(Centre(u, v, painted * scale**2, shares, *sides[k]))
    for k in finer:
        # Local means extend over a few pixels, which is too far on a coarser grid.
        (centres[k],) = _measure([grid_of(grids[k].window, coarse=False)], skin)
    return centres


def _within(grid: Grid, m10: float, m01: float, m00: float) -> bool:
    """Return whether a centroid, given by moments about the first pixel, is in the window; the batch may be larger."""
    height, width = grid.mask.shape
    return bool(0.0 <= m10 <= (width - 1) * m00 and 0.0 <= m01 <= (height - 1) * m00)
