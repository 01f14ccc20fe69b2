"""Somebody who touches an object of known shape with a fingertip, sampled as on the bus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_vector
from rhot.messages import BoxShape, CylinderShape, FacedShape, SphereShape
from rhot_calibration.objects.touch.fit import TOUCH_SD_M, Touch

BOX = BoxShape(size=(0.1, 0.06, 0.065))
CYLINDER = CylinderShape(radius=0.035, height=0.11)
SPHERE = SphereShape(radius=0.04)
R_DEVICE_OBJECT = rotation_from_vector(np.array([0.4, -1.3, 0.8]))
P_DEVICE_OBJECT = np.array([0.03, -0.05, 0.02])
RADIUS_M = 0.008
_FACES = {"top": (1, 1), "bottom": (1, -1), "front": (2, 1), "back": (2, -1), "right": (0, 1), "left": (0, -1)}
_CORNERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))


def surface(shape: FacedShape, face: str, number: int, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the place (3,) of touch `number` of `count` on a face, and the way out there (3,), object axes."""
    out, place = np.zeros(3), np.zeros(3)
    first, second = _CORNERS[number % 4]
    inward = 1.0 if number < 4 else 0.5
    if isinstance(shape, BoxShape):
        axis, side = _FACES[face]
        half = 0.5 * np.array(shape.size)
        a, b = (other for other in range(3) if other != axis)
        out[axis], place[axis] = side, side * half[axis]
        place[a], place[b] = inward * first * (half[a] - 0.01), inward * second * (half[b] - 0.01)
        return place, out
    angle = 2.0 * np.pi * number / count
    around = np.array([np.cos(angle), np.sin(angle), 0.0])
    if isinstance(shape, SphereShape):
        height = (2.0 * number + 1.0) / count - 1.0
        out = np.sqrt(1.0 - height**2) * np.array([np.cos(2.4 * number), np.sin(2.4 * number), 0.0])
        out[2] = height
        return shape.radius * out, out
    if face == "side":
        return shape.radius * around + np.array([0.0, 0.0, (0.5 * shape.height - 0.012) * (-1) ** number]), around
    out[2] = 1.0 if face == "top" else -1.0
    return 0.7 * shape.radius * around + 0.5 * shape.height * out, out


@dataclass
class Toucher:
    """Touches with the noise of a tracked fingertip.

    Attributes:
        shape: of the object.
        seed: of the noise.
        noise_m: standard deviation along each axis, one draw a touch.
        flesh_m: how far the tip stays off by more than its radius.
    """

    shape: FacedShape
    seed: int = 1
    noise_m: float = TOUCH_SD_M
    flesh_m: float = 0.0005
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def touch(self, face: str, number: int, count: int, called: str = "") -> Touch:
        """Touch a face, called by its own name unless another is given."""
        place, out = surface(self.shape, face, number, count)
        tip = R_DEVICE_OBJECT @ (place + (RADIUS_M + self.flesh_m) * out) + P_DEVICE_OBJECT
        return Touch(called or face, tip + self.rng.normal(0.0, self.noise_m, 3), RADIUS_M)

    def touches(self, faces: Sequence[str], per_face: int) -> list[Touch]:
        """Touch each face so many times, thrice that all round."""
        counts = {face: per_face * (3 if face in ("side", "anywhere") else 1) for face in faces}
        return [self.touch(face, number, count) for face, count in counts.items() for number in range(count)]
