from __future__ import annotations

import numpy as np

from rhot.anatomy.hand import MOVING, HandModel
from rhot.geometry.rotations import inverse
from rhot.rig import HandFile
from rhot_sim.world.motion import OBJECT_SIZE_M
from rhot_sim.world.touching import FACES, TOUCHES_A_FACE, WAIT_S, TouchMotion

HAND = HandModel.from_file(HandFile(), "right")
AXES = {"top": (1, 1.0), "front": (2, 1.0), "right": (0, 1.0), "back": (2, -1.0), "left": (0, -1.0)}
STEP_S = 0.05


def test_every_face_is_touched_at_four_corners_in_order_and_nothing_else_is_held_still() -> None:
    motion = TouchMotion({"right": HAND}, ["cube"])
    t = np.arange(0.0, 57.0, STEP_S)
    sample = motion.sample(t)
    joints = HAND.forward(sample.wrists["right"], sample.angles["right"])
    tips, radius = joints.positions[:, MOVING[1, 3]], HAND.radii[MOVING[1, 3]]
    T = sample.objects["cube"]
    q = np.array([(inverse(pose) @ np.append(tip, 1.0))[:3] for pose, tip in zip(T, tips, strict=True)])
    still = np.linalg.norm(np.diff(q, axis=0), axis=1) < 1e-6
    still &= np.abs(np.diff(T, axis=0)).max(axis=(1, 2)) < 1e-9
    begins = np.flatnonzero(still & ~np.roll(still, 1))
    ends = np.flatnonzero(still & ~np.roll(still, -1))
    assert len(begins) == len(FACES) * TOUCHES_A_FACE
    assert (ends - begins).min() * STEP_S > 1.0
    assert t[begins[0]] > WAIT_S
    for face, places in zip(FACES, np.split(q[begins], len(FACES)), strict=True):
        axis, side = AXES[face]
        np.testing.assert_allclose(side * places[:, axis], OBJECT_SIZE_M[axis] / 2.0 + radius, atol=1e-6)
        others = [other for other in range(3) if other != axis]
        assert (np.abs(places[:, others]) < OBJECT_SIZE_M[others] / 2.0 - 0.005).all()
        assert len({tuple(np.sign(place)) for place in places[:, others]}) == TOUCHES_A_FACE


def test_the_round_repeats_without_a_jump() -> None:
    motion = TouchMotion({"right": HAND}, ["cube"])
    t = np.arange(motion.round_s - 1.0, motion.round_s + 1.0, 0.01)
    sample = motion.sample(t)
    assert np.abs(np.diff(sample.wrists["right"][:, :3, 3], axis=0)).max() < 0.01
    assert np.abs(np.diff(sample.objects["cube"][:, :3, :3], axis=0)).max() < 0.05
