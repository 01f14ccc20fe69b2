"""The ankle sensors: perfect ones integrate back to the truth, real ones err by what the datasheet allows."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.rig import DepthCameraConfig, FeetConfig, FootConfig, ImuConfig
from rhot_sim.walker.foot_path import SIDES
from rhot_sim.walker.imu import R_UP_RIG, ImuErrors
from rhot_sim.walker.world import WalkerWorld


def feet_at(rate_hz: float) -> FeetConfig:
    imu = ImuConfig(source="simulated", rate_hz=rate_hz)
    return FeetConfig(
        camera=DepthCameraConfig(source="simulated"),
        left=FootConfig(marker_id=0, imu=imu),
        right=FootConfig(marker_id=1, imu=imu),
    )


def sensor_poses(world: WalkerWorld, t_s: FloatArray) -> FloatArray:
    return world.feet(t_s)["right"] @ world.T_foot_sensor("right")


@pytest.mark.parametrize(("rate_hz", "limit_m"), [(100.0, 0.01), (400.0, 0.001)])
@pytest.mark.parametrize("program", ["walk", "sudden", "squat"])
def test_a_perfect_sensor_integrates_back_to_the_truth(
    body: BodyModel, program: str, rate_hz: float, limit_m: float
) -> None:
    world = WalkerWorld(3, body, program, feet=feet_at(rate_hz), imu_errors=ImuErrors.none())
    t, linear, quaternion, _ = world.imu("right", 0.5, 6.0)
    true = sensor_poses(world, t)
    R_north_sensor = rotation_from_quaternion(quaternion)
    # The sensor's north is turned about the vertical by an angle that nobody knows; one moment tells it.
    R_rig_north = true[0, :3, :3] @ R_north_sensor[0].T
    assert R_rig_north @ [0.0, 0.0, 1.0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-9)
    assert np.abs(R_rig_north @ R_north_sensor - true[:, :3, :3]).max() < 1e-9
    acceleration = np.einsum("nij,nj->ni", R_rig_north @ R_north_sensor, linear)
    step_s = np.diff(t)[:, None]
    # Trapezia twice, from rest.
    velocity = np.vstack([np.zeros(3), np.cumsum((acceleration[1:] + acceleration[:-1]) / 2.0 * step_s, axis=0)])
    moved = np.vstack([np.zeros(3), np.cumsum((velocity[1:] + velocity[:-1]) / 2.0 * step_s, axis=0)])
    assert np.abs(moved + true[0, :3, 3] - true[:, :3, 3]).max() < limit_m


def test_the_angular_rate_is_that_of_the_turn(body: BodyModel) -> None:
    world = WalkerWorld(3, body, "walk", feet=feet_at(400.0), imu_errors=ImuErrors.none())
    t, _, quaternion, rate = world.imu("right", 1.0, 3.0)
    R = rotation_from_quaternion(quaternion)
    skew = np.swapaxes(R[:-1], 1, 2) @ R[1:] / np.diff(t)[:, None, None]
    measured = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=-1)
    between = (rate[1:] + rate[:-1]) / 2.0
    assert np.abs(measured - between).max() < 0.05
    assert np.abs(rate).max() > 3.0


def test_errors_are_those_of_a_bno080(body: BodyModel) -> None:
    moving_error, resting, tilts = [], [], []
    for seed in range(6):
        world = WalkerWorld(seed, body, "walk", feet=feet_at(100.0))
        t, linear, quaternion, _ = world.imu("right", 2.0, 22.0)
        perfect = WalkerWorld(seed, body, "walk", feet=feet_at(100.0), imu_errors=ImuErrors.none())
        _, true_linear, true_quaternion, _ = perfect.imu("right", 2.0, 22.0)
        number = np.rint((t - t[0]) * 100.0).astype(int)
        error = linear - true_linear[number]
        flat = world.flat("right", t) & world.flat("right", t - 1.0)
        resting.append(np.std(error[flat], axis=0))
        moving_error.append(np.sqrt(np.mean(error[~flat] ** 2)))
        up = np.stack([rotation_from_quaternion(q)[:, 2] for q in (quaternion, true_quaternion[number])])
        tilts.append(np.degrees(np.sqrt(np.mean(np.sum((up[0] - up[1]) ** 2, axis=-1)))))
    # Datasheet: 0.35 m/s² and 2.5° in motion.
    assert 0.1 < np.median(moving_error) < 0.5
    assert 0.5 < np.median(tilts) < 3.0
    assert np.median(resting) < 0.12


def test_values_are_rounded_and_samples_lost(body: BodyModel) -> None:
    world = WalkerWorld(1, body, "still", feet=feet_at(100.0))
    t, linear, quaternion, rate = world.imu("left", 0.0, 60.0)
    assert np.array_equal(linear * 256.0, np.rint(linear * 256.0))
    assert np.array_equal(quaternion * 2.0**14, np.rint(quaternion * 2.0**14))
    assert np.array_equal(rate * 512.0, np.rint(rate * 512.0))
    assert 0.95 < len(t) / 6000.0 < 0.999
    assert np.diff(t).max() > 0.015
    assert (np.diff(t) > 0.0).all()
    assert np.std(np.mod(t * 100.0 + 0.5 - t[0] * 100.0, 1.0)) / 100.0 < 0.0005
    late = world.imu_delivered_s("left", t) - t
    assert late.min() >= 0.004
    assert late.max() < 0.02


def test_pieces_are_the_same_as_the_whole(body: BodyModel) -> None:
    world = WalkerWorld(2, body, "walk", feet=feet_at(100.0))
    whole = world.imu("left", 3.0, 6.0)
    again = WalkerWorld(2, body, "walk", feet=feet_at(100.0))
    pieces = [again.imu("left", *span) for span in ((5.1, 6.0), (3.0, 3.02), (3.02, 5.1))]
    order = [pieces[1], pieces[2], pieces[0]]
    for index, expected in enumerate(whole):
        assert np.abs(np.concatenate([piece[index] for piece in order]) - expected).max() < 1e-12
    assert all(len(each) == 0 for each in world.imu("left", 3.0, 3.0))


def test_sensors_are_strapped_on_differently(body: BodyModel) -> None:
    worlds = [WalkerWorld(seed, body, "still") for seed in range(3)]
    mounts = [world.T_foot_sensor(side) for world in worlds for side in SIDES]
    for i, one in enumerate(mounts):
        assert np.linalg.norm(one[:3, 3]) < 0.15
        assert np.linalg.det(one[:3, :3]) == pytest.approx(1.0)
        for other in mounts[:i]:
            assert np.linalg.norm(one[:3, :3] - other[:3, :3]) > 0.1
    assert (R_UP_RIG @ [0.0, 1.0, 0.0]).tolist() == [0.0, 0.0, 1.0]
