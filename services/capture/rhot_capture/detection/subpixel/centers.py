"""Sub-pixel centres of blobs from how much of each rim pixel is paint.

A pixel at the rim mixes paint with what lies beside it, which may be black cloth here, bright skin there and a mixture
of these where they meet. With P the mean of the pure paint inside, μ and Σ mean and covariance of the colours around
the blob, the projection t = n·(c − μ) with n = (Σ + σ²I)⁻¹·(P − μ) is blind to the directions in which the
surroundings vary (the matched filter of spectral unmixing). Between its levels outside (t₀) and inside (t₁),
α = (t − t₀)/(t₁ − t₀) is the painted share of a pixel. The centre is the centroid of α; blur spreads α evenly to both
sides of the rim and leaves its centroid.

Light falls unevenly, so both levels are planes over the picture, fitted to the surroundings and to the pure paint; the
sums of t by 1, x, y over both hold all that these fits need. Where a plane does not describe the paint of a large
blob, as at the edge of a shadow, both levels are local means instead, on the full grid.

Paint in shadow, in a highlight or smeared by motion may have been labelled as nobody's; beside a large blob it is taken
back by t, which separates paint from the surroundings better than the label does.

As t is linear, the mean of four pixels has their mean share: large windows are measured on a coarser grid, at the cost
of small ones. All windows of about one size are laid into one array, so that each step is one call for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rhot_capture.detection.subpixel import unmixing
from rhot_capture.detection.subpixel.batch import Batch
from rhot_capture.detection.subpixel.shares import Shares, local_share
from rhot_capture.detection.subpixel.windows import Centre, Grid, Window, grid_of

_ALIKE: Final = 2.0
"""Windows up to this many times as large as another are measured together."""
_ROUNDS: Final = 2
_LOCAL_FROM_PX: Final = 600
"""Pixels of a window; a smaller one holds too little pure paint for levels of its lit and of its shaded side."""
_MIN_SHARE_OF_MASK: Final = 0.5
"""With less paint than that, or a centre outside of the window, the shares are nonsense, and the mask counts."""


def find_centres(windows: Sequence[Window]) -> list[Centre]:
    """Return the centres of blobs, in their order.

    Round parts are darker towards their edge, so that paint there looks like a mixture with a dark background and
    would count for less on the shaded side. Counting a share of 1 / `ROUND_GAIN` and more as full takes most of that
    back; it moves the rim outwards by the same small amount on all sides.
    """
    if not windows:
        return []
    grids = [grid_of(window) for window in windows]
    sizes = [grid.mask.size for grid in grids]
    limit = _ALIKE * min(sizes)
    if max(sizes) <= limit:
        return _measure(grids)
    alike = [size <= limit for size in sizes]
    small = iter(find_centres([window for window, is_small in zip(windows, alike, strict=True) if is_small]))
    large = iter(find_centres([window for window, is_small in zip(windows, alike, strict=True) if not is_small]))
    return [next(small if is_small else large) for is_small in alike]


def _measure(grids: Sequence[Grid]) -> list[Centre]:
    """Return the centres of the blobs on grids of about one size."""
    batch = Batch(grids)
    lines, usable = unmixing.projections(batch.color_sums())
    t = batch.projected(lines)
    batch.take_back(t, _ROUNDS)
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
    batch.tidy(share)
    totals = batch.totals(share)
    x, y = batch.middle
    doubtful = [
        k
        for k, (painted, (m00, m10, m01)) in enumerate(totals)
        if painted < _MIN_SHARE_OF_MASK * batch.area[k] or not _within(grids[k], m10 + x * m00, m01 + y * m00, m00)
    ]
    if doubtful:
        share[doubtful] = batch.insides[doubtful]
        totals = batch.totals(share)
    centres = []
    for k, (grid, (painted, (m00, m10, m01))) in enumerate(zip(grids, totals, strict=True)):
        window, scale, left, top = grid[:4]
        shares: Shares | None = None
        if window.shared:
            height, width = grid.mask.shape
            own = share[k].reshape(batch.shape[1:])[:height, :width]
            shares = Shares(own, scale, left, top)
        u = left + scale * (m10 / m00 + x + 0.5) - 0.5
        v = top + scale * (m01 / m00 + y + 0.5) - 0.5
        centres.append(Centre(u, v, painted * scale**2, shares))
    for k in finer:
        # Local means reach over a few pixels: on a coarser grid too far.
        (centres[k],) = _measure([grid_of(grids[k].window, coarse=False)])
    return centres


def _within(grid: Grid, m10: float, m01: float, m00: float) -> bool:
    """Tell whether a centroid, by its moments about the first pixel, lies in the window: the batch may be larger."""
    height, width = grid.mask.shape
    return bool(0.0 <= m10 <= (width - 1) * m00 and 0.0 <= m01 <= (height - 1) * m00)
