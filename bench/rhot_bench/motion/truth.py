"""What was true of one rig before one clip: markers, joints, and what each camera could see, at any time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray, IntArray
from rhot_bench.motion.hand_motion import HandMotion, HandShape
from rhot_bench.motion.painted import Surface

MARKERS: Final = (*FINGERS, "base")
START_NS: Final = 1_000_000_000_000
"""Rig time at which every clip starts."""
WELL_SEEN: Final = 0.25
"""A camera counts as seeing a marker when this share of its facing paint is unhidden, as in `score.py`."""


@dataclass(frozen=True, slots=True)
class Truth:
    """What was true.

    Attributes:
        motion: the hand at any time.
        surfaces: painted surface of each marker of `MARKERS`, in a frame at the very tip or in the wrist frame.
        frame_t_ns: per camera (F,) mid-exposure of the middle row of every frame, lost ones included.
        visible: per camera (F, 6) whether the marker was a blob in that frame, lost ones included.
        whole: per camera (F, 6) share of the paint facing the camera that nothing hides.
    """

    motion: HandMotion
    surfaces: Sequence[Surface]
    frame_t_ns: tuple[IntArray, ...]
    visible: tuple[NDArray[np.bool_], ...]
    whole: tuple[FloatArray, ...]

    def seconds(self, t_ns: IntArray) -> FloatArray:
        """Return times (N,) as seconds of the clip."""
        return np.asarray(t_ns - START_NS, dtype=np.float64) * 1e-9

    def hand(self, t_ns: IntArray) -> HandShape:
        """Return the hand at times (N,)."""
        return self.motion.at(self.seconds(t_ns))

    def joints(self, t_ns: IntArray) -> FloatArray:
        """Return the 26 joints (N, 26, 3) of OpenXR at times (N,), metres, rig frame."""
        return self.hand(t_ns).joints

    def markers(self, t_ns: IntArray) -> FloatArray:
        """Return the middles (N, 6, 3) of paint and patch at times (N,), metres, rig frame."""
        hand = self.hand(t_ns)
        frames = [marker_frames_of(hand, number) for number in range(len(MARKERS))]
        markers: FloatArray = np.stack(
            [origin + R @ self.surfaces[k].centre for k, (origin, R) in enumerate(frames)], axis=1
        )
        return markers

    def bone_axes(self, t_ns: IntArray) -> FloatArray:
        """Return unit directions (N, 6, 3): of each outermost bone, for the patch from the wrist to the fingers."""
        hand = self.hand(t_ns)
        return np.stack([-marker_frames_of(hand, number)[1][:, :, 2] for number in range(len(MARKERS))], axis=1)

    def views(self, t_ns: IntArray, least: float = WELL_SEEN) -> IntArray:
        """Return how many cameras see each marker (N, 6) at times (N,): in the frame nearest in time, lost or not.

        Args:
            t_ns: times.
            least: share of the facing paint that must be unhidden; 0 = any blob counts.
        """
        count = np.zeros((len(t_ns), len(MARKERS)), dtype=np.int64)
        for times, visible, whole in zip(self.frame_t_ns, self.visible, self.whole, strict=True):
            nearest = _nearest(times, t_ns)
            count += visible[nearest] & (whole[nearest] >= least)
        return count

    def hidden_s(self, t_ns: IntArray) -> FloatArray:
        """Return for how long each marker (N, 6) has been hidden from all cameras.

        0 while a camera sees any of it, NaN before it was first seen.
        """
        hidden = np.full((len(t_ns), len(MARKERS)), np.nan)
        for marker in range(len(MARKERS)):
            last = np.sort(
                np.concatenate([t[v[:, marker]] for t, v in zip(self.frame_t_ns, self.visible, strict=True)])
            )
            if not len(last):
                continue
            place = np.searchsorted(last, t_ns, side="right") - 1
            after = (t_ns - last[np.maximum(place, 0)]) * 1e-9
            hidden[:, marker] = np.where(place >= 0, after, np.nan)
        return np.where(self.views(t_ns, 0.0) > 0, 0.0, hidden)


def marker_frames_of(hand: HandShape, number: int) -> tuple[FloatArray, FloatArray]:
    """Return origins (N, 3) and axes (N, 3, 3) of a marker's own frame: at the very tip, or the wrist frame."""
    if number == len(FINGERS):
        return hand.wrist, hand.R
    tip = hand.chain[:, number, 3]
    Z = hand.chain[:, number, 2] - tip
    Z /= np.linalg.norm(Z, axis=1, keepdims=True)
    X = hand.R[:, :, 0] - Z * (hand.R[:, :, 0] * Z).sum(axis=1, keepdims=True)
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    return tip, np.stack([X, np.cross(Z, X), Z], axis=-1)


def _nearest(times: IntArray, wanted: IntArray) -> IntArray:
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    nearer = wanted - times[after - 1] < times[np.minimum(after, len(times) - 1)] - wanted
    found: IntArray = np.where(nearer, after - 1, np.minimum(after, len(times) - 1))
    return found
