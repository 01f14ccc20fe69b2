from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from rhot.messages import ObjectPose
from rhot.rig import RegistrationFile, RigidTransform
from rhot_objects.core import ObjectCore
from rhot_objects.pose import Pose, Registration, angle_between
from rhot_sim.sources.objects import ORIENTATION_NOISE_RAD, POSITION_NOISE_M, SimulatedSource

START = 1_700_000_000_000_000_000
REGISTRATION = Registration.from_file(
    RegistrationFile(
        T_rig_tracker=RigidTransform(position=(0.4, -1.1, 2.0), orientation=(0.5, -0.5, 0.5, 0.5)),
        T_tracker_object={"cup": RigidTransform(position=(0.0, 0.05, -0.02), orientation=(0.6, 0.0, 0.0, 0.8))},
    )
)


def world(t_s: float) -> Mapping[str, Pose]:
    return {
        "cup": Pose.from_arrays((0.1 * np.sin(t_s), 0.0, 0.6), (0.0, np.sin(t_s / 4), 0.0, np.cos(t_s / 4))),
        "pen": Pose.from_arrays((0.0, 0.1, 0.7), (0.0, 0.0, 0.0, 1.0)),
    }


def opened(*ids: str, seed: int = 1, registration: Registration = REGISTRATION) -> SimulatedSource:
    source = SimulatedSource(world, registration, frozenset(ids or ("cup", "pen")), seed)
    source.open(START)
    return source


def test_through_the_whole_chain_the_truth_comes_back_but_for_the_noise() -> None:
    source, core = opened("cup"), ObjectCore(REGISTRATION)
    position_errors, angles = [], []
    for step in range(400):
        elapsed_ns = step * 11_111_111
        ((key, message),) = core.feed(source.read(START + elapsed_ns), START + elapsed_ns)
        assert key == "rhot/object/cup"
        assert isinstance(message, ObjectPose)
        assert (message.state, message.t_ns) == ("measured", START + elapsed_ns)
        truth = world(elapsed_ns / 1e9)["cup"]
        position_errors.append(np.array(message.position) - truth.position)
        angles.append(angle_between(Pose.from_arrays(message.position, message.orientation), truth))
    # 54 mm from the device to the object times 0.1° add another 0.09 mm to the 0.3 mm of the device.
    lever_m = float(np.linalg.norm((0.0, 0.05, -0.02))) * ORIENTATION_NOISE_RAD
    expected_m = float(np.sqrt(3 * POSITION_NOISE_M**2 + 2 * lever_m**2))
    rms_m = float(np.sqrt(np.mean(np.sum(np.square(position_errors), axis=1))))
    assert 1e3 * rms_m == pytest.approx(1e3 * expected_m, rel=0.15)
    assert 1e3 * float(np.linalg.norm(np.mean(position_errors, axis=0))) < 0.1
    rms_rad = float(np.sqrt(np.mean(np.square(angles))))
    assert rms_rad == pytest.approx(np.sqrt(3) * ORIENTATION_NOISE_RAD, rel=0.15)


def test_poses_are_in_tracker_space() -> None:
    pose = opened("pen").read(START)["pen"].pose
    # T_rig_tracker turns tracker (x, y, z) into rig (y, −z, −x) and shifts; the pen has no offset to its device.
    np.testing.assert_allclose(pose.position, _tracker_point((0.0, 0.1, 0.7)), atol=5 * POSITION_NOISE_M)


def _tracker_point(rig_point: tuple[float, float, float]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    x, y, z, w = 0.5, -0.5, 0.5, 0.5
    R_rig_tracker = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    point: np.ndarray[tuple[int], np.dtype[np.float64]] = R_rig_tracker.T @ (np.array(rig_point) - (0.4, -1.1, 2.0))
    return point


def test_a_function_of_seed_and_time() -> None:
    def values(source: SimulatedSource, elapsed_ns: int) -> list[float]:
        pose = source.read(START + elapsed_ns)["cup"].pose
        return [*pose.position.tolist(), *pose.orientation_xyzw.tolist()]

    first, second = opened(), opened("cup")
    assert values(first, 10**9) == values(second, 10**9)
    later = values(first, 10**9 + 10**7)
    assert values(second, 10**9 + 10**7) == later
    assert values(first, 10**9) == values(second, 10**9), "asking again, or out of order, changes nothing"
    assert values(opened(seed=2), 10**9) != values(first, 10**9)


def test_only_configured_objects_are_shown_and_only_while_open() -> None:
    source = opened("pen")
    assert set(source.read(START)) == {"pen"}
    assert source.read(START - 1) == {}
    source.close()
    source.close()
    assert source.read(START) == {}
