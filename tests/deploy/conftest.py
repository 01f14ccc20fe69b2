"""Where things lie, and how commands in units and containers are checked against the real command line."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from pathlib import Path

import click
import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def repository() -> Path:
    """The top of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def deploy(repository: Path) -> Path:
    """The folder under test."""
    return repository / "deploy"


@pytest.fixture(scope="session")
def resolve_command() -> Callable[[list[str]], str]:
    """A function that parses the words after `rhot` with the real command line, without running the command.

    It returns the command's name and fails the test where the command or one of its options does not exist.
    """
    return _resolve


def _resolve(words: list[str]) -> str:
    from rhot.cli import main

    context = click.Context(main, info_name="rhot")
    command = main.get_command(context, words[0])
    assert command is not None, f"rhot has no command {words[0]}"
    with contextlib.redirect_stderr(io.StringIO()):
        try:
            # Parses options and arguments exactly as the command line does, and stops short of running it.
            command.make_context(words[0], words[1:], parent=context).close()
        except click.ClickException as error:
            pytest.fail(f"rhot {' '.join(words)}: {error.format_message()}")
    return words[0]
