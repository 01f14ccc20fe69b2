"""The paths that fingertips have left in the last moments."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot_viewer.scene.instances import Rgb

_STEP_NS: Final = 50_000_000
_BREAK_NS: Final = 400_000_000
"""After a longer pause the path starts over: a straight line would show a motion nobody saw."""


class Trails:
    """Newest positions of named points, thinned to one in 50 ms."""

    def __init__(self, names: Sequence[str], seconds: float) -> None:
        """Prepare trails.

        Args:
            names: of the points; the order of the lines.
            seconds: how far back the trails reach.
        """
        self._steps = max(2, round(seconds * 1e9 / _STEP_NS))
        self._paths: dict[str, deque[tuple[float, float, float]]] = {n: deque(maxlen=self._steps + 1) for n in names}
        self._newest_ns: dict[str, int] = {}

    def add(self, t_ns: int, positions: Mapping[str, tuple[float, float, float]]) -> bool:
        """Add positions, metres, of the moment `t_ns`, but for unknown names; return whether a line has changed."""
        changed = False
        for name, position in positions.items():
            trail = self._paths.get(name)
            if trail is None:
                continue
            pause_ns = t_ns - self._newest_ns.get(name, t_ns - _STEP_NS)
            if 0 <= pause_ns < _STEP_NS:
                continue
            if pause_ns > _BREAK_NS or pause_ns < 0:
                trail.clear()
            trail.append(position)
            self._newest_ns[name] = t_ns
            changed = True
        return changed

    def clear(self, prefix: str = "") -> None:
        """Forget the trails whose names begin with `prefix`."""
        for name, trail in self._paths.items():
            if name.startswith(prefix):
                trail.clear()
                self._newest_ns.pop(name, None)

    @property
    def lines(self) -> FloatArray:
        """(names · steps, 2, 3) pieces of all trails, newest first, metres; those that are not there have no length."""
        return np.concatenate([self._line(trail) for trail in self._paths.values()])

    def _line(self, trail: deque[tuple[float, float, float]]) -> FloatArray:
        pieces = np.zeros((self._steps, 2, 3))
        if trail:
            path = np.array(trail)[::-1]
            pieces[:] = path[-1]
            pieces[: len(path) - 1, 0], pieces[: len(path) - 1, 1] = path[:-1], path[1:]
        return pieces

    def colors(self, of: Mapping[str, Rgb], background: Rgb) -> NDArray[np.uint8]:
        """Return colours (names · steps, 2, 3) that fade into the background with age."""
        age = np.linspace(0.0, 1.0, self._steps + 1)
        ends = np.stack([age[:-1], age[1:]], axis=1)[..., None]
        faded = [np.array(of[name]) * (1.0 - ends) + np.array(background) * ends for name in self._paths]
        return np.concatenate(faded).astype(np.uint8)
