from __future__ import annotations

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.geometry.rotations import rotation_from_quaternion, rotation_from_vector
from rhot.messages import Side
from rhot.rig import HandFile, MarkerConfig
from rhot_ik.hand.closed_form import FingerGeometry
from rhot_ik.hand.filter.kinematics import HandKinematics


def geometry_of(side: Side) -> FingerGeometry:
    hand = HandFile(marker_offsets_m=dict.fromkeys(FINGERS, (0.002, -0.003, 0.004)))
    markers = {finger: MarkerConfig(hand=side, joint=f"{finger}_tip") for finger in FINGERS}
    return FingerGeometry.of(HandModel.from_file(hand, side), markers)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_hand_is_that_of_the_model(side: Side) -> None:
    geometry = geometry_of(side)
    kinematics = HandKinematics(geometry)
    rng = np.random.default_rng(1)
    for _ in range(20):
        q = rng.uniform(-0.5, 1.8, 20)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation_from_vector(rng.normal(size=3)), rng.normal(size=3)
        expected = geometry.model.forward(T, q.reshape(5, 4))
        positions, orientations, markers = kinematics.pose(T[:3, :3], T[:3, 3], q, np.zeros(5))
        assert np.allclose(positions, expected.positions, atol=1e-12)
        assert np.allclose(rotation_from_quaternion(orientations), expected.rotations, atol=1e-12)
        local = geometry.marker_points(q.reshape(5, 4))
        assert np.allclose(markers, local @ T[:3, :3].T + T[:3, 3], atol=1e-12)
        assert np.allclose(kinematics.markers(q, np.zeros(5))[0], local, atol=1e-12)


@pytest.mark.parametrize("side", ["right", "left"])
def test_derivatives_are_those_of_small_differences(side: Side) -> None:
    kinematics = HandKinematics(geometry_of(side))
    rng = np.random.default_rng(1)
    q, longer = np.radians(rng.uniform(-10.0, 60.0, 20)), rng.uniform(-0.1, 0.1, 5)
    tips, J = kinematics.markers(q, longer)
    for k in range(25):
        moved, lengths = q.copy(), longer.copy()
        finger, column = (k // 4, k % 4) if k < 20 else (k - 20, 4)
        if k < 20:
            moved[k] += 1e-6
        else:
            lengths[finger] += 1e-6
        difference = (kinematics.markers(moved, lengths)[0] - tips) / 1e-6
        assert np.allclose(difference[finger], J[finger, :, column], atol=1e-6)
        assert np.allclose(np.delete(difference, finger, axis=0), 0.0, atol=1e-9)
