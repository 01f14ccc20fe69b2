from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from marker_streams import EPOCH_NS, models

from rhot.arrays import FloatArray
from rhot.messages import Marker, MarkerFrame, PixelPoint
from rhot.rig import Rig
from rhot_fusion.views.corners import Corners, PatchCorners

SIZE = (0.04, 0.03)
CENTER = np.array([0.05, 0.02, 0.7])


def patch(tilt_rad: float = 0.4, size: tuple[float, float] = SIZE) -> FloatArray:
    """Corners (4, 3) of a rectangle tilted about the x axis."""
    width, length = size
    flat = 0.5 * np.array([[-width, -length, 0.0], [width, -length, 0.0], [width, length, 0.0], [-width, length, 0.0]])
    c, s = np.cos(tilt_rad), np.sin(tilt_rad)
    corners: FloatArray = flat @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]).T + CENTER
    return corners


class Watched:
    """A patch seen by both cameras of a rig, each listing its corners from a corner of its own choosing."""

    def __init__(self, rig: Rig, shifts: tuple[int, int], quad: FloatArray, noise_px: float = 0.0) -> None:
        rng = np.random.default_rng(7)
        cameras = models(rig)
        self.corners = PatchCorners(rig.config.markers, cameras)
        for index, (name, camera, shift) in enumerate(zip(rig.cameras, cameras, shifts, strict=True)):
            center = camera.project(quad.mean(axis=0)[None])
            pixels = np.roll(camera.project(quad), shift, axis=0) + rng.normal(0.0, noise_px, (4, 2))
            a, b, c, d = ((float(u), float(v)) for u, v in pixels)
            listed: tuple[PixelPoint, PixelPoint, PixelPoint, PixelPoint] = (a, b, c, d)
            marker = Marker(u=float(center[0, 0]), v=float(center[0, 1]), area=400.0, score=1.0, corners=listed)
            frame = MarkerFrame(t_ns=EPOCH_NS, camera=name, width=640, height=480, markers={"base": marker})
            points = self.corners.listed(index, frame.markers)["base"]
            self.corners.observe(index, "base", 0.0, camera.undistort(np.array(points)).tolist())

    def solve(self, point: FloatArray, name: str = "base", t_s: float = 0.0) -> Corners | None:
        x, y, z = point.tolist()
        return self.corners.solve(name, (0, 1), (x, y, z), t_s)


@pytest.mark.parametrize("shifts", [(0, 0), (0, 1), (3, 1), (2, 0)])
def test_corners_are_paired_whatever_their_order(make_rig: Callable[..., Rig], shifts: tuple[int, int]) -> None:
    quad = patch()
    watched = Watched(make_rig(), shifts, quad)
    found = watched.solve(quad.mean(axis=0))
    assert found is not None
    np.testing.assert_allclose(found, np.roll(quad, shifts[0], axis=0), atol=1e-6)


def test_noise_of_the_corners_in_millimetres(make_rig: Callable[..., Rig]) -> None:
    quad = patch()
    watched = Watched(make_rig(), (0, 2), quad, noise_px=0.15)
    found = watched.solve(quad.mean(axis=0))
    assert found is not None
    error_mm = np.linalg.norm(np.array(found) - quad, axis=1) * 1e3
    assert error_mm.max() < 8.0


def test_corners_are_placed_around_the_published_point(make_rig: Callable[..., Rig]) -> None:
    quad = patch()
    watched = Watched(make_rig(), (0, 0), quad)
    point = quad.mean(axis=0) + np.array([0.003, 0.0, 0.005])
    found = watched.solve(point)
    assert found is not None
    np.testing.assert_allclose(np.mean(found, axis=0), point, atol=1e-9)


def test_quad_of_another_size_is_dropped(make_rig: Callable[..., Rig]) -> None:
    quad = patch(size=(0.08, 0.06))
    watched = Watched(make_rig(), (0, 0), quad)
    assert watched.solve(quad.mean(axis=0)) is None


def test_old_corners_and_single_views_are_not_used(make_rig: Callable[..., Rig]) -> None:
    quad = patch()
    watched = Watched(make_rig(), (0, 0), quad)
    center = quad.mean(axis=0)
    assert watched.solve(center, t_s=0.2) is None
    assert watched.solve(center, "thumb") is None
    x, y, z = center.tolist()
    assert watched.corners.solve("base", (0,), (x, y, z), 0.0) is None
    watched.corners.clear()
    assert watched.solve(center) is None
