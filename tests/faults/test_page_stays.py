"""The page Grasp in a real browser while each service of a tracking rig is killed: it comes back by itself."""

from __future__ import annotations

import asyncio
import signal
import time
from pathlib import Path

import pytest
from page.browser import CHROMIUM, Browser, open_browser
from page.viewer_process import ViewerProcess
from played_rig import PATIENCE_S, PROCESSES, PlayedRig

from rhot.rig import write_json_model
from rhot.rig.folder import NO_REGISTRATION, REGISTRATION_FILE, RIG_FILE
from rhot_viewer.grasp.files import is_built

pytestmark = [
    pytest.mark.integration,
    pytest.mark.faults,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (Debian: apt install chromium)"),
    pytest.mark.skipif(not is_built(), reason="the page Grasp is not built: make web (needs node and npm)"),
]
EXPECTED = "ERR_CONNECTION_REFUSED"
"""What Chromium itself writes to its console while the page's own server is away."""


async def shows(browser: Browser, name: str, after_s: float) -> None:
    """Wait until a hand or an object that was true after a moment of the rig's clock is drawn."""
    kind = "hands" if name == "right" else "objects"
    condition = (
        f"rhot.rig.{kind}.get('{name}')?.track.newest.t > {1e3 * after_s} "
        f"&& (rhot.drawn.{name} || rhot.twins.{name}) && document.getElementById('state').className !== 'bad'"
    )
    await asyncio.to_thread(browser.wait_for, condition)


async def test_the_page_comes_back_after_every_service(rig: PlayedRig, tmp_path: Path, free_port: int) -> None:
    with (rig.folder / RIG_FILE).open("a") as file:
        file.write('\n[objects.cube]\nsource = "simulated"\n')
    write_json_model(rig.folder / REGISTRATION_FILE, NO_REGISTRATION)
    objects = ["objects", "--rig", str(rig.folder), "--connect", rig.endpoint]
    await rig.supervisor.start("objects", objects)
    page = ViewerProcess(
        ["--xr", "--rig", str(rig.folder), "--connect", rig.endpoint], free_port, tmp_path / "page.log"
    )
    await asyncio.to_thread(page.start)
    try:
        with open_browser(page.url, 480, 320) as browser:
            for name in (*PROCESSES, "objects"):
                await shows(browser, "right", time.time())
                before = rig.pids()[name]
                rig.signal(name, signal.SIGKILL)
                async with asyncio.timeout(PATIENCE_S):
                    if name == "objects":
                        # The rig's supervisor keeps only what ran when it began.
                        await rig.child(name).process.wait()
                        rig.supervisor.children.remove(rig.child(name))
                        await rig.supervisor.start(name, objects)
                    while rig.pids().get(name, before) == before:
                        await asyncio.sleep(0.02)
                again_s = time.time()
                await shows(browser, "right", again_s)
                await shows(browser, "cube", again_s)
                assert browser.errors == [], name
            await asyncio.to_thread(page.stop)
            await asyncio.to_thread(browser.wait_for, "!rhot.link.connected")
            again_s = time.time()
            await asyncio.to_thread(page.start)
            await shows(browser, "right", again_s)
            await shows(browser, "cube", again_s)
            assert [error for error in browser.errors if EXPECTED not in error] == []
    finally:
        page.kill()
