"""What the objects that fingers close around say of fingers that no camera sees."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from rhot.anatomy.hand import MOVING, HandModel
from rhot.arrays import BoolArray, FloatArray, IntArray
from rhot.geometry.distance_grid import DistanceGrid
from rhot.geometry.hull import plane_distance
from rhot_ik.hand.filter.filter import HandFilter
from rhot_ik.hand.filter.kinematics import HandKinematics
from rhot_ik.hand.filter.process import ANGLES, ERROR_LASTS_S, PERSON, POSITION, ROTATION, SIZE, HandState

# Signed distances of points from objects, and the outward normals there.


class Shape(Protocol):
    """A solid body in the rig frame."""

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how far points (N, 3), metres, lie outside, (N,), negative inside, and the way out (N, 3), unit."""
        ...


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball.

    Attributes:
        centre: (3,) metres, rig frame.
        radius_m: its radius.
    """

    centre: FloatArray
    radius_m: float

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Shape`."""
        off = points - self.centre
        far = np.sqrt((off * off).sum(-1))
        return far - self.radius_m, off / np.maximum(far, 1e-9)[:, None]


@dataclass(frozen=True, slots=True)
class Box:
    """A cuboid.

    Attributes:
        T_rig_box: (4, 4) pose of its middle.
        size_m: (3,) its edges along its own x, y, z.
    """

    T_rig_box: FloatArray
    size_m: FloatArray

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Shape`."""
        R = self.T_rig_box[:3, :3]
        local = (points - self.T_rig_box[:3, 3]) @ R
        distance, out = _of_slabs(np.abs(local) - 0.5 * self.size_m)
        return distance, (out * np.where(local < 0.0, -1.0, 1.0)) @ R.T


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A round body with flat ends.

    Attributes:
        T_rig_cylinder: (4, 4) pose of its middle; its own z is its axis.
        radius_m, height_m: its radius and its length along the axis.
    """

    T_rig_cylinder: FloatArray
    radius_m: float
    height_m: float

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Shape`."""
        R = self.T_rig_cylinder[:3, :3]
        local = (points - self.T_rig_cylinder[:3, 3]) @ R
        round_m = np.hypot(local[:, 0], local[:, 1])
        beyond = np.stack([round_m - self.radius_m, np.abs(local[:, 2]) - 0.5 * self.height_m], axis=1)
        distance, out = _of_slabs(beyond)
        axes = np.empty((len(points), 3))
        axes[:, :2] = out[:, :1] * local[:, :2] / np.maximum(round_m, 1e-9)[:, None]
        axes[:, 2] = out[:, 1] * np.where(local[:, 2] < 0.0, -1.0, 1.0)
        return distance, axes @ R.T


@dataclass(frozen=True, slots=True)
class Hull:
    """A convex body between planes, in place of a mesh whose file is not here.

    Attributes:
        T_rig_hull: (4, 4) pose of its middle.
        planes: (K, 4) unit normal that leads out and distance from the middle, metres.
    """

    T_rig_hull: FloatArray
    planes: FloatArray

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Shape`."""
        R = self.T_rig_hull[:3, :3]
        distance, out = plane_distance(self.planes, (points - self.T_rig_hull[:3, 3]) @ R)
        return distance, out @ R.T


