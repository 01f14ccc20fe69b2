"""Recorded objects beside a recording of cameras, with the core that runs live."""

from __future__ import annotations

from rhot.rig import Rig
from rhot.stage import Output
from rhot_objects.registration import Registration
from rhot_objects.sources.recorded import RecordedSource
from rhot_objects.stage import ObjectStage


class RecordedObjects:
    """Plays the objects of a rig whose `source` is `recorded`; as in a live session, they start with its first moment.

    Args:
        rig: whose objects.
    """

    def __init__(self, rig: Rig) -> None:
        registration = Registration.from_file(rig.registration_of("recorded"))
        configs = {name: config for name, config in rig.config.objects.items() if config.source == "recorded"}
        shapes = {name: config.shape for name, config in configs.items() if config.shape is not None}
        self._players = [
            (
                RecordedSource(name, rig.resolve(config.path or ""), loop=config.loop),
                ObjectStage(registration, shapes=shapes),
                round(1e9 / config.rate_hz),
            )
            for name, config in configs.items()
        ]
        self._next_ns: list[int] = []

    def until(self, t_ns: int) -> list[Output]:
        """Return what was published up to a time; times do not go back.

        Raises:
            ConfigError: a file cannot be read.
        """
        if not self._next_ns:
            for source, _, _ in self._players:
                source.open(t_ns)
            self._next_ns = [t_ns] * len(self._players)
        outputs: list[Output] = []
        for place, (source, stage, period_ns) in enumerate(self._players):
            while self._next_ns[place] <= t_ns:
                now_ns = self._next_ns[place]
                outputs += stage.feed(source.read(now_ns), now_ns)
                self._next_ns[place] += period_ns
        return outputs
