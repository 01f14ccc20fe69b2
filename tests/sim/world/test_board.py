from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.messages import Truth, decode, encode
from rhot.rig import CameraConfig, load_rig
from rhot.rig.config import SimConfig
from rhot.rig.folder import RIG_FILE
from rhot.rig.template import rig_template
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.world.board import BOARD, FAR_M, HOLD_S, MAX_TILT_DEG, MOVE_S, NEAR_M, BoardMotion, ChessBoard
from rhot_sim.world.motion import MotionSample
from rhot_sim.world.world import World

CORNERS = (9, 6)
PLACE_S = HOLD_S + MOVE_S


def board_world(cameras: dict[str, CameraModel], seed: int = 1) -> World:
    board = ChessBoard()
    return World(seed, {}, {}, motion=BoardMotion(seed, tuple(cameras.values()), board), board=board)


def corners_at(world: World, camera: CameraModel, t_s: float) -> FloatArray:
    T = world.sample(np.array([t_s])).objects[BOARD][0]
    return camera.project(ChessBoard().corners @ T[:3, :3].T + T[:3, 3])


def found_corners(image: NDArray[np.uint8], near: FloatArray) -> FloatArray:
    """Return the corners that OpenCV refines from whole pixels near to the true ones."""
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    spacing = float(np.linalg.norm(np.diff(near.reshape(6, 9, 2), axis=1), axis=2).min())
    half = max(2, int(0.3 * spacing))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    start = np.round(near).astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(gray, start, (half, half), (-1, -1), criteria)
    return np.asarray(refined, np.float64).reshape(-1, 2)


def test_it_is_held_still_then_moves_smoothly(cameras: dict[str, CameraModel]) -> None:
    motion = board_world(cameras).motion
    t = np.arange(-1.0, 3.0 * PLACE_S, 0.01)
    poses = motion.sample(t).objects[BOARD]
    held = (np.maximum(t, 0.0) % PLACE_S) < HOLD_S - 0.02
    speed = np.linalg.norm(np.gradient(poses[:, :3, 3], 0.01, axis=0), axis=1)
    assert speed[held][1:-1].max() < 0.01
    assert speed.max() > 0.1
    # No jump: 1.875 is the greatest slope of the way over its mean.
    steps = np.linalg.norm(
        np.diff([motion.sample(np.array([k * PLACE_S])).objects[BOARD][0] for k in range(4)], axis=0)[:, :3, 3], axis=1
    )
    assert speed.max() < 1.01 * 1.875 * steps.max() / MOVE_S
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0, atol=1e-9)


def test_any_order_of_asking_gives_the_same_poses(cameras: dict[str, CameraModel]) -> None:
    t = np.array([7.9, 0.3, 100.4, 2.2])
    together = board_world(cameras).motion.sample(t).objects[BOARD]
    for moment, pose in zip(t[::-1], together[::-1], strict=True):
        np.testing.assert_array_equal(board_world(cameras).motion.sample(np.array([moment])).objects[BOARD][0], pose)
    assert not np.allclose(board_world(cameras, seed=2).motion.sample(t).objects[BOARD], together)


def test_places_cover_the_volume_and_every_picture(cameras: dict[str, CameraModel]) -> None:
    world = board_world(cameras)
    board, places = ChessBoard(), 72
    motion = world.motion
    assert isinstance(motion, BoardMotion)
    poses = np.array([motion.place(number) for number in range(places)])
    for number, camera in enumerate(cameras.values()):
        own = poses[number::2]
        seen = [camera.project(board.outline @ T[:3, :3].T + T[:3, 3]) for T in own]
        whole = np.array([camera.contains(pixels).all() for pixels in seen])
        assert whole.mean() >= 0.95
        cells = np.zeros((6, 8), dtype=bool)
        for T in own[whole]:
            at = (camera.project(board.corners @ T[:3, :3].T + T[:3, 3]) / 80.0).astype(int)
            cells[at[:, 1].clip(0, 5), at[:, 0].clip(0, 7)] = True
        assert cells.mean() > 0.9
        assert cells[[0, 0, -1, -1], [0, -1, 0, -1]].sum() >= 3, "the corners of the picture"
        middles = own[:, :3, :3] @ board.middle + own[:, :3, 3]
        depth = camera.to_camera(middles)[:, 2]
        assert depth.min() < NEAR_M + 0.1
        assert depth.max() > FAR_M - 0.2
        rays = (middles - camera.center) / np.linalg.norm(middles - camera.center, axis=1, keepdims=True)
        axis = camera.R_camera_rig.T[:, 2]
        tilt = np.degrees(np.arccos(np.clip(own[:, :3, 2] @ axis, -1.0, 1.0)))
        assert tilt.max() <= MAX_TILT_DEG + 1e-6
        assert tilt.max() > MAX_TILT_DEG - 8.0
        assert (np.einsum("nc,nc->n", own[:, :3, 2], rays) > 0.0).all(), "the printed face looks at the camera"


