"""Random rigs: projection as OpenCV's, and what a rolling shutter images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from worlds.cameras import SIZE, Camera, Timing, random_rig, shutter_projection, undistort
from worlds.sensor import Pinhole, random_sensor

TIMING = Timing(10**9, 20_000_000, 3_000_000, 5, 0.004, 0.012)


@pytest.fixture(params=range(4))
def rig(request: pytest.FixtureRequest) -> dict[str, Camera]:
    return random_rig(np.random.default_rng(request.param))


def test_projection_is_opencv_s(rig: dict[str, Camera]) -> None:
    points = np.random.default_rng(0).uniform([-120, -90, 0], [120, 90, 150], (30, 3))
    for camera in rig.values():
        T = camera.T_camera_world
        expected, _ = cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K, camera.D)
        np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-6)


def test_cameras_stand_side_by_side_and_see_the_same_desk(rig: dict[str, Camera]) -> None:
    left, right = (np.linalg.inv(camera.T_camera_world)[:3, 3] for camera in rig.values())
    assert 60.0 <= np.linalg.norm(right - left) <= 141.0
    assert right[0] > left[0]
    for camera in rig.values():
        assert (np.abs(camera.project(np.array([0.0, 0.0, 80.0])) - np.array(SIZE) / 2) < 120.0).all()


def test_undistortion_inverts_distortion(rig: dict[str, Camera]) -> None:
    pixels = np.random.default_rng(1).uniform([0, 0], SIZE, (50, 2))
    for camera in rig.values():
        rays = np.concatenate([undistort(pixels, camera.K, camera.D), np.ones((50, 1))], axis=1) * 500.0
        world = (rays - camera.T_camera_world[:3, 3]) @ camera.T_camera_world[:3, :3]
        np.testing.assert_allclose(camera.project(world), pixels, atol=1e-6)


def test_a_moving_point_is_imaged_in_the_row_that_is_exposed_then(rig: dict[str, Camera]) -> None:
    camera = rig["right"]
    start_ns = TIMING.t_ns("right", 2)
    t_ns, pixel, at = shutter_projection(
        camera, TIMING, start_ns, lambda t: np.array([20.0, -60.0 + 1e-6 * (t - start_ns), 90.0])
    )
    assert start_ns == 10**9 + 43_000_000
    assert t_ns - start_ns == pytest.approx((pixel[1] + 0.5) / SIZE[1] * 12e6 + 2e6, abs=1.0)
    np.testing.assert_allclose(camera.project(at), pixel, atol=1e-9)


def test_pinhole_covers_the_distorted_picture(rig: dict[str, Camera]) -> None:
    for camera in rig.values():
        pinhole = Pinhole.of(camera)
        x, y = pinhole.maps
        assert x.min() >= 3.0 and y.min() >= 3.0
        assert x.max() <= pinhole.size[0] - 4.0 and y.max() <= pinhole.size[1] - 4.0
        point = np.array([30.0, 20.0, 60.0])
        u, v = np.round(camera.project(point)).astype(int)
        assert np.hypot(*(np.array([x[v, u], y[v, u]]) - pinhole.project(camera, point))) < 1.0
        opens_s, length_s = pinhole.shutter_s(TIMING)
        row = y[240, 320]
        seen_s = opens_s + (row + 0.5) / pinhole.size[1] * (length_s - TIMING.exposure_s)
        assert seen_s == pytest.approx(240.5 / SIZE[1] * TIMING.readout_s, abs=2e-6)


def test_sensor_keeps_greys_grey_and_is_noisy() -> None:
    rng = np.random.default_rng(3)
    picture = random_sensor(rng, 1.0).picture(np.full((480, 640, 3), 0.3, np.float32), 1.0, rng)
    middle = picture[200:280, 280:360].reshape(-1, 3)
    assert np.ptp(middle.mean(axis=0)) < 8.0
    assert 0.5 < middle.std(axis=0).mean() < 8.0
    assert picture[:20, :20].mean() < middle.mean()
