"""LSL (Lab Streaming Layer): a stream of type `MoCap` for each hand, body, foot, object and the headset.

Marked moments (`rhot/event`) are a stream of type `Markers`, `rhot_event`, there from the beginning, so that a recorder
finds it before the first.

Every published sample is sent once, with its own time: the rig time, mapped to LSL's `local_clock()`
(`rhot_bridge.clock_map`), never the time of sending. So a recording is synchronous with EEG, gaze or force plates,
whatever the tracker's latency is.

Channels: see `rhot_bridge.targets.lsl`. The rate is irregular.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import BODY_PARENTS, JOINTS
from rhot.clock import RigClock
from rhot.errors import ConfigError
from rhot.messages import Event
from rhot.rig import BridgeConfig
from rhot_bridge.clock_map import ClockMap
from rhot_bridge.output import Opened
from rhot_bridge.scene import Axes, Body, BridgedHand, Scene, Tracked

# The channels of a MoCap stream.
#
# By the meta-data specification of MoCap streams (sccn/xdf wiki), float32: for each joint PositionX, Y, Z (metres) and
# OrientationA, B, C, D (quaternion w, x, y, z), then one Confidence: 1 measured, 0 predicted. The channels of a stream
# never change: unknown joints of a body are NaN.

_POSITION: Final = ("PositionX", "PositionY", "PositionZ")
_ORIENTATION: Final = ("OrientationA", "OrientationB", "OrientationC", "OrientationD")


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of a stream; fields as in the MoCap specification."""

    label: str
    marker: str
    object: str
    type: str
    unit: str


def channels_of(name: str, joints: Sequence[str]) -> list[Channel]:
    """Return the channels of a stream: position and orientation of each joint, then the confidence.

    Args:
        name: of the stream, such as `hand_right`.
        joints: names of its joints; for a rigid body, its own name.
    """
    channels = []
    for joint in joints:
        for kinds, unit in ((_POSITION, "meters"), (_ORIENTATION, "quaternion")):
            channels += [Channel(f"{joint}_{kind}", joint, name, kind, unit) for kind in kinds]
    return [*channels, Channel("Confidence", "", name, "Confidence", "normalized")]


def sample_of(tracked: Tracked) -> NDArray[np.float32]:
    """Return the values of a sample, float32, in the order of its channels."""
    wxyz = tracked.orientations[:, [3, 0, 1, 2]]
    joints = np.concatenate([tracked.positions, wxyz], axis=1)
    if isinstance(tracked, Body):
        rows = dict(zip(tracked.names, joints, strict=True))
        unknown = np.full(joints.shape[1], np.nan)
        joints = np.array([rows.get(name, unknown) for name in BODY_PARENTS])
    confidence = 1.0 if tracked.state == "measured" else 0.0
    return np.append(joints.ravel(), confidence).astype(np.float32)


def joints_of(name: str, tracked: Tracked) -> tuple[str, ...]:
    """Return the names of all joints that a sample may have; for a rigid body, its own name."""
    if isinstance(tracked, BridgedHand):
        return JOINTS
    return tuple(BODY_PARENTS) if isinstance(tracked, Body) else (name,)


try:
    import pylsl
except RuntimeError as error:
    raise ConfigError(
        "LSL's library (liblsl) is not on this machine; pylsl brings it for x86-64. Elsewhere install liblsl from your "
        f"distribution or from its release page: {str(error).splitlines()[0][:120]}"
    ) from error

logger = logging.getLogger(__name__)

EVENTS: Final = "rhot_event"
"""The stream of marked moments."""
MOST_STREAMS: Final = 64
"""Largest number of streams; a rig has about ten."""
_RETRY_S: Final = 5.0
"""Pause before a stream that could not be opened is opened again; chosen."""


@dataclass(slots=True)
class _Stream:
    """One stream, and the time of the last sample sent."""

    outlet: Any
    sent_ns: int | None = None


