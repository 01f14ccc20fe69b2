"""The command group: commands loaded only when called, errors on one screen without a traceback."""

from __future__ import annotations

import difflib
import errno
import importlib
import io
import logging
import os
import signal
import sys
import threading
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import click

from rhot.errors import EXIT_AGAIN, ConfigError, HungDeviceError, RhotError
from rhot.plugins import install_hint
from rhot.text import printable_lines

logger = logging.getLogger(__name__)

EXIT_ERROR = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class LazyCommand:
    """Where a command lives and what the overview says of it.

    Attributes:
        summary: one line for the overview, so that showing it imports nothing.
        target: `module:attribute`, or empty when an entry point of `group` says it.
        extra: what to install when its module cannot be imported; `bench` is a package of its own, in the source only.
    """

    summary: str
    target: str = ""
    extra: str = ""


class LazyGroup(click.Group):
    """A group whose commands are imported when they are called."""

    def __init__(
        self, *args: Any, lazy: Mapping[str, Mapping[str, LazyCommand]], plugins: str = "", **kwargs: Any
    ) -> None:
        """Take the commands by the section of the overview that they stand in; a section without a title is hidden."""
        super().__init__(*args, **kwargs)
        self._sections = lazy
        self._lazy = {name: command for commands in lazy.values() for name, command in commands.items()}
        self._plugins = plugins

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the table."""
        return [*self._lazy, *super().list_commands(ctx)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return one command."""
        lazy = self._lazy.get(cmd_name)
        if lazy is None:
            return super().get_command(ctx, cmd_name)
        target = lazy.target or self._plugin_target(cmd_name)
        hint = install_hint(lazy.extra)
        if not target:
            raise click.ClickException(f"`{ctx.command_path} {cmd_name}` is not installed here; {hint}")
        module_name, _, attribute = target.partition(":")
        try:
            command = getattr(importlib.import_module(module_name), attribute)
        except ModuleNotFoundError as error:
            raise click.ClickException(
                f"`{ctx.command_path} {cmd_name}` needs the Python module {error.name}, which is not installed; {hint}"
            ) from error
        if not isinstance(command, click.Command):
            raise click.ClickException(f"{target} is not a command; {hint}")
        command.context_class = _Guarded
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the first word names; for one that is none, say which was probably meant."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            similar = difflib.get_close_matches(args[0], self.list_commands(ctx), 1)
            hint = f" Did you mean '{similar[0]}'?" if similar else ""
            raise click.UsageError(f"{error.message}{hint}", error.ctx) from error

    def _plugin_target(self, name: str) -> str:
        found = list(entry_points(group=self._plugins, name=name)) if self._plugins else []
        return found[0].value if found else ""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the overview from the table alone, importing nothing."""
        for title, commands in self._sections.items():
            rows = [
                (name, lazy.summary)
                for name, lazy in commands.items()
                # Developers have it; who only installed RHOT has not, and need not read of it.
                if title and (lazy.extra != "bench" or self._plugin_target(name))
            ]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


class _Guarded(click.Context):
    """Calls a command unless a file that it would write is one that it reads, or would be written twice."""

    def invoke(self, callback: Any, /, *args: Any, **kwargs: Any) -> Any:
        """Call a function with this context.

        Raises:
            click.UsageError: an option names the file of an argument, or of another option.
        """
        read, written = list[Path](), list[tuple[click.Parameter, Path]]()
        for param in self.command.params:
            value = self.params.get(param.name or "")
            files = [one for one in (value if isinstance(value, tuple) else (value,)) if isinstance(one, Path)]
            if isinstance(param, click.Argument):
                read += files
            else:
                written += [(param, file) for file in files]
        targets: dict[str, click.Parameter] = {}
        for param, file in written:
            if file.is_file() and any(other.is_file() and file.samefile(other) for other in read):
                raise click.UsageError(f"{param.opts[-1]} {file} is the file that it reads; choose another name", self)
            if isinstance(param.type, click.Path) and not (param.type.dir_okay or param.type.exists):
                first = targets.setdefault(os.path.abspath(file), param)  # noqa: PTH100 - links are files of their own
                if first is not param:
                    raise click.UsageError(f"{first.opts[-1]} and {param.opts[-1]} both name {file}; choose two", self)
        return super().invoke(callback, *args, **kwargs)


class MainGroup(LazyGroup):
    """The program itself: every error of ours ends as one message and an exit code."""

    def main(self, args: Sequence[str] | None = None, *more: Any, **extra: Any) -> Any:
        """Run the program and exit."""
        # Before anything imports numpy: its matrices are tiny here, and threads that wait in a spin take the cores from
        # the other services.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        # Before anything imports OpenCV: a few kilobytes of PNG may unpack to a gigapixel.
        os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 26))
        _write_what_can_be_written()
        end_orderly_on_sigterm()
        if not os.environ.get("PYTHONWARNINGS"):
            # Those of numpy are for programmers; who runs a command gets one error that says what to do.
            warnings.simplefilter("ignore", RuntimeWarning)
        try:
            extra["standalone_mode"] = False
            result = super().main(args, *more, **extra)
            sys.stdout.flush()
        except click.Abort:
            self._exit(EXIT_INTERRUPTED)
        except click.ClickException as error:
            _show(error)
            self._exit(error.exit_code)
        except RhotError as error:
            click.echo(f"rhot: error: {printable_lines(str(error))}", err=True)
            codes = {ConfigError: EXIT_USAGE, HungDeviceError: EXIT_AGAIN}
            self._exit(next((code for kind, code in codes.items() if isinstance(error, kind)), EXIT_ERROR))
        except KeyboardInterrupt:
            self._exit(EXIT_INTERRUPTED)
        except OSError as error:
            if error.filename is None or isinstance(error, BrokenPipeError):
                self._end_without_output(error)
            # Such as a name that is too long, or a cache of some library that cannot be written.
            logger.debug("refused by the system", exc_info=True)
            click.echo(f"rhot: error: {printable_lines(str(error.filename))}: {error.strerror or error}", err=True)
            self._exit(EXIT_ERROR)
        self._exit(result if isinstance(result, int) else 0)

    def _end_without_output(self, error: OSError) -> None:
        """End after output that could not be written; what else the system refuses is an error of ours, and raised."""
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
        if not (isinstance(error, BrokenPipeError) or is_full):
            raise error
        # The reader of our output (`head`, `less`) has gone, or its disk is full; Python would complain once more at
        # exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if is_full:
            click.echo(f"rhot: error: standard output: cannot be written: {error.strerror}", err=True)
        self._exit(EXIT_ERROR)

    @staticmethod
    def _exit(code: int) -> None:
        sys.exit(code)


def _write_what_can_be_written() -> None:
    """Let a terminal or file whose encoding lacks a character (Latin-1, ASCII) show a question mark in its place.

    What was closed before (`>&-`) becomes the null device, or the next file that is opened would take its number.
    """
    if sys.stdout is None or sys.stderr is None:
        nowhere = Path(os.devnull).open("w")  # noqa: SIM115 - for as long as the program runs
        sys.stdout, sys.stderr = sys.stdout or nowhere, sys.stderr or nowhere
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors in ("strict", "surrogateescape"):
            stream.reconfigure(errors="replace")


def end_orderly_on_sigterm() -> None:
    """Let SIGTERM end a command like Ctrl-C does: temporary folders and children go with it.

    Services catch the signal themselves as soon as their event loop runs (`rhot.service.stop`).
    """

    def end(number: int, _: object) -> None:
        sys.exit(128 + number)

    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, end)


def _show(error: click.ClickException) -> None:
    if isinstance(error, click.UsageError) and error.ctx is not None:
        click.echo(error.ctx.get_usage(), err=True)
        click.echo(f"Try '{error.ctx.command_path} --help' for help.", err=True)
    click.echo(f"rhot: error: {printable_lines(error.format_message())}", err=True)
