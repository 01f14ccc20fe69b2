"""Options that several commands share: which rig, and where its router is."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import click
from pydantic import ValidationError

from rhot.errors import ConfigError
from rhot.messages import first_problem
from rhot.rig import BusConfig
from rhot.rig.folder import RIG_FILE, load_config

DEFAULT_RIG: Final = Path("rig")

F = TypeVar("F", bound=Callable[..., Any])

_WITH_PORT: Final = ("tcp", "udp", "tls", "quic", "ws")
"""Zenoh's links that reach a machine by address and port."""


class Finite(click.types.FloatParamType):
    """A number. Unlike click's own type, it rejects `nan` and `inf`."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number:g} is no number to compute with", param, ctx)
        return number


class FiniteRange(Finite, click.FloatRange):
    """A number between two bounds. Between click's own bounds is `nan`, too, because no comparison rejects it."""

    name = "number"


def rig_folder_option(about: str, **settings: Any) -> Callable[[F], F]:
    """Return what adds `--rig`, as `rig_path`; without other settings, which are click's, it may be left out."""
    folder = click.Path(path_type=Path, file_okay=False)
    return click.option("--rig", "rig_path", type=folder, help=about, **settings)


def rig_option(command: F) -> F:
    """Add `--rig` with its usual default."""
    usual = rig_folder_option(
        "Rig folder.", envvar="RHOT_RIG", default=DEFAULT_RIG, show_default=True, show_envvar=True
    )
    return usual(command)


def jobs_option(about: str, default: int = 1, *, show_default: bool | str = True) -> Callable[[F], F]:
    """Return what adds `--jobs`: how much runs at the same time."""
    most = click.IntRange(1, 64)
    return click.option("--jobs", type=most, default=default, show_default=show_default, help=about)


def namespace_option(command: F) -> F:
    """Add `--namespace`."""
    return click.option(
        "--namespace", envvar="RHOT_NAMESPACE", show_envvar=True, help="Namespace of the rig; overrides rig.toml."
    )(command)


def bus_options(command: F) -> F:
    """Add `--connect` and `--namespace`."""
    return click.option(
        "--connect",
        multiple=True,
        envvar="RHOT_CONNECT",
        show_envvar=True,
        metavar="ENDPOINT",
        help="Endpoint of the Zenoh router, such as tcp/192.168.1.10:7447; overrides rig.toml. May be repeated.",
    )(namespace_option(command))


def endpoints(option: str, words: tuple[str, ...]) -> tuple[str, ...]:
    """Return the Zenoh endpoints that an option names; commas separate several.

    Raises:
        ConfigError: one has no protocol, or no port that others could find.
    """
    found = tuple(part for word in words for part in word.split(",") if part)
    for each in found:
        link, slash, address = each.partition("/")
        if not slash or not address:
            raise ConfigError(f"{option} {each}: an endpoint begins with its protocol, such as tcp/192.168.1.10:7447")
        if link in _WITH_PORT and not re.search(r":\d+($|[?#])", address):
            raise ConfigError(
                f"{option} {each}: has no port; a router listens on {each}:7447 unless rig.toml says else"
            )
        if link in _WITH_PORT and re.search(r":0+($|[?#])", address):
            raise ConfigError(f"{option} {each}: nobody could find port 0; give a free one, such as 7447")
    return found


def overridden(bus: BusConfig, connect: tuple[str, ...], namespace: str | None) -> BusConfig:
    """Return a bus configuration with what the command line says instead.

    Raises:
        ConfigError: `connect` names no endpoint, or `namespace` is none.
    """
    changes: dict[str, Any] = {}
    if chosen := endpoints("--connect", connect):
        changes |= {"mode": "client", "connect": chosen, "listen": ()}
    if namespace is not None:
        try:
            changes["namespace"] = BusConfig(namespace=namespace).namespace
        except ValidationError as error:
            raise ConfigError(f"--{first_problem(error)}") from error
    return bus.model_copy(update=changes)


def tool_bus(rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> BusConfig:
    """Return how a tool reaches a running rig: command line, else rig folder, else a router on this machine.

    Raises:
        ConfigError: a rig folder was named that is none, or it is not valid.
    """
    if (rig_path / RIG_FILE).exists():
        bus = load_config(rig_path).bus
    elif rig_path != DEFAULT_RIG and not connect:
        load_config(rig_path)  # says what is missing
    else:
        bus = BusConfig()
    if bus.mode == "router":
        # Tools and services are clients of the router that this rig runs.
        bus = bus.model_copy(update={"mode": "client", "connect": bus.listen})
    if bus.mode == "client":
        # `listen` in rig.toml is the router's.
        bus = bus.model_copy(update={"listen": ()})
    return overridden(bus, connect, namespace)
