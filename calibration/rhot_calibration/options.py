"""Options that several calibrations share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])


def live_option(about: str = "Take the pictures now, from the running capture services.") -> Callable[[F], F]:
    """Return what adds `--live`: from the running rig instead of files."""
    return click.option("--live", is_flag=True, help=about)


def dry_run_option(command: F) -> F:
    """Add `--dry-run`."""
    return click.option("--dry-run", is_flag=True, help="Print the result and write nothing.")(command)
