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
from rhot_viewer.grasp.server import page_tls
from rhot_viewer.grasp.serving import serve_grasp
from rhot_viewer.page_token import kept_token, new_token


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
@click.option("--view-only", is_flag=True, help="Refuse all changes from the page, even on this machine.")
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
@click.option(
    "--xr",
    is_flag=True,
    help="Serve the page Grasp instead: the hand and the object, on a desktop or in a headset.",
)
@click.option("--other-page", default="", metavar="URL", help="Address of the other page of this rig, for a link.")
@rig_option
@bus_options
def viewer(
    host: str,
    port: int,
    view_only: bool,
    token_file: Path | None,
    hosts: tuple[str, ...],
    recordings: Path,
    xr: bool,
    other_page: str,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> int:
    """Show the running rig as a web page, until Ctrl-C.

    Open http://localhost:8080 in a browser: the hand and what else is tracked, what each camera sees, the state of
    every service, and sliders for the cameras. Several browsers may connect at once. Nothing is loaded from the
    internet.

    Only this machine can open the page. For a tablet, add --host 0.0.0.0: the log then shows two links, one read-only
    and one with full access. Other machines cannot connect without a link, and websites that you visit cannot access
    the page.

    With --xr it is the page Grasp (docs/grasp.md): the tracked hand grasps the tracked object's twin, on a desktop or
    in a headset's browser. Both pages can run side by side, each on its own port. A stand-alone headset needs https:
    --xr uses the rig's certificates (`rhot keys make`) as soon as --host lets other machines in.
    """
    # It logs every connection; the page itself reports who looks.
    logging.getLogger("websockets").setLevel(logging.WARNING)
    bus = tool_bus(rig_path, connect, namespace)
    rig = load_rig(rig_path)
    remote = bool(hosts) or not _is_loopback(host)
    tls = page_tls(bus) if xr and remote else None
    scheme = "http" if tls is None else "https"
    token = ""
    if remote:
        token = new_token() if token_file is None else kept_token(token_file, port, scheme)
    access = Access(token, own_names() | {name.lower() for name in hosts}, view_only)
    links_file = token_file if token else None
    if xr:
        return asyncio.run(serve_grasp(rig, bus, host, port, access, other_page, tls, links_file))
    # Grasp does without it, and loading it takes a second.
    from rhot_viewer.service import serve_page  # noqa: PLC0415

    return asyncio.run(serve_page(rig, bus, recordings, host, port, access, links_file, other_page))


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
