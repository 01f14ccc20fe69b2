"""The service of the page *Grasp*: sends the rig's poses to browsers, and publishes a headset's poses."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Mapping
from typing import Annotated, Any, Final

from pydantic import BaseModel, Field

from rhot.bus import LatestSubscriber
from rhot.errors import BusError, ConfigError, WireError
from rhot.messages import BodyPose, Control, FootPose, HandPose, HeadPose, Message, ObjectPose, Space, Truth, decode
from rhot.object_mesh import known_mesh, known_shape
from rhot.rig import Rig
from rhot.rig.calibration import RigidTransform
from rhot.rig.file_model import FileModel
from rhot.rig.folder import HAND_FILE, REGISTRATION_FILE, RIG_FILE, STAGE_FILE, latest_rig, registration_name
from rhot.rig.kept_file import file_stamp
from rhot.service import Node
from rhot_viewer.browser.access import Access, Role
from rhot_viewer.browser.camera_layer import marker_colors
from rhot_viewer.browser.guard import Guard
from rhot_viewer.grasp.hello import hello_text
from rhot_viewer.grasp.newest import Newest
from rhot_viewer.grasp.server import Browser, GraspServer
from rhot_viewer.grasp.text import text_of
from rhot_viewer.grasp.uplink import (
    CONTROLLER,
    HEAD,
    WEBXR,
    Devices,
    DrawingFigures,
    Left,
    Moved,
    controller_pose,
    head_pose,
)

logger = logging.getLogger(__name__)

_KEYS: Final[Mapping[str, type[Message]]] = {
    "rhot/hand/*": HandPose,
    "rhot/object/*": ObjectPose,
    "rhot/head": HeadPose,
    "rhot/foot/*": FootPose,
    "rhot/body": BodyPose,
    "rhot/truth": Truth,
    "rhot/space/*": Space,
}
_HAND: Final = "rhot/hand/"
_TRUTH: Final = "rhot/truth"
_SPACES: Final = "rhot/space/*"
_LEAD_S: Final = 0.1
"""Time after a hand in which only hands trigger a frame; other new samples are sent with them."""
_LOOK_S: Final = 0.5
"""Interval at which the rig folder is checked for changes."""
_FILES: Final = (RIG_FILE, HAND_FILE, STAGE_FILE, REGISTRATION_FILE, registration_name(WEBXR))


class GraspConfig(FileModel):
    """What `rhot/config/viewer/grasp` shows.

    Attributes:
        rate_hz: most frames per second for each browser; a browser may ask for fewer.
    """

    rate_hz: Annotated[float, Field(ge=1.0, le=120.0)] = 120.0


class GraspService:
    """Serves the page, with and without a session; implements `rhot.service.Service`."""

    name = "viewer"
    instance = "grasp"
    owns_clock = False

    def __init__(self, rig: Rig, access: Access, other_page: str) -> None:
        """Prepare.

        Args:
            rig: loaded.
            access: who may open the page.
            other_page: address of the page for working on the rig; empty without one.
        """
        self._rig = rig
        self._other_page = other_page
        self._config = GraspConfig()
        self._node: Node | None = None
        self._guard = Guard(access)
        self._newest = Newest()
        self._hand_s = -math.inf
        self._wearer: Browser | None = None
        self._moved = False
        self.server = GraspServer(
            self._guard, self._newest, self._hello, self._now_ms, self._handle, self._gone, self._mesh
        )

    @property
    def config(self) -> GraspConfig:
        """The configuration in force."""
        return self._config

    def reconfigure(self, config: BaseModel) -> None:
        """Change the rate.

        Raises:
            ConfigError: not a GraspConfig.
        """
        if not isinstance(config, GraspConfig):
            raise ConfigError(f"{type(config).__name__} is not a GraspConfig")
        self._config = config
        self.server.limit(config.rate_hz)

    def attach(self, node: Node) -> None:
        """Start the work that runs with and without a session."""
        self._node = node
        node.status.watch(self._figures)
        node.beside(lambda: self._follow_as_wanted(node))
        node.beside(self._close_server_before_bus)
        node.beside(lambda: self._ask_for_spaces(node))
        node.beside(self._follow_folder)

    def _figures(self) -> tuple[dict[str, float], str]:
        refused = {f"refused_{kind}": float(count) for kind, count in self._guard.refused.items()}
        problem = ""
        if self._moved:
            problem = (
                "the headset's floor has been moved since it was registered: `rhot calibrate objects --live --object "
                f"{CONTROLLER}` registers it again"
            )
        figures = {"browsers": float(len(self.server.browsers)), "headset": float(self._wearer is not None), **refused}
        shown = [browser.shown for browser in self.server.browsers if browser.shown is not None]
        if shown:
            figures["pictures_hz"] = min(one.pictures_hz for one in shown)
            figures["clock_ms"] = max(one.clock_ms for one in shown)
            figures["without_graphics"] = float(sum(not one.graphics for one in shown))
        return figures, problem

    async def run(self, node: Node, start: Control) -> None:
        """Wait until cancelled: a session changes nothing."""
        await asyncio.Event().wait()

    async def _follow_as_wanted(self, node: Node) -> None:
        """Subscribe to the keys that browsers show, while they show them: unread poses take 5 % of a core."""
        followed: dict[str, LatestSubscriber] = {}
        async with asyncio.TaskGroup() as tasks:
            while True:
                self.server.audience_changed.clear()
                for keys, model in _KEYS.items():
                    if self._wanted(keys) and keys not in followed:
                        followed[keys] = node.bus.latest(keys)
                        tasks.create_task(self._follow(node, keys, followed[keys], model))
                    elif keys in followed and not self._wanted(keys):
                        await node.bus.unsubscribe(followed.pop(keys))
                await self.server.audience_changed.wait()

    async def _follow(self, node: Node, keys: str, mailbox: LatestSubscriber, model: type[Message]) -> None:
        async for sample in mailbox:
            if (message := node.read(sample, model)) is None:
                continue
            mailbox.keep_slot_of(sample.key)
            waited_s = (time.monotonic_ns() - sample.arrived_ns) / 1e9
            rare = keys == _SPACES
            self._store(sample.key, message, math.nan if rare else self._now_ms() - 1e3 * waited_s)
            if not rare:
                node.status.tick("input")
                node.status.latency("to_page", (time.monotonic_ns() - sample.arrived_ns) / 1e9)

    def _wanted(self, keys: str) -> bool:
        if keys == _SPACES:
            return True
        if keys == _TRUTH:
            return any(browser.wants_truth for browser in self.server.browsers)
        return bool(self.server.browsers)

    def _store(self, key: str, message: Message, bus_ms: float = math.nan) -> None:
        text = text_of(message)
        if text is None:
            return
        self._newest.put(key, text, bus_ms)
        now_s = time.monotonic()
        if key.startswith(_HAND):
            self._hand_s = now_s
        elif now_s - self._hand_s < _LEAD_S:
            return
        self.server.wake()

    async def _close_server_before_bus(self) -> None:
        """Close the server before the bus, because a connected headset would publish on a closed bus."""
        try:
            await asyncio.Event().wait()
        finally:
            await self.server.close()

    async def _ask_for_spaces(self, node: Node) -> None:
        """Query the spaces, which may have been published before this process started."""
        with contextlib.suppress(BusError):
            repeat_s = 1.0
            for reply in await node.bus.get(_SPACES, timeout_s=repeat_s):
                if not reply.error:
                    with contextlib.suppress(WireError):
                        self._store(reply.key, decode(reply.payload, Space))

    async def _follow_folder(self) -> None:
        """Reload the rig folder when it changes, so that a new hand, floor or registration is shown at once."""
        stamps = None
        while True:
            now = tuple(file_stamp(self._rig.path / name) for name in _FILES)
            if now != stamps:
                if stamps is not None:
                    self._rig, self._moved = latest_rig(self._rig), False
                    await self.server.send_hello()
                stamps = now
            await asyncio.sleep(_LOOK_S)

    @property
    def _devices(self) -> list[str]:
        return [name for name, thing in self._rig.config.objects.items() if thing.source == "webxr"]

    def _now_ms(self) -> float:
        node = self._node
        return node.clock.now_ns() / 1e6 if node is not None and node.clock.ready else math.nan

    def _hello(self, role: Role) -> str:
        rig = self._rig
        return hello_text(rig, marker_colors(rig), self._other_page, role == "control", self._devices)

    def _mesh(self, name: str) -> bytes | None:
        mesh = known_mesh(self._rig, name)
        return None if mesh is None else mesh.content

    def _handle(self, browser: Browser, message: Any) -> None:
        if isinstance(message, Devices):
            if self._wearer is None:
                self._wearer = browser
                logger.info("a headset is here")
            if self._wearer is browser:
                self._publish(message)
        elif isinstance(message, DrawingFigures):
            if self._node is not None:
                for wait_ms in message.waits_ms:
                    self._node.status.latency("to_picture", 1e-3 * wait_ms)
        elif isinstance(message, Left):
            self._gone(browser)
        elif isinstance(message, Moved) and self._wearer is browser and not self._moved:
            self._moved = True
            logger.warning("the headset's floor has been moved by its wearer: register it again")

    def _gone(self, browser: Browser) -> None:
        if self._wearer is browser:
            self._wearer = None
            logger.info("the headset has gone")

    def _publish(self, devices: Devices) -> None:
        node = self._node
        if node is None or not node.clock.ready:
            return
        registration = self._rig.registration_of(WEBXR)
        T_rig_webxr = registration.T_rig_tracker.matrix
        wanted = self._devices
        try:
            if devices.head is not None and HEAD in wanted:
                node.publish("rhot/head", head_pose(devices.head, devices.t_ms, T_rig_webxr))
            if devices.controller is not None and CONTROLLER in wanted:
                fixed = registration.T_tracker_object.get(CONTROLLER, RigidTransform.identity()).matrix
                pose = controller_pose(
                    devices.controller, devices.t_ms, T_rig_webxr, fixed, known_shape(self._rig, CONTROLLER)
                )
                node.publish(f"rhot/object/{CONTROLLER}", pose)
        except ValueError:
            node.status.count("invalid")
