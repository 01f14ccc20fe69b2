"""The unrolled algebra against numpy's, which `rhot bench` times it against."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rhot_bench.speed.cores import plain_levels, plain_projections
from rhot_capture.detection.subpixel.windows import fitted_levels, projections


@pytest.mark.parametrize("seed", range(4))
def test_unrolled_is_what_numpy_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, pixels = 5, 200

    def columns(*arrays: Any) -> Any:
        return np.stack(arrays, axis=-1)

    weights = (rng.random((count, 2, pixels)) < 0.4).astype(np.float64)
    colours = columns(*rng.uniform(0.0, 255.0, (3, count, pixels)), np.ones((count, pixels)))
    around = weights[:, :1] * np.moveaxis(colours[..., :3], -1, 1)
    sums = np.concatenate([weights, around], axis=1) @ colours
    lines, usable = projections(sums)
    plain, plain_usable = plain_projections(sums)
    assert np.allclose(lines, plain, rtol=1e-9, atol=1e-12)
    assert usable == plain_usable

    x, y = rng.uniform(-15.0, 15.0, (2, pixels))
    t = 0.5 + 0.01 * x + rng.normal(0.0, 0.05, (count, pixels))
    places = weights @ columns(np.ones(pixels), x, y, x * x, x * y, y * y)
    products = (weights * t[:, None]) @ columns(np.ones(pixels), x, y)
    squares = (weights[:, 1] * t * t).sum(axis=1)
    planes, misfits = fitted_levels(lines, places, products, squares)
    plain_planes, plain_misfits = plain_levels(plain, places, products, squares)
    assert np.allclose(planes, plain_planes, rtol=1e-9, atol=1e-12)
    assert misfits == plain_misfits
