"""The interface between the core and another program."""

from __future__ import annotations

import asyncio
import importlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Generic, Protocol, TypeVar, runtime_checkable

from rhot.clock import RigClock
from rhot.errors import ConfigError
from rhot.messages import Event
from rhot.rig import BridgeConfig
from rhot_bridge.links import Link
from rhot_bridge.scene import Axes, Scene, Tracked
from rhot_bridge.targets import TARGETS, TARGETS_OF, Target

# Resources that a bridge opens by name, such as streams and topics.

SILENT_NS: Final = 5_000_000_000
"""A resource that has not been used for this long may be closed to make room for another."""

T = TypeVar("T")


class Opened(Generic[T]):
    """A bounded map from names, which come from messages, to resources; iterates over names, least recently used first.

    Args:
        most: largest number of resources.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # Ordered by the last use.
        self._things: dict[str, tuple[T, int]] = {}

    def __iter__(self) -> Iterator[str]:
        """Return the names, least recently used first."""
        return iter(self._things)

    def add(self, name: str, thing: T) -> None:
        """Store the resource of a name; this counts as a use."""
        self._things.pop(name, None)
        self._things[name] = thing, time.monotonic_ns()

    def get(self, name: str) -> T | None:
        """Return the resource of a name and count this as a use; None if there is none."""
        if name not in self._things:
            return None
        thing, _ = self._things[name]
        self.add(name, thing)
        return thing

    def make_room(self, opening: int, end: Callable[[T], None]) -> bool:
        """Return whether there is room for one more, after closing an unused one if necessary.

        Args:
            opening: how many more are being opened.
            end: closes a resource; called on a worker thread, which also drops the last reference to it.
        """
        if len(self._things) + opening < self._most:
            return True
        silent = next(iter(self._things), None)
        if silent is None or time.monotonic_ns() - self._things[silent][1] < SILENT_NS:
            return False
        held = [self._things.pop(silent)[0]]
        # Not awaited: it does not raise, and what remains ends with the bridge.
        asyncio.get_running_loop().run_in_executor(None, lambda: end(held.pop()))
        return True

    def clear(self) -> list[T]:
        """Remove and return all resources."""
        things = [thing for thing, _ in self._things.values()]
        self._things.clear()
        return things


class Output(Protocol):
    """Another program as the core sees it; `PacketOutput` combines a target and a link.

    `make_output(config)` of each target's module returns one. No method may block: a blocking library needs its own
    thread, on which the newest scene replaces older ones.
    """

    @property
    def axes(self) -> Axes:
        """Axes of the scenes that it accepts; `rig` needs no stage."""
        ...

    @property
    def triggers(self) -> Sequence[str]:
        """Kinds of samples (`hand`, `body`, `foot`, `object`, `head`) that trigger a frame, by priority."""
        ...

    @property
    def where(self) -> str:
        """The destination, for people."""
        ...

    @property
    def problem(self) -> str:
        """What is wrong, one sentence for the status; empty when nothing is."""
        ...

    async def open(self) -> None:
        """Open the output.

        Raises:
            DeviceError: it cannot be opened; the runner shows this in the status and tries again.
        """
        ...

    def wanted(self, now_ns: int) -> bool:
        """Return whether a scene would be sent now; `now_ns` is on the monotonic clock."""
        ...

    def send(self, scene: Scene, now_ns: int) -> tuple[int, int]:
        """Send a scene in the output's axes; return how many packets were sent and how many lost on this machine."""
        ...

    async def close(self) -> None:
        """Release everything."""
        ...


@runtime_checkable
class SampleOutput(Output, Protocol):
    """An output for recorders, which receives every sample with its own time; the rate is not limited."""

    def use_clock(self, clock: RigClock) -> None:
        """Set the rig clock that samples are timed on."""
        ...

    def use_config(self, config: BridgeConfig) -> None:
        """Follow settings that change while the bridge runs."""
        ...

    def send_sample(self, key: str, tracked: Tracked) -> bool:
        """Send a sample in the output's axes; return whether it was sent."""
        ...

    def send_event(self, event: Event) -> bool:
        """Send a marked moment; return whether it was sent, which not every program has a place for."""
        ...


class PacketOutput:
    """Sends a target's packets over a link."""

    def __init__(self, target: Target, link: Link, closing_packets: Callable[[], list[bytes]] = list) -> None:
        """Combine them; `closing_packets` returns packets that are sent when the bridge ends."""
        self._target, self._link, self._closing_packets = target, link, closing_packets
        self.axes: Axes = target.axes
        self.triggers = tuple(target.triggers)
        self.open, self.wanted = link.open, link.wanted

    @property
    def where(self) -> str:
        """The link's receiver, for people."""
        return self._link.where

    @property
    def problem(self) -> str:
        """The link's problem; empty when there is none."""
        return self._link.problem

    def send(self, scene: Scene, now_ns: int) -> tuple[int, int]:
        """Send the packets of a scene; return how many were sent and how many were lost on this machine."""
        packets = self._target.frame(scene, now_ns)
        lost = self._link.send(packets)
        return len(packets) - lost, lost

    async def close(self) -> None:
        """Send the closing packets and close the link."""
        self._link.send(self._closing_packets())
        await self._link.close()


def check_settings(config: BridgeConfig) -> None:
    """Refuse settings that have no effect on the target.

    Raises:
        ConfigError: such a setting differs from its default.
    """
    for name, targets in TARGETS_OF.items():
        if config.target not in targets and getattr(config, name) != BridgeConfig.model_fields[name].default:
            raise ConfigError(unsupported_setting(name, config.target))


def unsupported_setting(name: str, target: str) -> str:
    """Return the error message for a setting that has no effect on a target."""
    return f"{name} means nothing to {target}, only to {', '.join(sorted(TARGETS_OF[name]))}; leave it out"


def make_output(config: BridgeConfig) -> Output:
    """Return the output of a configuration.

    Raises:
        ConfigError: the target is unknown, its library is not installed, or its settings contradict each other.
    """
    kind = TARGETS.get(config.target)
    if kind is None:
        raise ConfigError(f'target = "{config.target}": there is no such bridge; one of {", ".join(TARGETS)}')
    check_settings(config)
    try:
        module = importlib.import_module(kind.module)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"`rhot bridge {config.target}` needs the Python module {error.name}; pip install 'rhot[{kind.extra}]'"
        ) from error
    output: Output = module.make_output(config)
    return output
