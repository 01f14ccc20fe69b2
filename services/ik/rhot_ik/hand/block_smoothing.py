"""Smoothing of a recording in blocks, so that memory does not grow with its length."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from rhot.messages import PointSet, Side
from rhot_ik.hand.solver import HandSolver
from rhot_ik.hand.track import HandSolution, HandTrack

Settled = list[tuple[PointSet, dict[Side, HandSolution]]]

AHEAD_NS: Final = 5_000_000_000
"""A sample says next to nothing of a hand so long before: angles keep for `HandSettings.angles_s`, 2 s."""
PIECE_NS: Final = 5_000_000_000
"""So much is smoothed at once; with what is ahead of it, 10 s of tracks are kept, some 40 MB at 120 points a second."""


class BlockSmoother:
    """Keeps the newest samples of all hands, and gives them back with what later ones said of them.

    Args:
        solvers: those that made the tracks.
        ahead_ns: a sample is settled when those of so long after it are known.
        piece_ns: so much is smoothed at once.
    """

    def __init__(
        self, solvers: Mapping[Side, HandSolver], *, ahead_ns: int = AHEAD_NS, piece_ns: int = PIECE_NS
    ) -> None:
        self._solvers = solvers
        self._ahead_ns, self._piece_ns = ahead_ns, piece_ns
        self._kept: list[tuple[PointSet, Mapping[Side, HandTrack]]] = []

    def add(self, points: PointSet, tracks: Mapping[Side, HandTrack]) -> Settled:
        """Take one sample with what each hand's solver made of it, and return those that are settled by now."""
        self._kept.append((points, tracks))
        if points.t_ns - self._kept[0][0].t_ns < self._ahead_ns + self._piece_ns:
            return []
        return self._settled(points.t_ns - self._ahead_ns)

    def finish(self) -> Settled:
        """Return all that is left; nothing comes after it."""
        return self._settled(self._kept[-1][0].t_ns) if self._kept else []

    def _settled(self, until_ns: int) -> Settled:
        solutions: list[dict[Side, HandSolution]] = [{} for _ in self._kept]
        for side, solver in self._solvers.items():
            places = [place for place, (_, tracks) in enumerate(self._kept) if side in tracks]
            smoothed = solver.smoothed([self._kept[place][1][side] for place in places])
            for place, solution in zip(places, smoothed, strict=True):
                solutions[place][side] = solution
        ready = sum(points.t_ns <= until_ns for points, _ in self._kept)
        settled = [(points, found) for (points, _), found in zip(self._kept[:ready], solutions, strict=False)]
        del self._kept[:ready]
        return settled
