from __future__ import annotations

import numpy as np

from rhot_ik.hand.filter.filter import known_along


def test_a_point_that_is_known_along_one_direction_is_open_in_all_others() -> None:
    direction = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]])
    for way, covariance in zip(direction, known_along(direction, 0.002), strict=True):
        values, vectors = np.linalg.eigh(covariance)
        assert np.isclose(np.sqrt(values[0]), 0.002)
        assert np.isclose(abs(vectors[:, 0] @ way), 1.0)
        assert (np.sqrt(values[1:]) > 0.3).all()