class LslOutput:
    """The streams of this process; see `rhot_bridge.output.SampleOutput`."""

    triggers: Sequence[str] = ()
    problem = ""

    def __init__(self, config: BridgeConfig) -> None:
        """Prepare; uses `axes` and `predicted` of the configuration."""
        self.axes: Axes = config.axes
        self.use_config(config)
        self._clock: RigClock | None = None
        self._map = ClockMap()
        self._outlets: Opened[_Stream] = Opened(MOST_STREAMS)
        self._opening: dict[str, asyncio.Task[None]] = {}
        self._events: Any = None

    @property
    def where(self) -> str:
        """How the streams are found, for people."""
        return "LSL streams of type MoCap, for whom LSL's own configuration (lsl_api.cfg) lets find them"

    def use_clock(self, clock: RigClock) -> None:
        """Set the rig clock that samples are timed on."""
        self._clock = clock

    def use_config(self, config: BridgeConfig) -> None:
        """Follow changed settings."""
        self._predicted = config.predicted == "send"

    async def open(self) -> None:
        """Open the stream of events; the others are opened with their first samples."""
        try:
            self._events = await asyncio.to_thread(_event_outlet)
        except Exception as error:  # whatever liblsl raises: one stream does not end the bridge
            logger.warning("LSL stream event cannot be opened: %s", str(error) or type(error).__name__)

    def wanted(self, now_ns: int) -> bool:
        """Return False: samples are sent one by one, not as scenes."""
        return False

    def send(self, scene: Scene, now_ns: int) -> tuple[int, int]:
        """Send nothing."""
        return 0, 0

    def send_sample(self, key: str, tracked: Tracked) -> bool:
        """Send a sample in the output's axes; return whether it was sent."""
        if tracked.state == "predicted" and not self._predicted:
            return False
        name = key.removeprefix("rhot/").replace("/", "_")
        stream = self._outlets.get(name)
        if stream is None:
            self._offer(name, joints_of(name, tracked))
            return False
        # Compared for equality, because the rig clock may be set back.
        if tracked.t_ns == stream.sent_ns or not self._map.follow(self._clock, _local_ns):
            return False
        stream.sent_ns = tracked.t_ns
        stream.outlet.push_sample(sample_of(tracked).tolist(), self._map.to_local_ns(tracked.t_ns) / 1e9)
        return True

    def send_event(self, event: Event) -> bool:
        """Send a marked moment, at its own time."""
        if self._events is None or not self._map.follow(self._clock, _local_ns):
            return False
        self._events.push_sample([event.label], self._map.to_local_ns(event.t_ns) / 1e9)
        return True

    def _offer(self, name: str, joints: tuple[str, ...]) -> None:
        """Open a stream on a worker thread: opening its ports takes some milliseconds."""
        if name in self._opening or not self._outlets.make_room(len(self._opening), _forget):
            return

        async def offer() -> None:
            try:
                self._outlets.add(name, _Stream(await asyncio.to_thread(_outlet, name, joints, self.axes)))
                logger.info("LSL stream %s is there, %d channels", name, 7 * len(joints) + 1)
            except Exception as error:  # whatever liblsl raises: one stream does not end the bridge
                logger.warning("LSL stream %s cannot be opened: %s", name, str(error) or type(error).__name__)
                # Keeps the next sample from opening it again at once.
                await asyncio.sleep(_RETRY_S)
            finally:
                self._opening.pop(name, None)

        self._opening[name] = asyncio.create_task(offer())

    async def close(self) -> None:
        """Close all streams."""
        opening = list(self._opening.values())
        for task in opening:
            task.cancel()
        await asyncio.gather(*opening, return_exceptions=True)
        outlets = [*self._outlets.clear(), self._events]
        self._events = None
        self._opening.clear()
        # Dropping the last reference closes a stream, which takes a moment.
        await asyncio.to_thread(outlets.clear)


def _forget(_: _Stream) -> None:
    """Do nothing: dropping the last reference, on the worker thread, closes the stream."""


def _local_ns() -> int:
    """Return LSL's clock, nanoseconds."""
    return round(1e9 * float(pylsl.local_clock()))


def make_output(config: BridgeConfig) -> LslOutput:
    """Return the output that a configuration asks for."""
    return LslOutput(config)


def _event_outlet() -> Any:
    source = f"rhot_{socket.gethostname()}_event"
    return pylsl.StreamOutlet(pylsl.StreamInfo(EVENTS, "Markers", 1, pylsl.IRREGULAR_RATE, pylsl.cf_string, source))


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
    # Samples buffered for a recorder that stalls, in hundreds: a minute at 100 Hz, 4 MB for a hand.
    return pylsl.StreamOutlet(info, max_buffered=60)
