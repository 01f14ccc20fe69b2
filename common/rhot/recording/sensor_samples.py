"""Samples of an ankle's sensor on the bus, from the feet service to who records them."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import Field, model_validator

from rhot.messages import Message, Quaternion, Side
from rhot.messages.base import TimeNs

SENSORS_KEY: Final = "rhot/@sensors"
"""The feet service publishes below this; see `rhot.recording.camera_picture.PICTURES_KEY` for the @."""
MOST_SAMPLES: Final = 1024
"""In one message; a second of a sensor of 1 kHz that was read late."""

_Finite = Annotated[float, Field(ge=-1e6, le=1e6)]
_Vector = tuple[_Finite, _Finite, _Finite]


class SensorSamples(Message):
    """Some samples of one ankle's inertial sensor, as the tracker uses them.

    Attributes:
        t_ns: of the first sample.
        side: which ankle.
        times_ns: of each sample, increasing, rig clock.
        specific_force: m/s², sensor frame; 9.81 upwards at rest.
        angular_rate: rad/s, sensor frame.
        orientation: unit quaternions x, y, z, w, sensor to a level world of the sensor's own with z up.
    """

    side: Side
    times_ns: Annotated[tuple[TimeNs, ...], Field(min_length=1, max_length=MOST_SAMPLES)]
    specific_force: Annotated[tuple[_Vector, ...], Field(max_length=MOST_SAMPLES)]
    angular_rate: Annotated[tuple[_Vector, ...], Field(max_length=MOST_SAMPLES)]
    orientation: Annotated[tuple[Quaternion, ...], Field(max_length=MOST_SAMPLES)]

    @model_validator(mode="after")
    def _together(self) -> SensorSamples:
        counts = {len(self.times_ns), len(self.specific_force), len(self.angular_rate), len(self.orientation)}
        if len(counts) > 1:
            raise ValueError("times_ns, specific_force, angular_rate and orientation differ in length")
        return self
