"""`rhot viewer`."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from pathlib import Path

import click

from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.rig import load_rig
from rhot_viewer.browser.access import Access, own_names
from rhot_viewer.page_token import kept_token, new_token
from rhot_viewer.service import serve_page


@click.command()
@click.option(
    "--host",
    envvar="RHOT_PAGE_HOST",
    show_envvar=True,
    default="127.0.0.1",
    show_default=True,
    help="Address to listen on; 0.0.0.0 lets other machines in that have a link with a token.",
)
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="Port of the page; 0 takes any."
)
@click.option("--view-only", is_flag=True, help="Let nobody change anything; not even on this machine.")
@click.option(
    "--token-file",
    envvar="RHOT_PAGE_TOKEN_FILE",
    show_envvar=True,
    type=click.Path(path_type=Path, dir_okay=False),
    help="Keep the links for other machines in this file, so that they stay the same; made when it is missing.",
)
@click.option(
    "--allow-host",
    "hosts",
    multiple=True,
    metavar="NAME",
    help="A further name under which the page is opened, such as that of a proxy before it. May be repeated.",
)
@click.option(
    "--recordings",
    envvar="RHOT_RECORDINGS",
    show_envvar=True,
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("recordings"),
    show_default=True,
    help="Folder below which the page records; nothing is written elsewhere.",
)
@rig_option
@bus_options
def viewer(
    host: str,
    port: int,
    view_only: bool,
    token_file: Path | None,
    hosts: tuple[str, ...],
    recordings: Path,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> int:
    """Show the running rig as a web page, until Ctrl-C.

    Open http://localhost:8080 in a browser: the hand and what else is tracked, what each camera sees, how every service
    does, and sliders for the cameras. Several browsers may look at once. Nothing is fetched from the internet.

    Only this machine can open the page. For a tablet, add --host 0.0.0.0: the log then shows two links, one to look
    and one to change things, too. Without a link nobody on the network gets in, and no website that you visit
    meanwhile can talk to the page.
    """
    # It logs every connection; the page itself reports who looks.
    logging.getLogger("websockets").setLevel(logging.WARNING)
    bus = tool_bus(rig_path, connect, namespace)
    rig = load_rig(rig_path)
    token = ""
    if hosts or not _is_loopback(host):
        token = new_token() if token_file is None else kept_token(token_file, port)
    access = Access(token, own_names() | {name.lower() for name in hosts}, view_only)
    return asyncio.run(serve_page(rig, bus, recordings, host, port, access, token_file if token else None))


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
