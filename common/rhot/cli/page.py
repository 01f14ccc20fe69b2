"""Starting the web pages beside a rig: what `rhot sim` and `rhot up` share."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
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
        help="Port of the page for working on the rig; Grasp takes the next. If one is busy, another is used.",
    )(command)
    return click.option("--viewer/--no-viewer", default=True, show_default=True, help="Show the rig as web pages.")(
        command
    )


@dataclass(frozen=True, slots=True)
class Pages:
    """The web pages of a rig on this machine; a port is None where a page is left out.

    Attributes:
        working: of the page for working on the rig.
        grasp: of the page *Grasp*, which shows hand and object.
    """

    working: int | None = None
    grasp: int | None = None

    def commands(self) -> dict[str, list[str]]:
        """Return the command that opens each page, by its name on the bus, without the rig's own options."""
        found: dict[str, list[str]] = {}
        for name, port, other, mode in (
            ("viewer/main", self.working, self.grasp, []),
            ("viewer/grasp", self.grasp, self.working, ["--xr"]),
        ):
            if port is not None:
                link = [] if other is None else ["--other-page", _url(other)]
                found[name] = ["viewer", *mode, "--host", _HOST, "--port", str(port), *link]
        return found

    def lines(self) -> list[str]:
        """Return where a browser on this machine finds them, for people."""
        if self.working is None:
            return []
        if self.grasp is None:
            return [f"The page is at {_url(self.working)}"]
        return [f"The hand is at {_url(self.grasp)}", f"The page for working on the rig is at {_url(self.working)}"]


def free_pages(wanted: int, *, grasp: bool = True) -> Pages:
    """Return ports for the pages: the wanted one and the next, or any others when they are busy.

    Args:
        wanted: for the page for working on the rig.
        grasp: whether *Grasp* is shown, too, where it is built.
    """
    if find_spec("rhot_viewer") is None or find_spec("viser") is None:
        logger.warning("no web page: the viewer is not installed; pip install 'rhot[viewer]'")
        return Pages()
    working = _free(wanted)
    if working is None or not grasp:
        return Pages(working)
    if not _grasp_is_built():
        logger.warning("the page Grasp is not built, so only the working page is shown; `make web` builds it")
        return Pages(working)
    last_port = 65535
    return Pages(working, _free(min(working + 1, last_port)))


def _free(wanted: int) -> int | None:
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


def _grasp_is_built() -> bool:
    """Tell whether the page's bundle lies in the viewer's package, without loading the package."""
    package = find_spec("rhot_viewer")
    return package is not None and any(
        (Path(folder) / "static" / "index.html").is_file() for folder in package.submodule_search_locations or ()
    )


def _url(port: int) -> str:
    return f"http://localhost:{port}"
