"""What goes wrong on purpose: trouser hems that slide over a marker, and false markers in the picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot_sim.walker.foot_path import SIDES
from rhot_sim.world.script import seeded

_STREAM: Final = 41
_HEM_SLOT_S: Final = 2.5
_FALSE_SLOT_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class Cover:
    """A foot whose marker is hidden for a while.

    Attributes:
        side: which foot.
        start_s, end_s: from when until when, seconds since the world's start.
    """

    side: Side
    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Disturbances:
    """What a world does to its pictures.

    Attributes:
        hems: trousers slide over a marker now and then, over part of it or all.
        false_markers: markers of the feet turn up where no foot is, or on the other foot.
        covers: markers that are hidden all the while.
    """

    hems: bool = True
    false_markers: bool = False
    covers: tuple[Cover, ...] = ()


@dataclass(frozen=True, slots=True)
class FalseMarker:
    """A marker that is not where its foot is.

    Attributes:
        side: the foot whose marker it pretends to be.
        T_rig_foot: (4, 4) where it lies on the floor; None for one that is stuck to the other foot.
        size_share: its size over that of the true one.
    """

    side: Side
    T_rig_foot: FloatArray | None
    size_share: float


class Mishaps:
    """The disturbances of one world, as a function of time.

    Args:
        seed: of the world.
        disturbances: which kinds there are.
    """

    def __init__(self, seed: int, disturbances: Disturbances) -> None:
        self._seed = seed
        self._kinds = disturbances

    def covered(self, side: Side, t_s: float) -> float:
        """Return the share of a foot's marker card, from the ankle on, that is hidden."""
        if any(cover.side == side and cover.start_s <= t_s < cover.end_s for cover in self._kinds.covers):
            return 1.0
        if not self._kinds.hems:
            return 0.0
        slot, into_s = divmod(t_s, _HEM_SLOT_S)
        rng = seeded(self._seed, _STREAM, 0, SIDES.index(side), max(int(slot), 0))
        hem_chance = 0.25
        if rng.random() >= hem_chance:
            return 0.0
        length_s = rng.uniform(0.3, 1.2)
        start_s = rng.uniform(0.0, _HEM_SLOT_S - length_s)
        share = rng.uniform(0.3, 1.3)
        return min(1.0, share) if start_s <= into_s < start_s + length_s else 0.0

    def false_marker(self, t_s: float, place_of: Callable[[Side, float], FloatArray]) -> FalseMarker | None:
        """Return the false marker of this moment, if there is one.

        Args:
            t_s: seconds since the world's start.
            place_of: gives the true pose (4, 4) of a foot at a time.
        """
        if not self._kinds.false_markers:
            return None
        slot, into_s = divmod(t_s, _FALSE_SLOT_S)
        rng = seeded(self._seed, _STREAM, 1, max(int(slot), 0))
        false_chance = 0.5
        if rng.random() >= false_chance:
            return None
        length_s = rng.uniform(0.02, 0.6)
        start_s = rng.uniform(0.0, _FALSE_SLOT_S - length_s)
        if not start_s <= into_s < start_s + length_s:
            return None
        side = SIDES[int(rng.integers(2))]
        if rng.random() < 0.3:
            return FalseMarker(side, None, 1.0)
        # A print of the same marker on the floor, near the foot at the time when it turns up.
        T = place_of(side, slot * _FALSE_SLOT_S + start_s)
        turn, reach, way = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.15, 0.8), rng.uniform(0.0, 2.0 * np.pi)
        lying = np.eye(4)
        c, s = np.cos(turn), np.sin(turn)
        lying[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
        lying[:3, 3] = T[0, 3] + reach * np.cos(way), 0.001, T[2, 3] + reach * np.sin(way)
        return FalseMarker(side, lying, 1.0 if rng.random() < 0.5 else rng.uniform(0.5, 1.6))
