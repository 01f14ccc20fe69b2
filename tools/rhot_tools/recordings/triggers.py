"""Triggers of other instruments: marker streams of LSL (Lab Streaming Layer), and a pin of a Raspberry Pi.

LSL's streams have the type `Markers` (sccn/xdf wiki): strings or numbers at irregular times. LSL stamps them when the
program sends them and knows how far the sender's clock is off (`time_correction`), so it does not matter when they
arrive here. Edges of a pin are stamped by the kernel as they come, on the system clock.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Protocol

from rhot.clock import difference_ns
from rhot.errors import DeviceError
from rhot.plugins import load_library

ALL: Final = "all"
_LOOK_S: Final = 0.5
_PULL_S: Final = 0.05
_LABEL: Final = 64
"""Longest label of an event."""


Tell = Callable[[str, int], object]
"""Takes a trigger's label and its system time, nanoseconds."""


class Triggers(Protocol):
    """Where triggers come from.

    Attributes:
        source: of the events.
        uncertainty_s: of their times on this machine's clock.
        where: what is waited for, for people.
    """

    source: str
    uncertainty_s: float
    where: str

    def follow(self, tell: Tell, ended: threading.Event) -> None:
        """Tell of each trigger until it is ended, on the thread that calls it."""
        ...


class LslMarkers:
    """Follows marker streams, those that appear later as well.

    Args:
        name: of the stream, or `ALL`. What `rhot bridge lsl` sends is not followed: it would come back for ever.

    Raises:
        ConfigError: LSL is not installed.
    """

    source = "lsl"
    # What LSL states of its corrections in a wired network (labstreaminglayer.readthedocs.io, time synchronization).
    uncertainty_s = 0.001

    def __init__(self, name: str) -> None:
        bridge = load_library("rhot_bridge.targets.lsl", "--lsl", "lsl")
        self._lsl, self._ours = bridge.pylsl, bridge.EVENTS
        self._name = name
        self.where = "all LSL streams of type Markers" if name == ALL else f"the LSL marker stream {name}"

    def follow(self, tell: Tell, ended: threading.Event) -> None:
        """See `Triggers`."""
        resolver = self._lsl.ContinuousResolver("type", "Markers")
        inlets: dict[str, Any] = {}
        looked_s = 0.0
        while not ended.is_set():
            if time.monotonic() - looked_s > _LOOK_S:
                looked_s = time.monotonic()
                for info in resolver.results():
                    wanted = self._name in (ALL, info.name()) and info.name() != self._ours
                    if wanted and info.uid() not in inlets:
                        inlets[info.uid()] = self._lsl.StreamInlet(info, recover=True)
            if not inlets:
                ended.wait(_PULL_S)
            for inlet in inlets.values():
                self._pull(inlet, tell)
        for inlet in inlets.values():
            inlet.close_stream()

    def _local_ns(self) -> int:
        return round(1e9 * float(self._lsl.local_clock()))

    def _pull(self, inlet: Any, tell: Tell) -> None:
        try:
            sample, stamp_s = inlet.pull_sample(timeout=_PULL_S)
            while sample is not None:
                here_ns = round(1e9 * (stamp_s + inlet.time_correction(timeout=1.0)))
                label = " ".join(str(value) for value in sample).strip() or "marker"
                tell(label[:_LABEL], here_ns + difference_ns(time.time_ns, self._local_ns))
                sample, stamp_s = inlet.pull_sample(timeout=0.0)
        except RuntimeError:  # both LostError and TimeoutError of pylsl
            return  # its program ended, or does not answer; LSL takes it up again by itself


class GpioPin:
    """Rising edges of a pin of the Raspberry Pi's header.

    Args:
        pin: its GPIO number, 17 for pin 11 of the header.
        label: of its events.

    Raises:
        ConfigError: gpiod is not installed.
        DeviceError: this machine has no such pin, or another program has it.
    """

    source = "gpio"
    uncertainty_s = 0.0001

    def __init__(self, pin: int, label: str) -> None:
        gpiod, line = (load_library(name, "--gpio, for Linux,", "gpio") for name in ("gpiod", "gpiod.line"))
        self._label = label
        self.where = f"rising edges of GPIO{pin}"
        edges = gpiod.LineSettings(
            edge_detection=line.Edge.RISING, bias=line.Bias.PULL_DOWN, event_clock=line.Clock.REALTIME
        )
        self._lines: Any = _requested(gpiod, f"GPIO{pin}", edges)

    def follow(self, tell: Tell, ended: threading.Event) -> None:
        """See `Triggers`.

        Raises:
            DeviceError: the pin is gone.
        """
        try:
            with self._lines as lines:
                while not ended.is_set():
                    if lines.wait_edge_events(_PULL_S):
                        for event in lines.read_edge_events():
                            tell(self._label, event.timestamp_ns)
        except OSError as error:
            raise DeviceError(f"{self.where}: cannot be read: {error.strerror or error}") from error


def _requested(gpiod: Any, name: str, edges: Any) -> Any:
    """Return the lines of the chip that has one of this name; boards number their chips as they like."""
    for path in sorted(map(str, Path("/dev").glob("gpiochip*"))):
        with contextlib.suppress(OSError), gpiod.Chip(path) as chip:
            chip.line_offset_from_id(name)
            try:
                return gpiod.request_lines(path, {name: edges}, consumer="rhot mark")
            except OSError as error:
                raise DeviceError(
                    f"{name} of {path}: {error.strerror or error}; is another program using it?"
                ) from error
    raise DeviceError(f"no GPIO chip of this machine has a pin {name}; --gpio is for the header of a Raspberry Pi")
