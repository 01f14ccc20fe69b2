from __future__ import annotations

import numpy as np
import pytest

from rhot_capture.detection.subpixel.windows import Shares


@pytest.mark.parametrize(("scale", "left", "top"), [(1, 0, 0), (2, 0, 0), (2, 1, 1)])
def test_places_are_those_of_the_window_whatever_the_grid(scale: int, left: int, top: int) -> None:
    """A ramp along x + 2 y, seen as means on the grid, is the same ramp at any place of the window."""
    y, x = np.indices((12, 14), np.float32)
    middle_x, middle_y = left + scale * (x + 0.5) - 0.5, top + scale * (y + 0.5) - 0.5
    shares = Shares((0.01 * (middle_x + 2.0 * middle_y)).astype(np.float32), scale, left, top)
    places = [shares.on_grid(place) for place in ((4.0, 5.0), (6.5, 7.25), (9.0, 3.5))]
    assert shares.at(np.array([places], np.float32))[0] == pytest.approx([0.14, 0.21, 0.16], abs=1e-3)


def test_beyond_the_grid_it_is_as_at_its_border() -> None:
    shares = Shares(np.eye(3, dtype=np.float32), 1, 0, 0)
    assert shares.at(np.array([[[-5.0, -5.0], [9.0, 0.0]]], np.float32)).tolist() == [[1.0, 0.0]]
