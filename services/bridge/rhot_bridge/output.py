"""The seam between the core and another program."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from rhot.clock import RigClock
from rhot.errors import ConfigError
from rhot.rig import BridgeConfig
from rhot_bridge.links import Link
from rhot_bridge.scene import Axes, Scene, Tracked
from rhot_bridge.targets import TARGETS, TARGETS_OF, Target


class Output(Protocol):
    """Another program, whole: what the core needs of it. `PacketOutput` makes one of a target and a link.

    `make_output(config)` of each target's module returns one. Nothing here may block: a library that does belongs on a
    thread of its own, and the newest scene wins.
    """

    @property
    def axes(self) -> Axes:
        """Axes of the scenes it takes; `rig` needs no floor."""
        ...

    @property
    def leads(self) -> Sequence[str]:
        """Kinds whose samples give the beat (`hand`, `body`, `foot`, `object`, `head`), the most important first."""
        ...

    @property
    def where(self) -> str:
        """Where it goes, for people."""
        ...

    @property
    def problem(self) -> str:
        """What is wrong, one sentence for the status; empty when nothing is."""
        ...

    async def open(self) -> None:
        """Get ready; a DeviceError is shown in the status and tried again."""
        ...

    def wanted(self, now_ns: int) -> bool:
        """Return whether it is worth making a scene now, by the monotonic clock."""
        ...

    def send(self, scene: Scene, now_ns: int) -> tuple[int, int]:
        """Send a scene in its axes; return how many packets went out and how many were lost on this machine."""
        ...

    async def close(self) -> None:
        """Release everything."""
        ...


@runtime_checkable
class SampleOutput(Output, Protocol):
    """An output that takes every sample by itself, each with its own time: for recorders. The rate is not capped."""

    def use_clock(self, clock: RigClock) -> None:
        """Take times from a rig clock."""
        ...

    def take(self, key: str, tracked: Tracked) -> bool:
        """Send a sample in the output's axes; return whether it went out."""
        ...


class PacketOutput:
    """A target's packets over a link."""

    def __init__(self, target: Target, link: Link, farewell: Callable[[], list[bytes]] = list) -> None:
        """Put them together; `farewell` returns the packets that take back what is there when the bridge ends."""
        self._target, self._link, self._farewell = target, link, farewell
        self.axes: Axes = target.axes
        self.leads = tuple(target.leads)
        self.open, self.wanted = link.open, link.wanted

    @property
    def where(self) -> str:
        """The link's."""
        return self._link.where

    @property
    def problem(self) -> str:
        """The link's."""
        return self._link.problem

    def send(self, scene: Scene, now_ns: int) -> tuple[int, int]:
        """Make the packets of a scene and send them."""
        packets = self._target.frame(scene, now_ns)
        lost = self._link.send(packets)
        return len(packets) - lost, lost

    async def close(self) -> None:
        """Send the farewell and close the link."""
        self._link.send(self._farewell())
        await self._link.close()


def refuse_meaningless(config: BridgeConfig) -> None:
    """Refuse a setting that the target has no use for, instead of leaving it without effect.

    Raises:
        ConfigError: such a setting differs from its default.
    """
    for name, targets in TARGETS_OF.items():
        if config.target not in targets and getattr(config, name) != BridgeConfig.model_fields[name].default:
            raise ConfigError(meaningless(name, config.target))


def meaningless(name: str, target: str) -> str:
    """Return the sentence that refuses a setting of a target."""
    return f"{name} means nothing to {target}, only to {', '.join(sorted(TARGETS_OF[name]))}; leave it out"


def make_output(config: BridgeConfig) -> Output:
    """Return what a configuration asks for.

    Raises:
        ConfigError: its library is not installed, or its settings do not fit together.
    """
    kind = TARGETS.get(config.target)
    if kind is None:
        raise ConfigError(f'target = "{config.target}": there is no such bridge; one of {", ".join(TARGETS)}')
    refuse_meaningless(config)
    try:
        module = importlib.import_module(kind.module)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"`rhot bridge {config.target}` needs the Python module {error.name}; pip install 'rhot[{kind.extra}]'"
        ) from error
    output: Output = module.make_output(config)
    return output