@pytest.mark.parametrize("name", ["left", "right"])
def test_corners_of_a_still_picture_are_true(name: str, cameras: dict[str, CameraModel]) -> None:
    world, camera = board_world(cameras), cameras[name]
    place = list(cameras).index(name)
    for config, limit_px in ((SimConfig(noise_sigma=0.0, light_drift=0.0), 0.055), (SimConfig(), 0.06)):
        renderer = Renderer(camera, world, config, CameraConfig(source="simulated"), place)
        errors = []
        for number in range(place, 24, 2):
            t = number * PLACE_S + 0.5 * HOLD_S
            true = corners_at(world, camera, t)
            errors.append(found_corners(renderer.render(t, 0.004, 0.012), true) - true)
        stacked = np.concatenate(errors)
        assert np.sqrt((stacked**2).mean()) < limit_px
        assert np.abs(stacked.mean(axis=0)).max() < 0.005, "no bias"


def test_rolling_shutter_places_each_corner_at_its_rows_time(cameras: dict[str, CameraModel]) -> None:
    camera = cameras["left"]
    t_first, readout = 0.0, 0.02

    class Sliding:
        def sample(self, t_s: FloatArray) -> MotionSample:
            poses = np.tile(np.eye(4), (len(t_s), 1, 1))
            poses[:, :3, 3] = np.array([-0.1, -0.06, 0.5]) + np.outer(t_s, [0.5, 0.2, 0.0])
            return MotionSample({}, {}, {BOARD: poses})

    world = World(1, {}, {}, motion=Sliding(), board=ChessBoard())
    renderer = Renderer(camera, world, SimConfig(noise_sigma=0.0, light_drift=0.0), CameraConfig(source="simulated"))
    true = corners_at(world, camera, t_first)
    for _ in range(4):
        rows = [t_first + v / (camera.height - 1) * readout for v in true[:, 1]]
        true = np.array([corners_at(world, camera, t)[k] for k, t in enumerate(rows)])
    moved = np.abs(true - corners_at(world, camera, t_first)).max()
    assert moved > 3.0
    found = found_corners(renderer.render(t_first, 1e-6, readout), true)
    assert np.sqrt(((found - true) ** 2).mean()) < 0.07


def test_motion_blur_is_centred_on_the_exposures_middle(cameras: dict[str, CameraModel]) -> None:
    camera, world = cameras["left"], board_world(cameras)
    renderer = Renderer(camera, world, SimConfig(noise_sigma=0.0, light_drift=0.0), CameraConfig(source="simulated"))
    t, exposure = HOLD_S + 0.25 * MOVE_S, 0.012
    true = corners_at(world, camera, t + exposure / 2.0)
    inside = camera.contains(true)
    travel = np.linalg.norm(corners_at(world, camera, t + exposure) - corners_at(world, camera, t), axis=1)
    assert travel[inside].max() > 2.0
    found = found_corners(renderer.render(t, exposure, 0.0), true)
    assert np.sqrt(((found - true)[inside] ** 2).mean()) < 0.1


def test_its_back_is_blank(cameras: dict[str, CameraModel]) -> None:
    class Turned:
        def sample(self, t_s: FloatArray) -> MotionSample:
            pose = np.diag([-1.0, 1.0, -1.0, 1.0])
            pose[:3, 3] = 0.1, -0.06, 0.5
            return MotionSample({}, {}, {BOARD: np.tile(pose, (len(t_s), 1, 1))})

    world = World(1, {}, {}, motion=Turned(), board=ChessBoard())
    config = SimConfig(noise_sigma=0.0, light_drift=0.0)
    image = Renderer(cameras["left"], world, config, CameraConfig(source="simulated")).render(0.0)
    assert np.ptp(image[220:260, 300:340]) == 0
    assert image[240, 320, 0] > 100


@pytest.fixture
def board_rig(tmp_path: Path) -> Path:
    text = rig_template(folder="rig", name="boards", source="simulated", seed=3)
    (tmp_path / "rig").mkdir()
    (tmp_path / "rig" / RIG_FILE).write_text(text + 'motion = "board"\n')
    return tmp_path / "rig"


def test_a_rig_file_makes_the_world_of_a_board(board_rig: Path) -> None:
    rig = load_rig(board_rig)
    world = World.from_rig(rig)
    truth = decode(encode(world.truth(1.0, 1_700_000_000_000_000_000)), Truth)
    assert set(truth.objects) == {BOARD}
    assert not truth.hands
    motion = BoardMotion(3, tuple(true_cameras(rig).values()), ChessBoard())
    np.testing.assert_allclose(truth.objects[BOARD].position, motion.place(0)[:3, 3], atol=1e-12)
