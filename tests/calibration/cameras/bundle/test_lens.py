"""The lens model against OpenCV's, and its derivatives against differences."""

from __future__ import annotations

import cv2
import numpy as np

from rhot_calibration.cameras.bundle.lens import camera_matrix, project, project_with_derivatives

LENS = np.array([531.0, 529.0, 322.0, 238.0, 0.16, -0.36, 0.0006, -0.0004, 0.18])


def points() -> np.ndarray:
    return np.random.default_rng(1).uniform((-0.3, -0.2, 0.4), (0.3, 0.2, 1.0), (40, 3))


def test_projects_as_opencv_does() -> None:
    theirs, _ = cv2.projectPoints(points(), np.zeros(3), np.zeros(3), camera_matrix(LENS), LENS[4:])
    np.testing.assert_allclose(project(LENS, points()), theirs.reshape(-1, 2), atol=1e-9)


def test_derivatives_agree_with_differences() -> None:
    here = points()
    uv, by_lens, by_point = project_with_derivatives(LENS, here)
    np.testing.assert_allclose(uv, project(LENS, here), atol=1e-12)
    for index, step in enumerate((1e-3, 1e-3, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6)):
        change = step * np.eye(9)[index]
        slope = (project(LENS + change, here) - project(LENS - change, here)) / (2 * step)
        np.testing.assert_allclose(by_lens[..., index], slope, atol=1e-5)
    for axis in range(3):
        change = 1e-6 * np.eye(3)[axis]
        slope = (project(LENS, here + change) - project(LENS, here - change)) / 2e-6
        np.testing.assert_allclose(by_point[..., axis], slope, rtol=1e-5, atol=1e-3)
