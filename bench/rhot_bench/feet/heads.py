"""The headset's poses in the simulated runs of the foot tracker."""

from __future__ import annotations

from functools import partial
from typing import Final

import numpy as np

from rhot.messages import HeadPose
from rhot_objects.core import ObjectCore
from rhot_objects.pose import Pose, Registration
from rhot_objects.sources import HEAD
from rhot_sim.sources.objects import SimulatedSource
from rhot_sim.walker.world import WalkerWorld

START_NS: Final = 1_700_000_000_000_000_000
"""When every run begins."""
HEAD_HZ: Final = 90.0
HEAD_LATE_S: Final = 0.002


class Heads:
    """The headset's poses as the objects service publishes them."""

    def __init__(self, world: WalkerWorld, seed: int) -> None:
        registration = Registration(Pose.from_matrix(np.eye(4)), {})
        self._source = SimulatedSource(partial(_head, world), registration, frozenset({HEAD}), seed)
        self._source.open(START_NS)
        self._stage = ObjectCore(registration)
        self._next = 0

    def until(self, now_s: float) -> list[HeadPose]:
        """Return those that arrived by now and were not returned before."""
        poses = []
        while (at_s := self._next / HEAD_HZ) + HEAD_LATE_S <= now_s:
            at_ns = START_NS + round(1e9 * at_s)
            outputs = self._stage.feed(self._source.read(at_ns), at_ns)
            poses += [message for _, message in outputs if isinstance(message, HeadPose)]
            self._next += 1
        return poses


def _head(world: WalkerWorld, t_s: float) -> dict[str, Pose]:
    return {HEAD: Pose.from_matrix(world.head(np.array([t_s]))[0])}
