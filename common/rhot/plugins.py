"""Parts that other packages bring, found by entry point and imported only when they are asked for."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from rhot.errors import ConfigError


def install_hint(extra: str) -> str:
    """Return the command that installs what an extra stands for; empty = RHOT itself."""
    if extra == "bench":
        return "it is in RHOT's source alone: in a checkout, pip install ./bench"
    return f"pip install 'rhot[{extra}]'" if extra else "install RHOT again"


def load_plugin(group: str, name: str, purpose: str, extra: str) -> Any:
    """Import and return what another package brings.

    Args:
        group, name: of the entry point.
        purpose: what needs it, to begin the message with: `offline tracking`.
        extra: what to install when it is missing.

    Raises:
        ConfigError: the part, or a module that it needs, is not installed here.
    """
    hint = install_hint(extra)
    found = list(entry_points(group=group, name=name))
    if not found:
        raise ConfigError(f"{purpose} needs a part of RHOT that is not installed here; {hint}")
    try:
        return found[0].load()
    except ModuleNotFoundError as error:
        raise ConfigError(f"{purpose} needs the Python module {error.name}, which is not installed; {hint}") from error


def load_library(module: str, purpose: str, extra: str) -> Any:
    """Import and return a library that only some need, or a module of ours that needs one.

    Args:
        module: its name.
        purpose: what needs it, to begin the message with: `--c3d`.
        extra: what to install when it is missing.

    Raises:
        ConfigError: it is not installed here.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ConfigError(f"{purpose} needs the Python module {error.name}; {install_hint(extra)}") from error


def load_simulated(name: str) -> Any:
    """Import and return a simulated device, which the simulation brings for the seam of a real one.

    Raises:
        ConfigError: the simulation is not installed here.
    """
    return load_plugin("rhot.simulated", name, f"a simulated {name.replace('_', ' ')}", "sim")
