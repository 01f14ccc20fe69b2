"""Objects of a recording, with the same core as live."""

from __future__ import annotations

from collections.abc import Sequence

from rhot.core import Output
from rhot.rig import Rig
from rhot_objects.assemble import SourcePlan, recorded_sources


class PlayedObjects:
    """Reads sources as the service does, each at its rate.

    Args:
        plans: the sources, not yet open.
        start_ns: start time, rig clock; by default the first time passed to `until`.
    """

    def __init__(self, plans: Sequence[SourcePlan], start_ns: int | None = None) -> None:
        self._plans = plans
        self._start_ns = start_ns
        self._next_ns: list[int] = []

    def until(self, t_ns: int) -> list[Output]:
        """Return the messages up to a time; times must not decrease.

        Raises:
            ConfigError: a file cannot be read.
        """
        if not self._next_ns:
            start_ns = t_ns if self._start_ns is None else self._start_ns
            for plan in self._plans:
                plan.source.open(start_ns)
            self._next_ns = [start_ns] * len(self._plans)
        outputs: list[Output] = []
        for place, plan in enumerate(self._plans):
            while self._next_ns[place] <= t_ns:
                now_ns = self._next_ns[place]
                outputs += plan.core.feed(plan.source.read(now_ns), now_ns)
                self._next_ns[place] += round(1e9 / plan.rate_hz)
        return outputs


class RecordedObjects(PlayedObjects):
    """Reads the objects of a rig whose `source` is `recorded`.

    Args:
        rig: the loaded rig.
    """

    def __init__(self, rig: Rig) -> None:
        super().__init__(recorded_sources(rig))
