"""Measurements put in at their own times: the last moments of a filter, to be gone through again.

A picture says where the foot *was*, tens of milliseconds ago, when the sensor on the ankle has reported several times
since. So the filter keeps its states of the last `horizon_ns` with what led to each. A late measurement is put where it
belongs and only what came after it is gone through again: three or four samples for a camera 30 ms late. What is older
than the horizon is not kept, so memory and work are bounded.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from rhot_feet.filter.model import FootModel, Observation
from rhot_feet.imu.strapdown import InertialStep
from rhot_feet.imu.zero_velocity import Rest

FloatArray = NDArray[np.float64]
State = TypeVar("State")

SAMPLE_S: Final = 0.005
"""The spacing of samples that `Rest.speed_sigma` is meant for."""
_HELD_NS: Final = 30_000_000
_REST_GATE: Final = 25.0
"""Squared normalised innovation up to which a stand-still is believed while the foot is seen."""
_SEEN_NS: Final = 300_000_000


@dataclass(frozen=True, slots=True)
class Felt:
    """One sample of the sensor.

    Attributes:
        t_ns: of the sample.
        start_ns: of the sample before.
        step: what was felt in between.
        rate: (3,) rad/s in between.
        rest: what it says about standing still.
        R_world: (3, 3) from the sensor to its own level world.
    """

    t_ns: int
    start_ns: int
    step: InertialStep
    rate: FloatArray
    rest: Rest
    R_world: FloatArray

    def between(self, from_ns: int, to_ns: int) -> InertialStep | None:
        """Return what was felt between two moments; it is held for a while after the sample, then nothing is known."""
        if from_ns < self.start_ns or to_ns > self.t_ns + _HELD_NS:
            return None
        if to_ns <= self.t_ns:
            return self.step.part((from_ns - self.start_ns) * 1e-9, (to_ns - self.start_ns) * 1e-9)
        h = (to_ns - from_ns) * 1e-9
        return InertialStep(h, self.step.force_after, self.step.force_after, h * self.rate)


@dataclass(slots=True)
class _Moment(Generic[State]):
    t_ns: int
    cause: Felt | Observation | None
    state: State


class History(Generic[State]):
    """A filter's last moments."""

    def __init__(self, model: FootModel[State], t_ns: int, state: State, horizon_ns: int) -> None:
        """Begin.

        Args:
            model: the filter.
            t_ns: of the first state.
            state: the first state.
            horizon_ns: how late a measurement may be.
        """
        self._model = model
        self._horizon_ns = horizon_ns
        self._moments: list[_Moment[State]] = [_Moment(t_ns, None, state)]
        self._seen_ns = t_ns

    @property
    def start_ns(self) -> int:
        """The oldest moment that is kept; what is older cannot be put in."""
        return self._moments[0].t_ns

    @property
    def newest_ns(self) -> int:
        """The newest moment that is kept."""
        return self._moments[-1].t_ns

    def add(self, cause: Felt | Observation) -> None:
        """Put in a measurement that is not older than `start_ns`, and go again through what came after it."""
        index = bisect_right(self._moments, cause.t_ns, key=_time)
        self._moments.insert(index, _Moment(cause.t_ns, cause, self._moments[0].state))
        if isinstance(cause, Observation):
            self._seen_ns = max(self._seen_ns, cause.t_ns)
        for k in range(index, len(self._moments)):
            moment = self._moments[k]
            moment.state = self._caused(self._predicted(k, moment.t_ns), moment.cause)
        oldest = bisect_right(self._moments, self.newest_ns - self._horizon_ns, key=_time) - 1
        if oldest > 0:
            del self._moments[:oldest]

    def at(self, t_ns: int) -> State:
        """Return the state at a moment: kept, in between, or predicted from the newest."""
        return self._predicted(max(bisect_right(self._moments, t_ns, key=_time), 1), t_ns)

    def _predicted(self, index: int, t_ns: int) -> State:
        """Return the state at a time between the moments `index` − 1 and `index`, from the former."""
        before = self._moments[index - 1]
        if t_ns <= before.t_ns:
            return before.state
        felt = self._felt(index)
        step = None if felt is None else felt.between(before.t_ns, t_ns)
        return self._model.predict(before.state, (t_ns - before.t_ns) * 1e-9, step)

    def _felt(self, index: int) -> Felt | None:
        """Return the first sample from a moment on or, when there is none, the last before it."""
        for moment in self._moments[index:]:
            if isinstance(moment.cause, Felt):
                return moment.cause
        for moment in reversed(self._moments[:index]):
            if isinstance(moment.cause, Felt):
                return moment.cause
        return None

    def _caused(self, state: State, cause: Felt | Observation | None) -> State:
        if isinstance(cause, Observation):
            return self._model.observe(state, cause)
        if cause is None or cause.rest.speed_sigma is None:
            return state
        sigma = cause.rest.speed_sigma * (SAMPLE_S / cause.step.duration_s) ** 0.5
        gate = _REST_GATE if cause.t_ns - self._seen_ns < _SEEN_NS else None
        state = self._model.rest(state, sigma, gate)
        if cause.rest.rate is not None:
            state = self._model.rest_turning(state, cause.rest.rate, cause.step.duration_s)
        return state


def _time(moment: _Moment[State]) -> int:
    return moment.t_ns
