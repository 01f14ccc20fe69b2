"""The faces of a shape that a finger can touch, and how far a fingertip stands off each.

Axes are the object's own, see `rhot.messages.tracked`. A box has six faces: top and bottom at +y and −y, right and left
at +x and −x, front and back at +z and −z. A cylinder has two ends, top and bottom at +z and −z, and a side all round.
A sphere is touched anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.messages import BoxShape, CylinderShape, FacedShape

_BOX_FACES: Final = {
    "top": (1, 1.0),
    "front": (2, 1.0),
    "right": (0, 1.0),
    "back": (2, -1.0),
    "left": (0, -1.0),
    "bottom": (1, -1.0),
}
"""Name to axis and side, in the order in which a person who turns a box comes to them."""
_AXIS_NAMES: Final = {f"{'+' if side > 0 else '-'}{'xyz'[axis]}": name for name, (axis, side) in _BOX_FACES.items()}
_ENDS: Final = {"top": 1.0, "bottom": -1.0}
_CYLINDER_AXIS_NAMES: Final = {"+z": "top", "-z": "bottom"}


@dataclass(frozen=True, slots=True)
class Gaps:
    """How N points lie to one face, object axes.

    Attributes:
        distance_m: (N,) along the face's normal, positive outside.
        normals: (N, 3) gradient of that distance: the way out.
        beside_m: (N, 2) how far they lie beyond the face's edges, 0 above the face.
        beside_slopes: (N, 2, 3) gradients of these.
    """

    distance_m: FloatArray
    normals: FloatArray
    beside_m: FloatArray
    beside_slopes: FloatArray


def faces_of(shape: FacedShape) -> tuple[str, ...]:
    """Return the names of a shape's faces, in the order in which they are asked for."""
    if isinstance(shape, BoxShape):
        return tuple(_BOX_FACES)
    return ("top", "side", "bottom") if isinstance(shape, CylinderShape) else ("anywhere",)


def usual_faces(shape: FacedShape) -> tuple[str, ...]:
    """Return the faces to touch unless somebody says otherwise: all but the one on which an object stands."""
    return tuple(face for face in faces_of(shape) if face != "bottom")


def face_named(shape: FacedShape, text: str) -> str:
    """Return a face by its name or its axis (such as `+x`).

    Raises:
        ConfigError: the shape has no such face.
    """
    word = text.strip().lower().replace("−", "-")
    if isinstance(shape, BoxShape):
        word = _AXIS_NAMES.get(word, word)
    elif isinstance(shape, CylinderShape):
        word = _CYLINDER_AXIS_NAMES.get(word, word)
    if word not in faces_of(shape):
        raise ConfigError(f"a {shape.kind} has no face {text[:20]!r}; its faces are {', '.join(faces_of(shape))}")
    return word


def free_rotations(shape: FacedShape) -> tuple[int, ...]:
    """Return the object's axes about which a rotation changes nothing that a finger feels."""
    if isinstance(shape, BoxShape):
        return ()
    return (2,) if isinstance(shape, CylinderShape) else (0, 1, 2)


def reach_m(shape: FacedShape) -> float:
    """Return the radius of the smallest ball about the shape's middle that holds all of it, metres."""
    if isinstance(shape, BoxShape):
        return 0.5 * float(np.linalg.norm(shape.size))
    if isinstance(shape, CylinderShape):
        return float(np.hypot(shape.radius, 0.5 * shape.height))
    return shape.radius


def gaps(shape: FacedShape, face: str, q: FloatArray) -> Gaps:
    """Return how points q (N, 3), metres, object axes, lie to a face of `faces_of`."""
    count = len(q)
    slopes = np.zeros((count, 2, 3))
    if isinstance(shape, BoxShape):
        axis, side = _BOX_FACES[face]
        half = 0.5 * np.array(shape.size)
        others = [other for other in range(3) if other != axis]
        over = np.abs(q[:, others]) - half[others]
        for index, other in enumerate(others):
            slopes[:, index, other] = np.where(over[:, index] > 0.0, np.where(q[:, other] < 0.0, -1.0, 1.0), 0.0)
        normals = np.zeros((count, 3))
        normals[:, axis] = side
        return Gaps(side * q[:, axis] - half[axis], normals, np.maximum(over, 0.0), slopes)
    if isinstance(shape, CylinderShape):
        return _cylinder_gaps(shape, face, q)
    far = np.linalg.norm(q, axis=1)
    return Gaps(far - shape.radius, q / np.maximum(far, 1e-9)[:, None], np.zeros((count, 2)), slopes)


def _cylinder_gaps(shape: CylinderShape, face: str, q: FloatArray) -> Gaps:
    off_axis = np.hypot(q[:, 0], q[:, 1])
    radial = np.column_stack([q[:, :2] / np.maximum(off_axis, 1e-9)[:, None], np.zeros(len(q))])
    beside, slopes = np.zeros((len(q), 2)), np.zeros((len(q), 2, 3))
    if face == "side":
        beside[:, 0] = np.maximum(np.abs(q[:, 2]) - 0.5 * shape.height, 0.0)
        slopes[:, 0, 2] = np.where(beside[:, 0] > 0.0, np.sign(q[:, 2]), 0.0)
        return Gaps(off_axis - shape.radius, radial, beside, slopes)
    side = _ENDS[face]
    beside[:, 0] = np.maximum(off_axis - shape.radius, 0.0)
    slopes[:, 0] = np.where(beside[:, :1] > 0.0, radial, 0.0)
    normals = np.tile([0.0, 0.0, side], (len(q), 1))
    return Gaps(side * q[:, 2] - 0.5 * shape.height, normals, beside, slopes)
