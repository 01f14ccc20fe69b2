"""Out-of-sequence measurements: each enters a filter at its own time, and what came after it is replayed.

A picture says where the foot *was*, tens of milliseconds ago, when the sensor on the ankle has reported several times
since. So the states of the last `horizon_ns` are kept with the measurement that led to each. A late measurement goes
where it belongs and only what came after it is computed again: three or four samples for a camera 30 ms late. What is
older than the horizon is not kept, so memory and work are bounded.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import Generic, TypeVar

from rhot_feet.filter.model import FootModel, Observation
from rhot_feet.filter.zero_velocity_update import zero_velocity_update
from rhot_feet.imu.track import ImuInterval

State = TypeVar("State")


@dataclass(slots=True)
class _Entry(Generic[State]):
    t_ns: int
    measurement: ImuInterval | Observation | None
    state: State
    refused_s: float = 0.0
    """For how long zero-velocity updates have been refused; see `zero_velocity_update`."""


class StateHistory(Generic[State]):
    """The last states of a filter.

    Args:
        model: the filter.
        t_ns: of the first state.
        state: the first state.
        horizon_ns: how late a measurement may be.
    """

    def __init__(self, model: FootModel[State], t_ns: int, state: State, horizon_ns: int) -> None:
        self._model = model
        self._horizon_ns = horizon_ns
        self._entries: list[_Entry[State]] = [_Entry(t_ns, None, state)]
        self._seen_ns = t_ns

    @property
    def start_ns(self) -> int:
        """The oldest moment that is kept; older measurements cannot be added."""
        return self._entries[0].t_ns

    @property
    def newest_ns(self) -> int:
        """The newest moment that is kept."""
        return self._entries[-1].t_ns

    def add(self, measurement: ImuInterval | Observation) -> None:
        """Add a measurement that is not older than `start_ns`, and replay what came after it."""
        index = bisect_right(self._entries, measurement.t_ns, key=_time)
        self._entries.insert(index, _Entry(measurement.t_ns, measurement, self._entries[0].state))
        if isinstance(measurement, Observation):
            self._seen_ns = max(self._seen_ns, measurement.t_ns)
        for k in range(index, len(self._entries)):
            entry = self._entries[k]
            refused_s = self._entries[k - 1].refused_s
            entry.state, entry.refused_s = self._updated(self._predicted(k, entry.t_ns), refused_s, entry.measurement)
        oldest = bisect_right(self._entries, self.newest_ns - self._horizon_ns, key=_time) - 1
        if oldest > 0:
            del self._entries[:oldest]

    def at(self, t_ns: int) -> State:
        """Return the state at a moment: kept, in between, or predicted from the newest."""
        return self._predicted(max(bisect_right(self._entries, t_ns, key=_time), 1), t_ns)

    def _predicted(self, index: int, t_ns: int) -> State:
        """Return the state at a time between the entries `index` − 1 and `index`, from the former."""
        before = self._entries[index - 1]
        if t_ns <= before.t_ns:
            return before.state
        interval = self._interval_at(index)
        step = None if interval is None else interval.between(before.t_ns, t_ns)
        return self._model.predict(before.state, (t_ns - before.t_ns) * 1e-9, step)

    def _interval_at(self, index: int) -> ImuInterval | None:
        """Return the first IMU interval from an entry on or, when there is none, the last before it."""
        for entries in (self._entries[index:], reversed(self._entries[:index])):
            for entry in entries:
                if isinstance(entry.measurement, ImuInterval):
                    return entry.measurement
        return None

    def _updated(
        self, state: State, refused_s: float, measurement: ImuInterval | Observation | None
    ) -> tuple[State, float]:
        if measurement is None:
            return state, refused_s
        if isinstance(measurement, Observation):
            return self._model.update(state, measurement), refused_s
        return zero_velocity_update(
            self._model,
            state,
            measurement.zero_velocity,
            measurement.rate,
            measurement.step.duration_s,
            refused_s,
            # Time after an observation for which a foot counts as seen.
            seen=measurement.t_ns - self._seen_ns < 300_000_000,
        )


def _time(entry: _Entry[State]) -> int:
    return entry.t_ns
