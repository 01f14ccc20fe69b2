"""Starting the web page beside a rig: the options that `rhot sim` and `rhot up` share."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Final, TypeVar

import click

logger = logging.getLogger(__name__)

PAGE_PORT: Final = 8080
_HOST: Final = "127.0.0.1"

F = TypeVar("F", bound=Callable[..., Any])


def page_options(command: F) -> F:
    """Add `--viewer/--no-viewer` and `--page-port`."""
    command = click.option(
        "--page-port",
        type=click.IntRange(1, 65535),
        default=PAGE_PORT,
        show_default=True,
        help="Port of the web page; if it is busy, another one is used.",
    )(command)
    return click.option("--viewer/--no-viewer", default=True, show_default=True, help="Show the rig as a web page.")(
        command
    )


def free_page_port(wanted: int) -> int | None:
    """Return the port for the page: the wanted one, or any other when it is busy; None when no viewer is installed."""
    if find_spec("rhot_viewer") is None or find_spec("viser") is None:
        logger.warning("no web page: the viewer is not installed; pip install 'rhot[viewer]'")
        return None
    for port in (wanted, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((_HOST, port))
            except OSError:
                logger.warning("port %d is busy, the page takes another one", port)
                continue
            return int(probe.getsockname()[1])
    return None


def page_command(port: int) -> list[str]:
    """Return the command that opens the page, without the rig's own options."""
    return ["viewer", "--host", _HOST, "--port", str(port)]


def page_url(port: int) -> str:
    """Return where a browser on this machine finds the page."""
    return f"http://localhost:{port}"
