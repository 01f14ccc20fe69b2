"""LSL (Lab Streaming Layer): a stream of type `MoCap` for each hand, body, foot, object and the headset.

Every sample that the rig publishes goes out once, at the moment at which it was true: its rig time, mapped to LSL's
`local_clock()` (`rhot_bridge.clock_map`), never the time of sending. So a recording lines up with EEG, gaze or force
plates whatever the tracker's latency is.

Channels: see `rhot_bridge.targets.mocap_channels`. The rate is irregular.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from collections.abc import Sequence
from typing import Any, Final

from rhot.clock import RigClock
from rhot.errors import ConfigError
from rhot.rig import BridgeConfig
from rhot_bridge.clock_map import ClockMap
from rhot_bridge.scene import Axes, Scene, Tracked
from rhot_bridge.targets.mocap_channels import channels_of, joints_of, sample_of

try:
    import pylsl
except RuntimeError as error:
    raise ConfigError(
        "LSL's library (liblsl) is not on this machine; pylsl brings it for x86-64. Elsewhere install liblsl from your "
        f"distribution or from its release page: {str(error).splitlines()[0][:120]}"
    ) from error

logger = logging.getLogger(__name__)

MOST_STREAMS: Final = 64
"""Things that one bridge sends; a rig has about ten. Names are an outsider's choice: beyond it a stream that is silent
makes room."""
_SILENT_NS: Final = 5_000_000_000
_FIRST_READINGS: Final = 5
_BUFFERED: Final = 60
"""Hundreds of samples that are kept for a recorder which stalls: a minute at 100 Hz, 4 MB for a hand."""


class LslOutput:
    """Streams of this machine; see `rhot_bridge.output.SampleOutput`."""

    leads: Sequence[str] = ()
    problem = ""

    def __init__(self, config: BridgeConfig) -> None:
        """Prepare; of the configuration, axes and what is predicted count."""
        self.axes: Axes = config.axes
        self._predicted = config.predicted == "send"
        self._clock: RigClock | None = None
        self._map = ClockMap()
        self._outlets: dict[str, Any] = {}
        self._opening: dict[str, asyncio.Task[None]] = {}
        self._sent_ns: dict[str, int] = {}
        self._heard_ns: dict[str, int] = {}

    @property
    def where(self) -> str:
        """Who finds the streams."""
        return "LSL streams of type MoCap, for whom LSL's own configuration (lsl_api.cfg) lets find them"

    def use_clock(self, clock: RigClock) -> None:
        """Take times from a rig clock."""
        self._clock = clock

    async def open(self) -> None:
        """Nothing: streams appear with their first samples."""

    def wanted(self, now_ns: int) -> bool:
        """Return that no scenes are: every sample goes out by itself."""
        return False

    def send(self, scene: Scene, now_ns: int) -> tuple[int, int]:
        """Send nothing."""
        return 0, 0

    def take(self, key: str, tracked: Tracked) -> bool:
        """Send a sample in the wanted axes; return whether it went out."""
        if tracked.state == "predicted" and not self._predicted:
            return False
        name = key.removeprefix("rhot/").replace("/", "_")
        # Taken out and put back, so that the first is the one that has been silent longest.
        outlet = self._outlets.pop(name, None)
        if outlet is None:
            self._offer(name, joints_of(name, tracked))
            return False
        self._outlets[name], self._heard_ns[name] = outlet, time.monotonic_ns()
        # Not "later than": the rig clock may be set back.
        if tracked.t_ns == self._sent_ns.get(name) or not self._read_clocks():
            return False
        self._sent_ns[name] = tracked.t_ns
        outlet.push_sample(sample_of(tracked).tolist(), self._map.to_local_ns(tracked.t_ns) / 1e9)
        return True

    def _read_clocks(self) -> bool:
        clock = self._clock
        if clock is None or not clock.ready:
            return False
        # The first reading counts whole: the shortest of several, so that no interruption lies within it.
        readings = [_read(clock) for _ in range(1 if self._map.ready else _FIRST_READINGS)]
        rig_ns, before_ns, after_ns = min(readings, key=lambda reading: reading[2] - reading[1])
        self._map.read(rig_ns, before_ns, after_ns)
        return True

    def _offer(self, name: str, joints: tuple[str, ...]) -> None:
        """Make a stream, on a thread of its own: opening its ports takes some milliseconds."""
        if name in self._opening or not self._make_room():
            return

        async def offer() -> None:
            self._outlets[name] = await asyncio.to_thread(_outlet, name, joints, self.axes)
            self._heard_ns[name] = time.monotonic_ns()
            del self._opening[name]
            logger.info("LSL stream %s is there, %d channels", name, 7 * len(joints) + 1)

        self._opening[name] = asyncio.create_task(offer())

    def _make_room(self) -> bool:
        """Return whether there is room for another stream, perhaps in place of one that is silent."""
        if len(self._outlets) + len(self._opening) < MOST_STREAMS:
            return True
        silent = next(iter(self._outlets), None)
        if silent is None or time.monotonic_ns() - self._heard_ns[silent] < _SILENT_NS:
            return False
        del self._heard_ns[silent]
        self._sent_ns.pop(silent, None)
        # The last reference ends a stream, which takes a moment.
        asyncio.get_running_loop().run_in_executor(None, [self._outlets.pop(silent)].clear)
        return True

    async def close(self) -> None:
        """Close all streams."""
        for task in self._opening.values():
            task.cancel()
        await asyncio.gather(*self._opening.values(), return_exceptions=True)
        outlets = list(self._outlets.values())
        self._opening.clear()
        self._outlets.clear()
        self._sent_ns.clear()
        self._heard_ns.clear()
        # The last reference ends a stream, which takes a moment.
        await asyncio.to_thread(outlets.clear)


def _read(clock: RigClock) -> tuple[int, int, int]:
    """Return a reading of the rig clock, and of LSL's before and after it, nanoseconds."""
    before_s, rig_ns, after_s = pylsl.local_clock(), clock.now_ns(), pylsl.local_clock()
    return rig_ns, round(1e9 * before_s), round(1e9 * after_s)


def make_output(config: BridgeConfig) -> LslOutput:
    """Return the output that a configuration asks for."""
    return LslOutput(config)


def _outlet(name: str, joints: Sequence[str], axes: Axes) -> Any:
    channels = channels_of(name, joints)
    info = pylsl.StreamInfo(
        f"rhot_{name}",
        "MoCap",
        len(channels),
        pylsl.IRREGULAR_RATE,
        pylsl.cf_float32,
        # The same after a restart, so that recorders find the stream again.
        f"rhot_{socket.gethostname()}_{name}",
    )
    described = info.desc().append_child("channels")
    for channel in channels:
        one = described.append_child("channel")
        for field in ("label", "marker", "object", "type", "unit"):
            one.append_child_value(field, getattr(channel, field))
    info.desc().append_child("setup").append_child_value("frame", axes)
    info.desc().append_child("acquisition").append_child_value("manufacturer", "RHOT")
    return pylsl.StreamOutlet(info, max_buffered=_BUFFERED)
