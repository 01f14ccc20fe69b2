"""`rhot viewer`."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

import click

from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.rig import load_rig
from rhot_viewer.service import serve_page


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on; 0.0.0.0 lets others look.")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="Port of the page; 0 takes any."
)
@rig_option
@bus_options
def viewer(host: str, port: int, rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Show the running rig as a web page, until Ctrl-C.

    Open http://localhost:8080 in a browser: the hand and what else is tracked, what each camera sees, how every service
    does, and sliders for the cameras. Several browsers may look at once. Nothing is fetched from the internet.

    Only this machine can open the page. For a tablet, add --host 0.0.0.0 and open http://ADDRESS:8080; then everybody
    on the network can look and move the sliders.
    """
    # It logs every connection; the page itself reports who looks.
    logging.getLogger("websockets").setLevel(logging.WARNING)
    bus = tool_bus(rig_path, connect, namespace)
    return asyncio.run(serve_page(load_rig(rig_path), bus, host, port))
