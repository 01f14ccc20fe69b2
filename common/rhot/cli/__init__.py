"""The command line: `rhot COMMAND`."""

from rhot.cli.main import main

__all__ = ["main"]
