"""Taking touches from two live streams: the fingertip and the device, when both are held still to each other."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.messages import FacedShape
from rhot_calibration.objects.checks import LEAST_COVERED, covers, forget_old, held_pose
from rhot_calibration.objects.touch.checks import LARGEST_OFF_M, face_at
from rhot_calibration.objects.touch.faces import gaps, reach_m
from rhot_calibration.objects.touch.fit import OffsetFit, Touch
from rhot_objects.pose import Pose

# `registration.json` with the offset that touches told.


_TIP_STILL_M = 0.0015
"""Distance between the tip's mean places in the first, middle and last third. A finger that rests on something moves by
tenths of a millimetre, one that hovers drifts by centimetres a second. Of halves, two are alike where it turns back."""
_ELSEWHERE_M = 0.010
"""A touch nearer to an earlier one of its face is the same finger that has not left yet."""
_NEAR_M = 2.0 * LARGEST_OFF_M
"""Once the offset is known roughly, a finger that is held still further than this from the face does not touch it."""


@dataclass(frozen=True, slots=True)
class _Tip:
    t_ns: int
    position: FloatArray | None
    radius_m: float


@dataclass(frozen=True, slots=True)
class _Device:
    t_ns: int
    pose: Pose
    R: FloatArray


class TouchCollector:
    """Watches fingertip and device and takes a touch whenever both are still to each other at another place.

    Args:
        shape: of the object.
        plan: the faces to touch, in this order, each as often as it is named.
        eye_rig: (3,) amid the cameras, metres, rig frame; their depth is less sure than the rest. None = not known.

    Attributes:
        touches: taken so far.
        rough: the offset by these touches, where somebody has worked it out; see `checks.judged`.
    """

    def __init__(self, shape: FacedShape, plan: Sequence[str], eye_rig: FloatArray | None = None) -> None:
        self.shape = shape
        self.plan = tuple(plan)
        self.touches: list[Touch] = []
        self.rough: OffsetFit | None = None
        self._eye = eye_rig
        self._tips: deque[_Tip] = deque()
        self._devices: deque[_Device] = deque()
        self._why_no_tip = "the finger is not tracked"

    @property
    def done(self) -> bool:
        """Whether every touch of the plan is there."""
        return len(self.touches) >= len(self.plan)

    @property
    def asked(self) -> str:
        """What to touch now, in words."""
        if self.done:
            return "that is all"
        face = self.plan[len(self.touches)]
        number = 1 + sum(touch.face == face for touch in self.touches)
        return f"touch {face}, {number} of {self.plan.count(face)}"

    def add_tip(self, t_ns: int, tip_rig: FloatArray, radius_m: float) -> Touch | None:
        """Take a measured tip joint (3,), metres, rig frame, with the radius of its flesh."""
        self._tips.append(_Tip(t_ns, tip_rig, radius_m))
        return self._try()

    def add_no_tip(self, t_ns: int, why: str) -> None:
        """Note that the fingertip was not measured, and why."""
        self._tips.append(_Tip(t_ns, None, 0.0))
        self._why_no_tip = why
        forget_old(self._tips, self._devices)

    def add_device(self, t_ns: int, T_rig_device: Pose) -> Touch | None:
        """Take a measured pose of the device, rig frame."""
        self._devices.append(_Device(t_ns, T_rig_device, rotation_from_quaternion(T_rig_device.orientation_xyzw)))
        return self._try()

    def take_now(self) -> Touch | None:
        """Take the touch that is held now, wherever it is; None (and `hint` says why) where nothing is held still."""
        if self.done or self._trouble() or (touch := self._candidate()) is None:
            return None
        return self._taken(touch)

    def take_back(self) -> None:
        """Forget the last touch."""
        if self.touches:
            self.touches.pop()
            self.rough = None

    def start_over(self) -> None:
        """Forget everything: another session began."""
        self.touches.clear()
        self._tips.clear()
        self._devices.clear()
        self.rough = None

    @property
    def hint(self) -> str:
        """What the person should do now."""
        if self.done:
            return ""
        trouble = self._trouble()
        if trouble:
            return trouble
        touch = self._candidate()
        if touch is None:
            return f"{self.asked}: hold finger and object still"
        if not self._is_new(touch):
            return f"{self.asked}: another place, near a corner"
        return self._not_there(touch) or self.asked

    def _try(self) -> Touch | None:
        forget_old(self._tips, self._devices)
        if self.done or self._trouble():
            return None
        touch = self._candidate()
        if touch is None or not self._is_new(touch) or self._not_there(touch):
            return None
        return self._taken(touch)

    def _taken(self, touch: Touch) -> Touch:
        self.touches.append(touch)
        self._tips.clear()
        self._devices.clear()
        return touch

    def _trouble(self) -> str:
        """Return why no touch can be taken now; empty when one can."""
        measured = [tip for tip in self._tips if tip.position is not None]
        if len(measured) < LEAST_COVERED * len(self._tips):
            return self._why_no_tip
        if not covers(measured):
            return self.asked if measured else self._why_no_tip
        if not covers(self._devices):
            return "the tracking system does not see the object's tracker"
        if self._held_device() is None:
            return "the object moves: hold it still while you touch it"
        return ""

    def _held_device(self) -> tuple[FloatArray, FloatArray] | None:
        """Return position and rotation of the device, None while it moves."""
        p = np.array([device.pose.position for device in self._devices])
        return held_pose(p, np.array([device.R for device in self._devices]))

    def _candidate(self) -> Touch | None:
        """Return the touch that is held now; None where the finger moves."""
        tips = np.array([tip.position for tip in self._tips if tip.position is not None])
        thirds = np.array([part.mean(axis=0) for part in np.array_split(tips, 3)])
        if np.linalg.norm(thirds - np.roll(thirds, 1, axis=0), axis=1).max() > _TIP_STILL_M:
            return None
        held = self._held_device()
        if held is None:
            return None
        p, R = held
        radius_m = float(np.mean([tip.radius_m for tip in self._tips if tip.position is not None]))
        tip = np.median(tips, axis=0)
        view = (
            np.zeros(3) if self._eye is None else (tip - self._eye) / max(float(np.linalg.norm(tip - self._eye)), 1e-6)
        )
        return Touch(self.plan[len(self.touches)], (tip - p) @ R, radius_m, view @ R)

    def _is_new(self, touch: Touch) -> bool:
        return all(np.linalg.norm(touch.tip_device - other.tip_device) > _ELSEWHERE_M for other in self.touches)

    def _not_there(self, touch: Touch) -> str:
        """Return how a touch misses its face by what is known of the offset; empty where it does not."""
        fit = self.rough
        # A tracker sits on its object or beside it, not further away than this.
        if np.linalg.norm(touch.tip_device) > reach_m(self.shape) + 0.15:
            return f"{self.asked}: the finger is far from the object"
        if fit is None:
            return ""
        found = gaps(self.shape, touch.face, fit.in_object(touch.tip_device)[None])
        off_m = float(found.distance_m[0]) - touch.radius_m - fit.flesh_m
        if max(abs(off_m), float(found.beside_m.max())) < _NEAR_M:
            return ""
        other = face_at(self.shape, fit, touch)
        seems = f"that is {other}" if other else "the finger does not touch it"
        return f"{self.asked}: {seems} by the touches so far"
