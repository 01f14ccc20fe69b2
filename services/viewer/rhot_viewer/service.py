"""The viewer service: shows the running rig as a web page."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import statistics
import time
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field

from rhot.anatomy.markers import own_paints
from rhot.calibration_step import StepContext
from rhot.clock import SystemClock
from rhot.errors import ConfigError
from rhot.messages import Control, ServiceStatus
from rhot.operation.priority import lower_priority
from rhot.rig import BusConfig, Rig
from rhot.rig.file_model import FileModel
from rhot.rig.folder import latest_rig
from rhot.service import Node
from rhot.service.runner import serve
from rhot_viewer.browser.access import Access
from rhot_viewer.browser.camera_layer import marker_colors
from rhot_viewer.browser.overview import Problems
from rhot_viewer.browser.page import Page
from rhot_viewer.browser.rig_scene import RigScene
from rhot_viewer.page_token import links
from rhot_viewer.panels import (
    CalibratePanel,
    CamerasPanel,
    LivePanel,
    Panel,
    PicturesPanel,
    RecordPanel,
    TimelinePanel,
    ViewPanel,
)
from rhot_viewer.panels.live import STATUS_AGE_S
from rhot_viewer.process_priority import NICE, end_within
from rhot_viewer.rig.capture_settings import CaptureSettings
from rhot_viewer.rig.inbox import History, Inbox
from rhot_viewer.rig.live_recording import LiveRecording

logger = logging.getLogger(__name__)


class ViewerConfig(FileModel):
    """What `rhot/config/viewer/<instance>` shows.

    Attributes:
        rate_hz: highest rate at which moving things are sent to the browsers.
        picture_rate_hz: rate at which each camera's image is queried while a browser is connected.
    """

    rate_hz: Annotated[float, Field(ge=1.0, le=120.0)] = 60.0
    picture_rate_hz: Annotated[float, Field(ge=0.2, le=30.0)] = 4.0


class ViewerService:
    """Shows a rig; implements `rhot.service.Service`.

    The page also works before the rig is started and after it has stopped: `show` runs independently of sessions, and
    `run` only marks them.
    """

    name = "viewer"
    instance = "main"
    owns_clock = False

    def __init__(self, page: Page, rig: Rig, bus_config: BusConfig, recordings: Path, other_page: str = "") -> None:
        """Fill the page.

        Args:
            page: an open page.
            rig: loaded.
            bus_config: how the running rig is reached.
            recordings: the one folder below which the page records.
            other_page: address of the page *Grasp*; empty without one.
        """
        self._page = page
        self._rig = rig
        self._config = ViewerConfig()
        self._node: asyncio.Future[Node] = asyncio.get_running_loop().create_future()
        self._inbox = Inbox()
        self._history = History()
        self._problems = Problems()
        self._settings = CaptureSettings(rig.cameras)
        self._scene = RigScene(page, rig, self._inbox, marker_colors(rig))
        pictures = PicturesPanel(
            page, self._scene, self._inbox, rig.cameras, own_paints(rig.config.markers), rig.config.feet
        )
        self._pictures = pictures.feed
        self._calibrate = CalibratePanel(
            page, self._scene, pictures.feed, StepContext(rig.path, bus_config), rig.config
        )
        self._recording = LiveRecording(bus_config, rig.path, recordings)
        self._record = RecordPanel(page, self._recording, rig.path)
        self.panels: list[Panel] = [
            LivePanel(
                self._scene,
                self._inbox,
                self._problems,
                ", ".join(bus_config.connect or bus_config.listen),
                {name: camera.rate_hz for name, camera in rig.config.cameras.items()},
                has_feet=rig.config.feet is not None,
                rig_path=rig.path,
            ),
            pictures,
            CamerasPanel(page, self._settings, self._inbox, tuple(own_paints(rig.config.markers)), pictures.select),
            self._calibrate,
            self._record,
            TimelinePanel(self._history),
            ViewPanel(page, self._scene),
        ]
        gui = page.server.gui
        if other_page:
            gui.add_markdown(f"[Grasp: the hand and the object, in a headset too]({other_page})")
        tabs = gui.add_tab_group()
        for panel in self.panels:
            with tabs.add_tab(panel.title):
                panel.build(gui)

    @property
    def config(self) -> ViewerConfig:
        """The configuration in force."""
        return self._config

    def reconfigure(self, config: BaseModel) -> None:
        """Change the rates.

        Raises:
            ConfigError: not a ViewerConfig.
        """
        if not isinstance(config, ViewerConfig):
            raise ConfigError(f"{type(config).__name__} is not a ViewerConfig")
        self._config = config

    def attach(self, node: Node) -> None:
        """Connect the page to the bus."""
        node.status.watch(self._figures)
        self._node.set_result(node)

    def _figures(self) -> tuple[dict[str, float], str]:
        refused = {f"refused_{kind}": float(count) for kind, count in self._page.guard.refused.items()}
        return {"browsers": float(self._page.browsers), **refused}, ""

    async def run(self, node: Node, start: Control) -> None:
        """Clear the trails and reload the rig folder at the start of a session."""
        self._rig = latest_rig(self._rig)
        self._scene.new_session(self._rig, marker_colors(self._rig))
        await asyncio.Event().wait()

    async def show(self) -> None:
        """Update the page until cancelled."""
        node = await self._node
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._inbox.run(node, self._page))
            tasks.create_task(self._settings.run(node.bus))
            tasks.create_task(
                self._pictures.run(node.bus, lambda: 1.0 / self._config.picture_rate_hz, self._page.looked_at)
            )
            tasks.create_task(self._calibrate.run())
            tasks.create_task(self._recording.run())
            tasks.create_task(self._record.run(node.bus))
            tasks.create_task(self._keep_history())
            tasks.create_task(self._update_panels())
            tasks.create_task(self._send_frames(node))

    async def _send_frames(self, node: Node) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            await self._page.looked_at()
            begun = time.perf_counter()
            self._scene.frame()
            node.status.tick("output")
            node.status.latency("compute", time.perf_counter() - begun)
            # If drawing is slower than the rate, missed frames are skipped.
            due = max(due + 1.0 / self._config.rate_hz, loop.time())
            await asyncio.sleep(due - loop.time())

    async def _update_panels(self) -> None:
        while True:
            await self._page.looked_at()
            for panel in self.panels:
                panel.update()
            panel_interval_s = 0.25
            await asyncio.sleep(panel_interval_s)

    async def _keep_history(self) -> None:
        """Record the figures also without a browser, so that the charts are complete when one connects."""
        while True:
            statuses = self._inbox.all_newest("rhot/status/", ServiceStatus, STATUS_AGE_S)
            self._problems.add(time.strftime("%H:%M:%S"), statuses)
            self._history.add(statuses, self._errors_mm())
            history_interval_s = 1.0
            await asyncio.sleep(history_interval_s)

    def _errors_mm(self) -> dict[str, float]:
        """Return the fingertips' errors (simulation) and the markers' residuals, median, millimetres.

        Empty without a browser, because hands are decoded only while one is connected.
        """
        if not self._page.browsers:
            return {}
        taken, self._scene.seen.tip_errors_mm = self._scene.seen.tip_errors_mm, {}
        errors = {f"{name} tip": statistics.median(values) for name, values in taken.items()}
        for side, pose in self._scene.seen.hands.items():
            if pose.residual:
                errors[f"{side} markers' fit"] = 1e3 * statistics.median(pose.residual.values())
        return errors


def _announce(page: Page, access: Access, token_file: Path | None) -> None:
    logger.info("the page is at %s%s", page.url, ", for looking only" if access.view_only else "")
    if token_file is not None:
        logger.info("links for other machines are in %s", token_file)
    elif access.token:
        for line in links(access, socket.gethostname(), page.port):
            logger.info("%s", line)


async def serve_page(
    rig: Rig,
    bus_config: BusConfig,
    recordings: Path,
    host: str,
    port: int,
    access: Access,
    token_file: Path | None,
    other_page: str = "",
) -> int:
    """Open the page and run the service until SIGINT or SIGTERM; return the exit code.

    Args:
        rig, bus_config, recordings: as `ViewerService`.
        host, port: where to listen.
        access: who may open the page.
        token_file: where the tokens are kept; without one the links stand in the log.
        other_page: address of the page *Grasp*; empty without one.

    Raises:
        DeviceError: the port is taken.
    """
    page = Page(host, port, access)
    lower_priority(NICE)
    try:
        service = ViewerService(page, rig, bus_config, recordings, other_page)
        _announce(page, access, token_file)
        serving = asyncio.create_task(serve(service, bus_config, SystemClock(), on_stop=end_within))
        showing = asyncio.create_task(service.show())
        await asyncio.wait((serving, showing), return_when=asyncio.FIRST_COMPLETED)
        if showing.done():
            serving.cancel()
            showing.result()
        showing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await showing
        return await serving
    finally:
        page.close()