@dataclass(frozen=True, slots=True)
class Solid:
    """A body of any shape, by its signed distances.

    Attributes:
        T_rig_solid: (4, 4) pose of its middle.
        grid: its distances, in its own axes.
    """

    T_rig_solid: FloatArray
    grid: DistanceGrid

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Shape`."""
        R = self.T_rig_solid[:3, :3]
        distance, out = self.grid.distance((points - self.T_rig_solid[:3, 3]) @ R)
        return distance, out @ R.T


def _of_slabs(beyond: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distance (N,) and way out (N, k) of points that lie beyond the faces of k slabs by (N, k), metres."""
    outside = np.maximum(beyond, 0.0)
    far = np.sqrt((outside * outside).sum(-1))
    nearest = np.eye(beyond.shape[1])[np.argmax(beyond, axis=1)]
    inside = far == 0.0
    distance: FloatArray = np.where(inside, beyond.max(axis=1), far)
    return distance, np.where(inside[:, None], nearest, outside / np.maximum(far, 1e-12)[:, None])


# Hidden fingers in a grasp: no phalanx is inside of the object, and the last one touches it.
#
# Both are measurements of the gap g between the flesh and the surface, linearised about where the hand is taken to be:
# δg = n · δx with the surface's normal n and the flesh's place x. The prior of the angles decides how a finger that
# meets the surface slides on along it. What a fingertip touches is not seen, so the touch counts once in the time
# that errors last, not with every sample.
#
# That a hidden tip is behind something is true as well, but tells little: told with every sample, it put fingers that a
# held object hid below their neighbours (`rhot evaluate motion`, hands in a grasp with two to five hidden tips: 2 mm
# more); told only where nothing of the estimated hand hides the tip, it helped one half of the recorded hands and
# harmed the other.

_CONTACT_M: Final = 0.005
"""How far flesh that touches is from a surface, standard deviation: it gives way, and neither shape is exact."""
_AT_IT_M: Final = 0.02
"""A hand holds what the fingers that are seen are this near to, their median."""
_REACH_M: Final = 0.05
"""A last phalanx further than this from an object is not taken to touch it: the length of its two outer bones."""
_STEPS: Final = 2
"""Each sample corrects anew: one step is as accurate, the second makes the sigmas honest."""
_OUTWARDS: Final = np.array([1.0, 2.0, 3.0]) / 3.0
"""Where flesh is looked at along a bone, as shares of its length; a bone's start is the end of the one before."""
_PER_BONE: Final = len(_OUTWARDS)


class GraspContact:
    """Moves hidden fingers to where the object in the hand lets them be; stateless after construction.

    Args:
        model: the hand.
        hand_filter: whose states are corrected.
        kinematics: of the hand.
    """

    def __init__(self, model: HandModel, hand_filter: HandFilter, kinematics: HandKinematics) -> None:
        self._filter, self._kinematics = hand_filter, kinematics
        self._knuckles = model.knuckles[:, None]
        # Places along the bones as weights of knuckle, both hinges and tip.
        self._weights = np.zeros((3 * _PER_BONE, 4))
        for bone in range(3):
            rows = slice(bone * _PER_BONE, (bone + 1) * _PER_BONE)
            self._weights[rows, bone], self._weights[rows, bone + 1] = 1.0 - _OUTWARDS, _OUTWARDS
        self._radii = model.radii[MOVING] @ self._weights.T
        self._reach_m = float(model.bones[1:].sum(axis=1).mean())

    def is_held(self, state: HandState, tips: FloatArray, measured: BoolArray, shapes: Sequence[Shape]) -> bool:
        """Return whether a hand holds one of the shapes: where fingers are seen, they are at it; else the palm is near.

        Args:
            state: of the hand.
            tips: (5, 3) metres, rig frame, fingertips.
            measured: (5,) which of them are seen.
            shapes: rig frame.
        """
        if not shapes:
            return False
        if measured.any():
            far, _ = _nearest(tips[measured], shapes)
            return bool(np.median(far - self._radii[measured, -1]) < _AT_IT_M)
        return bool(self._within(self._reach_m, state, shapes))

    def _within(self, reach_m: float, state: HandState, shapes: Sequence[Shape]) -> list[Shape]:
        """Return the shapes that are this near to the middle of the knuckles."""
        knuckles = (state.R @ self._knuckles[1:, 0].mean(axis=0) + state.p)[None]
        return [shape for shape in shapes if float(shape.distance(knuckles)[0][0]) < reach_m]

    def corrected(self, state: HandState, hidden: BoolArray, shapes: Sequence[Shape], *, held: bool) -> HandState:
        """Return a state whose hidden fingers are not inside of what they may meet, and touch what the hand holds.

        An iterated extended Kalman update (Bell & Cathey 1993); what is particular of the person stays as it is.

        Args:
            state: of the hand.
            hidden: (5,) fingers that no camera sees.
            shapes: what they may meet, rig frame.
            held: whether the hand holds one of them.
        """
        fingers = np.flatnonzero(hidden)
        if not len(shapes) or not len(fingers) or state.dt_s <= 0.0:
            return state
        # No fingertip is further from the middle of the knuckles than twice a finger, and most things on a desk are.
        if not (shapes := self._within(2.0 * self._reach_m + _REACH_M, state, shapes)):
            return state
        touched = _CONTACT_M**2 * max(1.0, ERROR_LASTS_S / state.dt_s)
        P, at, dx, row = state.P, state, np.zeros(SIZE), np.arange(len(fingers))
        posterior = P
        for _ in range(_STEPS):
            flesh = self._flesh(at, fingers, shapes)
            gaps = flesh.gaps
            variances = np.where(gaps < 0.0, _CONTACT_M**2, np.inf)
            if held:
                last = 2 * _PER_BONE + np.argmin(gaps[:, 2 * _PER_BONE :], axis=1)
                nearest = gaps[row, last]
                reached = (nearest >= 0.0) & (nearest < _REACH_M)
                variances[row[reached], last[reached]] = touched
            told = np.isfinite(variances)
            if not told.any():
                break
            H = self._derivatives(at, fingers, flesh, told)
            innovation = H @ dx - gaps[told]
            PHt = P @ H.T
            gain = np.linalg.solve(H @ PHt + np.diag(variances[told]), PHt.T).T
            dx, posterior = gain @ innovation, P - gain @ PHt.T
            dx[PERSON] = 0.0
            at = self._filter.moved(state, dx)
        if at is state:
            return state
        posterior = 0.5 * (posterior + posterior.T)
        posterior[PERSON, PERSON] = P[PERSON, PERSON]
        return dataclasses.replace(
            state,
            R=at.R,
            p=at.p,
            angular_velocity=at.angular_velocity,
            velocity=at.velocity,
            angles=self._filter.clamp(at.angles),
            P=posterior,
        )

    def _flesh(self, state: HandState, fingers: IntArray, shapes: Sequence[Shape]) -> _Flesh:
        """Return how the flesh of F fingers lies to the nearest shape."""
        joints, by_finger = self._kinematics.chains(state.angles, state.longer)
        local = self._weights @ np.concatenate([self._knuckles, joints], axis=1)[fingers]
        far, out = _nearest(local.reshape(-1, 3) @ state.R.T + state.p, shapes)
        gaps = far.reshape(local.shape[:2]) - self._radii[fingers]
        return _Flesh(gaps, local, out.reshape(local.shape), by_finger[fingers, ..., :4].reshape(-1, 3, 12))

    def _derivatives(self, state: HandState, fingers: IntArray, flesh: _Flesh, told: BoolArray) -> FloatArray:
        """Return H (R, 43): how the R gaps that are `told` (F, 9) change with the errors of a state."""
        finger, place = told.nonzero()
        out, (x, y, z) = flesh.out[told], flesh.local[told].T
        normals = out @ state.R
        u, v, w = normals.T
        H = np.zeros((len(finger), SIZE))
        H[:, ROTATION] = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
        H[:, POSITION] = out
        by_angles = (self._weights[place, None, 1:] @ flesh.by_angles[finger]).reshape(-1, 3, 4)
        columns = ANGLES.start + 4 * fingers[finger, None] + np.arange(4)
        H[np.arange(len(finger))[:, None], columns] = (normals[:, None] @ by_angles)[:, 0]
        return H


@dataclass(frozen=True, slots=True)
class _Flesh:
    """Places along F fingers.

    Attributes:
        gaps: (F, 9) metres between the flesh there and the nearest shape, negative inside.
        local: (F, 9, 3) the places, metres, wrist frame.
        out: (F, 9, 3) the way out of that shape, rig frame.
        by_angles: (F, 3, 12) derivatives of both hinges and the tip: x, y, z by the finger's four angles each.
    """

    gaps: FloatArray
    local: FloatArray
    out: FloatArray
    by_angles: FloatArray


def _nearest(points: FloatArray, shapes: Sequence[Shape]) -> tuple[FloatArray, FloatArray]:
    """Return distances (N,) and ways out (N, 3) of points (N, 3) from the shape that is nearest to each."""
    far, out = shapes[0].distance(points)
    for shape in shapes[1:]:
        distance, way = shape.distance(points)
        nearer = distance < far
        far, out = np.where(nearer, distance, far), np.where(nearer[:, None], way, out)
    return far, out
