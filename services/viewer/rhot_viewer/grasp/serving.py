"""Opening the page *Grasp* and running its service in this process."""

from __future__ import annotations

import logging
import socket
import ssl
from pathlib import Path
from typing import Final

from rhot.clock import SystemClock
from rhot.operation.priority import lower_priority
from rhot.rig import BusConfig, Rig
from rhot.service.runner import serve
from rhot_viewer.browser.access import Access, page_address
from rhot_viewer.grasp import files
from rhot_viewer.grasp.service import GraspService
from rhot_viewer.page_token import links
from rhot_viewer.process_priority import end_within

logger = logging.getLogger(__name__)

_NICE: Final = 3
"""Forwarding a pose takes half a millisecond, so half of a tracker's share of a busy processor is enough. With the
viewer page's 10 levels, it would wait behind all other processes on two busy cores."""


async def serve_grasp(
    rig: Rig,
    bus_config: BusConfig,
    host: str,
    port: int,
    access: Access,
    other_page: str,
    tls: ssl.SSLContext | None,
    token_file: Path | None,
) -> int:
    """Open the page and run the service until SIGINT or SIGTERM; return the exit code.

    Args:
        rig, access, other_page: as `GraspService`.
        bus_config: how the running rig is reached.
        host, port: where to listen.
        tls: for HTTPS; None = plain.
        token_file: where the tokens are kept; without one the links stand in the log.

    Raises:
        DeviceError: the port is taken.
    """
    lower_priority(_NICE)
    service = GraspService(rig, access, other_page)
    found = await service.server.open(host, port, tls)
    scheme = "http" if tls is None else "https"
    try:
        logger.info("Grasp is at %s", page_address(host, found, scheme))
        if not files.is_built():
            logger.warning("the page is not built: run `make web` (needs node and npm)")
        if token_file is not None:
            logger.info("links for other machines are in %s", token_file)
        elif access.token:
            for line in links(access, socket.gethostname(), found, scheme):
                logger.info("%s", line)
            if tls is None:
                logger.warning(
                    "headsets open this page as a page, but start no session over plain http from another machine: "
                    "make certificates (`rhot keys make --address …`), and it is served over https"
                )
        return await serve(service, bus_config, SystemClock(), on_stop=end_within)
    finally:
        # Needed if the bus was never reached; otherwise the service has closed the server.
        await service.server.close()
