"""Where a figure comes from: the command, the day, the machine and the version of the code."""

from __future__ import annotations

import os
import platform
import shlex
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import click
from click.core import ParameterSource

from rhot.cli.version import commit

_PACKAGES: Final = ("rhot", "numpy", "opencv-python-headless", "eclipse-zenoh", "scipy")
_OUTPUTS: Final = ("json_path", "page_path", "as_json", "keep_path")
"""Options that say where figures go, not how they are measured."""


def provenance() -> dict[str, Any]:
    """Return what a file of figures says of its origin.

    `command_line` as it was typed, without its output files; `date` in UTC; `machine` with `cpu`, `cores` that this
    process may use, `load` (processes that ran or waited during the last minute) and `system`; `versions` of Python and
    the packages that matter; `commit` of the source, with `-dirty` where files differ from it, null outside a
    repository.
    """
    return {
        "command_line": command_line(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": {
            "cpu": _cpu(),
            "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
            "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
            "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        },
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in _PACKAGES}},
        "commit": commit(),
    }


def command_line() -> str:
    """Return the running command with the arguments it was given; empty outside a command."""
    context = click.get_current_context(silent=True)
    if context is None:
        return ""
    words = context.command_path.split()
    for parameter in context.command.params:
        name = parameter.name or ""
        if name in _OUTPUTS or context.get_parameter_source(name) is not ParameterSource.COMMANDLINE:
            continue
        value = context.params[name]
        for one in value if isinstance(value, tuple) else (value,):
            words += [] if isinstance(parameter, click.Argument) else [parameter.opts[-1]]
            words += [] if one is True else map(str, one if isinstance(one, tuple) else (one,))
    return shlex.join(words)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model")))
    return next(names, "") or platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
