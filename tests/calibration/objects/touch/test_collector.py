from __future__ import annotations

import numpy as np
from touched.toucher import BOX, P_DEVICE_OBJECT, R_DEVICE_OBJECT, RADIUS_M, Toucher, surface

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from rhot_calibration.objects.touch.checks import judged
from rhot_calibration.objects.touch.collector import TouchCollector
from rhot_objects.pose import Pose

T_RIG_DEVICE = Pose.from_arrays(
    (0.1, 0.05, 0.8), quaternion_from_rotation(rotation_from_vector(np.array([0.3, 1.0, 2.0])))
)


class Scene:
    """A finger and a box's tracker at 60 Hz; both shake as in life."""

    def __init__(self, plan: tuple[str, ...]) -> None:
        self.collector = TouchCollector(BOX, plan)
        self.rng = np.random.default_rng(3)
        self.t_ns = 1_700_000_000_000_000_000
        self.device = T_RIG_DEVICE

    def tip(self, face: str, number: int, off_m: float = 0.0) -> FloatArray:
        """Return the tip joint (3,), rig frame, that touches (or hovers over) a place."""
        place, out = surface(BOX, face, number, 4)
        in_device = R_DEVICE_OBJECT @ (place + (RADIUS_M + off_m) * out) + P_DEVICE_OBJECT
        at = Pose.from_arrays(in_device, (0.0, 0.0, 0.0, 1.0))
        return (self.device @ at).position

    def hold(self, tip: FloatArray, seconds: float = 0.7, speed: FloatArray | None = None) -> None:
        for _ in range(round(60 * seconds)):
            self.t_ns += 16_666_667
            if speed is not None:
                tip = tip + speed / 60.0
            self.collector.add_tip(self.t_ns, tip + self.rng.normal(0.0, 2e-4, 3), RADIUS_M)
            self.see_device()

    def see_device(self) -> None:
        p = self.device.position + self.rng.normal(0.0, 3e-4, 3)
        self.collector.add_device(self.t_ns, Pose.from_arrays(p, self.device.orientation_xyzw))


def test_a_touch_is_taken_once_and_where_it_was() -> None:
    scene = Scene(("top", "top", "front"))
    collector = scene.collector
    assert collector.asked == "touch top, 1 of 2"
    scene.hold(scene.tip("top", 0), 2.0)
    assert [touch.face for touch in collector.touches] == ["top"]
    assert collector.hint == "touch top, 2 of 2: another place, near a corner"
    place, out = surface(BOX, "top", 0, 4)
    expected = R_DEVICE_OBJECT @ (place + RADIUS_M * out) + P_DEVICE_OBJECT
    np.testing.assert_allclose(collector.touches[0].tip_device, expected, atol=5e-4)
    scene.hold(scene.tip("top", 1))
    scene.hold(scene.tip("front", 1))
    assert collector.done
    assert collector.hint == ""
    collector.take_back()
    assert collector.asked == "touch front, 1 of 1"


def test_a_finger_that_moves_or_turns_back_touches_nothing() -> None:
    scene = Scene(("top",))
    scene.hold(scene.tip("top", 0, off_m=0.02), 1.5, speed=np.array([0.02, 0.0, 0.0]))
    assert not scene.collector.touches
    assert "hold finger and object still" in scene.collector.hint
    for step in np.linspace(-1.0, 1.0, 60):
        scene.hold(scene.tip("top", 0, off_m=0.02 + 0.03 * step**2), 1 / 60)
    assert not scene.collector.touches


def test_an_object_that_moves_with_the_finger_is_refused() -> None:
    scene = Scene(("top",))
    for _ in range(90):
        scene.device = Pose.from_arrays(
            scene.device.position + np.array([2e-3, 0.0, 0.0]), scene.device.orientation_xyzw
        )
        scene.hold(scene.tip("top", 0), 1 / 60)
    assert not scene.collector.touches
    assert scene.collector.hint == "the object moves: hold it still while you touch it"
    assert scene.collector.take_now() is None


def test_what_is_not_tracked_is_said() -> None:
    scene = Scene(("top",))
    assert scene.collector.hint == "the finger is not tracked"
    for _ in range(60):
        scene.t_ns += 16_666_667
        scene.collector.add_tip(scene.t_ns, scene.tip("top", 0), RADIUS_M)
    assert scene.collector.hint == "the tracking system does not see the object's tracker"
    for _ in range(60):
        scene.t_ns += 16_666_667
        scene.collector.add_no_tip(scene.t_ns, "the hand is only predicted")
        scene.see_device()
    assert scene.collector.hint == "the hand is only predicted"
    assert not scene.collector.touches


def test_a_finger_far_away_touches_nothing_unless_one_says_so() -> None:
    scene = Scene(("top",))
    scene.hold(scene.tip("top", 0, off_m=0.25), 1.0)
    assert "the finger is far from the object" in scene.collector.hint
    assert scene.collector.take_now() is not None
    assert scene.collector.done


def test_once_the_offset_is_known_another_face_is_not_taken_for_the_asked_one() -> None:
    plan = ("top",) * 4 + ("front",) * 4 + ("right",) * 4
    scene = Scene((*plan, "back"))
    scene.collector.touches = Toucher(BOX).touches(("top", "front", "right"), 4)
    scene.collector.rough = judged(BOX, scene.collector.touches, np.eye(3)).fit
    scene.hold(scene.tip("left", 0))
    assert scene.collector.hint == "touch back, 1 of 1: that is left by the touches so far"
    scene.hold(scene.tip("back", 0, off_m=0.05))
    assert "the finger does not touch it" in scene.collector.hint
    scene.hold(scene.tip("back", 0))
    assert scene.collector.done
