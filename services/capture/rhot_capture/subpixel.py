"""Sub-pixel centres of blobs from how much of each rim pixel is paint.

A pixel at the rim mixes paint with what lies beside it, which may be black cloth here, bright skin there and a mixture
of these where they meet. With P the mean of the pure paint inside, μ and Σ mean and covariance of the colours around
the blob, the projection t = n·(c − μ) with n = (Σ + σ²I)⁻¹·(P − μ) is blind to the directions in which the
surroundings vary (the matched filter of spectral unmixing). Between its levels outside (t₀) and inside (t₁),
α = (t − t₀)/(t₁ − t₀) is the painted share of a pixel. The centre is the centroid of α; blur spreads α evenly to both
sides of the rim and leaves its centroid.

Light falls unevenly, so both levels are planes over the picture, fitted to the surroundings and to the pure paint. The
sums of products of (b, g, r, 1, x, y) in both places hold all that these fits need, and as t is linear in the colours,
numerator and denominator of α are linear in these six too: one product of matrices gives either. Where a plane does not
describe the paint of a large blob, as at the edge of a shadow, both levels are local means instead, on the full grid.

Paint in shadow, in a highlight or smeared by motion may have been labelled as nobody's; beside a large blob it is taken
back by t, which tells paint from the surroundings better than the label does.

As t is linear, the mean of four pixels has their mean share: large windows are measured on a coarser grid, at the cost
of small ones. All windows of about one size are laid into one array, so that each step is one call for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rhot_capture.grids import Batch, Centre, Grid, Window
from rhot_capture.unmixing import projections, shares_of_features

_ALIKE: Final = 2.0
"""Windows up to this many times as large as another are measured together."""
_ROUNDS: Final = 2
_LOCAL_FROM_PX: Final = 600
"""Pixels of a window; a smaller one holds too little pure paint for levels of its lit and of its shaded side."""


def find_centres(windows: Sequence[Window]) -> list[Centre]:
    """Return the centres of blobs, in their order.

    Round parts are darker towards their edge, so that paint there looks like a mixture with a dark background and
    would count for less on the shaded side. Counting a share of 1 / `ROUND_GAIN` and more as full takes most of that
    back; it moves the rim outwards by the same small amount on all sides.
    """
    if not windows:
        return []
    grids = [Grid(window) for window in windows]
    order = sorted(range(len(grids)), key=lambda place: grids[place].mask.size)
    batches = []
    start = 0
    for stop in range(1, len(order) + 1):
        if stop == len(order) or grids[order[stop]].mask.size > _ALIKE * grids[order[start]].mask.size:
            batches.append(Batch([grids[place] for place in order[start:stop]]))
            start = stop
    centres = dict(zip(order, _centres(batches), strict=True))
    return [centres[place] for place in range(len(windows))]


def _centres(batches: Sequence[Batch]) -> list[Centre]:
    moments = np.concatenate([batch.moments() for batch in batches])
    line, usable = projections(moments)
    rows: list[slice] = []
    for batch in batches:
        start = rows[-1].stop if rows else 0
        rows.append(slice(start, start + len(batch.mask)))
        for _ in range(_ROUNDS):
            if not batch.take_back(line[rows[-1]]):
                break
            moments[rows[-1]] = batch.moments()
    parts, misfit = shares_of_features(moments, line)
    centres: list[Centre] = []
    for batch, own in zip(batches, rows, strict=True):
        share = batch.shares(parts[own])
        badly = []
        for place, grid in enumerate(batch.grids):
            if not usable[own.start + place]:
                share[place] = batch.mask[place]
            elif misfit[own.start + place] and grid.window.mask.size >= _LOCAL_FROM_PX:
                if grid.scale > 1:
                    badly.append(place)
                else:
                    share[place] = batch.local_share(place, line[own.start + place])
        measured = batch.centroids(share, parts[own])
        for place in badly:
            (measured[place],) = _centres([Batch([Grid(batch.grids[place].window, coarse=False)])])
        centres += measured
    return centres
