from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rhot.rig import RegistrationFile, RigidTransform
from rhot.rig.folder import NO_REGISTRATION
from rhot_objects.pose import Pose, Registration, angle_between

POSES = st.builds(
    Pose.from_arrays,
    hnp.arrays(np.float64, 3, elements=st.floats(-5.0, 5.0)),
    hnp.arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: float(q @ q) > 1e-3),
)

QUARTER_TURN_ABOUT_Z = (0.0, 0.0, float(np.sqrt(0.5)), float(np.sqrt(0.5)))


def test_each_step_of_the_chain_counts() -> None:
    # Tracker space lies 1 m along the rig's x and is turned by 90° about z: its x is the rig's y.
    # The object's origin sits 0.1 m along the device's x.
    registration = Registration.from_file(
        RegistrationFile(
            T_rig_tracker=RigidTransform(position=(1.0, 0.0, 0.0), orientation=QUARTER_TURN_ABOUT_Z),
            T_tracker_object={"cup": RigidTransform(position=(0.1, 0.0, 0.0), orientation=(0.0, 0.0, 0.0, 1.0))},
        )
    )
    device = Pose.from_arrays((2.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    np.testing.assert_allclose(registration.to_rig("cup", device).position, (1.0, 2.1, 0.0), atol=1e-12)
    np.testing.assert_allclose(registration.to_rig("cup", device).orientation_xyzw, QUARTER_TURN_ABOUT_Z, atol=1e-12)
    np.testing.assert_allclose(registration.to_rig("other", device).position, (1.0, 2.0, 0.0), atol=1e-12)


def test_without_a_file_the_tracker_space_is_the_rig() -> None:
    device = Pose.from_arrays((0.1, 0.2, 0.3), (0.5, 0.5, 0.5, 0.5))
    same = Registration.from_file(NO_REGISTRATION).to_rig("cup", device)
    np.testing.assert_allclose(same.position, device.position)
    assert angle_between(same, device) < 1e-9


@settings(deadline=None, max_examples=50)
@given(POSES, POSES, POSES)
def test_there_and_back(T_rig_tracker: Pose, T_device_object: Pose, T_rig_object: Pose) -> None:
    registration = Registration(T_rig_tracker, {"cup": T_device_object})
    for object_id in ("cup", "other"):
        again = registration.to_rig(object_id, registration.to_tracker(object_id, T_rig_object))
        np.testing.assert_allclose(again.position, T_rig_object.position, atol=1e-9)
        assert angle_between(again, T_rig_object) < 1e-7


@settings(deadline=None, max_examples=50)
@given(POSES, POSES, POSES)
def test_registration_keeps_distances(T_rig_tracker: Pose, first: Pose, second: Pose) -> None:
    registration = Registration(T_rig_tracker, {})
    a, b = (registration.to_rig("cup", pose).position for pose in (first, second))
    assert np.isclose(np.linalg.norm(a - b), np.linalg.norm(first.position - second.position), atol=1e-9)
