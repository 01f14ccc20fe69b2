"""Where skin adjoins a painted cap in an image, as the cameras of the motion family state it."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot_bench.motion.painted import Capsules, cap_surface, seen_samples
from rhot_bench.motion.tracks import skin_sides

RADIUS, LENGTH, BONE = 0.007, 0.017, 0.028
CAP = cap_surface(LENGTH, RADIUS, RADIUS)
CAMERA = CameraModel.from_arrays(
    640, 480, np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]]), np.zeros(5), np.eye(4)
)


def flesh(*more: tuple[list[float], list[float], float]) -> Capsules:
    """Return a hand's 19 capsules, of which all but the index finger's outermost bone are far away, and more."""
    away = ([5.0, 5.0, 5.0], [5.0, 5.0, 5.1], 0.01)
    # The finger comes from the right of the image, its tip at the origin of the rig's x axis.
    own = ([BONE, 0.0, 0.6], [RADIUS, 0.0, 0.6], RADIUS)
    bones = [away] * 5 + [own] + [away] * 13 + list(more)
    begin, end, radius = (np.array(column) for column in zip(*bones, strict=True))
    fingers = np.array([f if bone == 2 else -1 for f in range(5) for bone in range(3)] + [-1] * (len(bones) - 15))
    return Capsules(begin[None], end[None], radius, fingers.astype(np.float64))


def side(capsules: Capsules) -> FloatArray:
    R = np.column_stack([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    samples, normals = (CAP.points @ R.T + [0.0, 0.0, 0.6])[None], (CAP.normals @ R.T)[None]
    _, shown = seen_samples(samples, normals, CAMERA.center, capsules, 1)
    pixels, depth_m = CAMERA.project(samples[0])[None], CAMERA.to_camera(samples[0])[None, :, 2]
    uv = np.average(pixels[0], axis=0, weights=shown[0])[None]
    found: FloatArray = skin_sides(CAMERA, uv, pixels, depth_m, shown, capsules, [CAP] * 5)[0]
    return found


def test_the_finger_comes_from_the_side_on_which_skin_adjoins() -> None:
    right, down = side(flesh())
    assert 0.1 < right < 0.4
    assert down == pytest.approx(0.0, abs=0.02)


def test_the_palm_beside_a_curled_tip_adjoins_it_too() -> None:
    behind = ([-0.03, 0.02, 0.62], [0.03, 0.02, 0.62], 0.015)
    palm = flesh()
    begin, end, radius = palm.begin.copy(), palm.end.copy(), palm.radius.copy()
    begin[0, 15], end[0, 15], radius[15] = behind
    right, down = side(Capsules(begin, end, radius, palm.finger))
    assert right > 0.05
    assert down > 0.1


def test_what_is_held_is_no_skin() -> None:
    right, down = side(flesh(([0.034, -0.05, 0.56], [0.034, 0.05, 0.56], 0.017)))
    assert right == pytest.approx(0.0, abs=0.02)
    assert down == pytest.approx(0.0, abs=0.02)
