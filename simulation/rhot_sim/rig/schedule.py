"""When a simulated camera's frames are exposed and delivered, which ones are lost, and how wrong its clock is.

Everything follows from (seed, camera name, frame number), so a camera that starts late or again continues the same
schedule. Times are seconds since the world's start, true time.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

from rhot.clock import SkewedClock
from rhot.rig.config import CameraConfig, SimConfig

_STEPS = float(1 << 32)


@dataclass(frozen=True, slots=True)
class ScheduledFrame:
    """One frame.

    Attributes:
        index: frame number, from 0; lost frames count.
        t_first_row_s: start of the first row's exposure.
        delivered_s: when the picture is there: after the last row's read-out and the delivery's jitter.
        dropped: whether it is lost before anybody sees it.
    """

    index: int
    t_first_row_s: float
    delivered_s: float
    dropped: bool


@dataclass(frozen=True, slots=True)
class ClockError:
    """How a camera node's clock goes wrong.

    Attributes:
        offset_ns: node minus true, at the start.
        drift_ppm: how much faster than true it runs, parts per million.
    """

    offset_ns: int
    drift_ppm: float


class FrameSchedule:
    """The frames of one simulated camera.

    Args:
        camera: name.
        index: its number in the rig; camera k is k · `phase_s` behind the first.
        camera_config: rate, exposure and read-out.
        config: phase, jitter and loss.
    """

    def __init__(self, camera: str, index: int, camera_config: CameraConfig, config: SimConfig) -> None:
        self._key = f"{config.seed} {camera}"
        self._rate_hz = camera_config.rate_hz
        self._phase_s = math.fmod(index * config.phase_s, 1.0 / camera_config.rate_hz)
        self._busy_s = camera_config.exposure_s + camera_config.readout_s
        self._jitter_s = config.jitter_s
        self._drop_rate = config.drop_rate

    def frame(self, index: int) -> ScheduledFrame:
        """Return a frame by its number."""
        start = self._phase_s + index / self._rate_hz
        lost, u1, u2 = uniforms(f"{self._key} frame {index}")
        # Jitter only ever delays: the magnitude of a normal variable (Box and Muller 1958).
        normal = math.sqrt(-2.0 * math.log(1.0 - u1)) * math.cos(2.0 * math.pi * u2)
        delivered = start + self._busy_s + self._jitter_s * abs(normal)
        return ScheduledFrame(index, start, delivered, lost < self._drop_rate)

    def first_after(self, t_s: float) -> int:
        """Return the number of the first frame whose exposure does not start before `t_s`."""
        index = math.ceil((t_s - self._phase_s) * self._rate_hz - 1e-9)
        return max(0, index)


def clock_error(camera: str, config: SimConfig) -> ClockError:
    """Return the error of a camera node's clock, evenly drawn within the bounds of the configuration."""
    offset, drift, _ = uniforms(f"{config.seed} {camera} clock")
    return ClockError(
        offset_ns=round((2.0 * offset - 1.0) * config.clock_offset_s * 1e9),
        drift_ppm=(2.0 * drift - 1.0) * config.clock_drift_ppm,
    )


def uniforms(key: str) -> tuple[float, float, float]:
    """Return three independent numbers in [0, 1) that belong to a key, the same in every process."""
    digest = hashlib.blake2b(key.encode(), digest_size=12).digest()
    first, second, third = (int.from_bytes(digest[at : at + 4], "big") / _STEPS for at in (0, 4, 8))
    return first, second, third


def node_clock_of(config: SimConfig, camera: str) -> SkewedClock:
    """Return the clock of a simulated camera's node: wrong on purpose, by an amount that follows from seed and name."""
    error = clock_error(camera, config)
    return SkewedClock(error.offset_ns, error.drift_ppm)
