"""Errors of a tracked hand against the ground truth at the same time, in simulation."""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from typing import Final

import numpy as np

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.messages import HandPose, Truth

_KEPT: Final = 64
_MAX_GAP_NS: Final = 100_000_000
_TIPS: Final = tuple(f"{finger}_tip" for finger in FINGERS)


class TruthTrack:
    """The true fingertips of the last second, interpolated in time."""

    def __init__(self) -> None:
        self._samples: dict[str, deque[tuple[int, FloatArray]]] = {}

    def add(self, truth: Truth) -> None:
        """Add a sample of the ground truth; one that is not newer than the last is ignored."""
        for side, joints in truth.hands.items():
            samples = self._samples.setdefault(side, deque(maxlen=_KEPT))
            if samples and truth.t_ns <= samples[-1][0]:
                if truth.t_ns < samples[-1][0] - _MAX_GAP_NS:
                    samples.clear()  # another session's clock
                continue
            if all(tip in joints for tip in _TIPS):
                samples.append((truth.t_ns, np.array([joints[tip].position for tip in _TIPS])))

    def fingertip_errors(self, pose: HandPose) -> FloatArray | None:
        """Return the errors (5,) of a hand's fingertips at its time stamp, metres.

        None if the ground truth around that time is unknown, or a tip is missing.
        """
        if any(tip not in pose.joints for tip in _TIPS):
            return None
        true = self._tips_at(pose.side, pose.t_ns)
        if true is None:
            return None
        found = np.array([pose.joints[tip].position for tip in _TIPS])
        errors: FloatArray = np.linalg.norm(found - true, axis=1)
        return errors

    def _tips_at(self, side: str, t_ns: int) -> FloatArray | None:
        samples = self._samples.get(side, ())
        for (before_ns, before), (after_ns, after) in pairwise(samples):
            if before_ns <= t_ns <= after_ns and after_ns - before_ns <= _MAX_GAP_NS:
                share = (t_ns - before_ns) / (after_ns - before_ns)
                tips: FloatArray = (1.0 - share) * before + share * after
                return tips
        return None
