"""ROS 2's Zenoh middleware rmw_zenoh: keys, liveliness tokens and attachments.

A topic's key is `<domain>/<topic>/<package>::msg::dds_::<Type>_/<type hash>`. Each node and each publisher has a
liveliness token, by which `ros2 topic list` and other tools discover it:

    @ros2_lv/<domain>/<zid>/<node id>/<id>/NN/%/%/<node>
    @ros2_lv/<domain>/<zid>/<node id>/<id>/MP/%/%/<node>/<topic, / as %>/<type>/<type hash>/<quality of service>

(an empty enclave and namespace are `%`; `::,10:,:,:,,` is the default quality of service). Every message carries as
attachment a sequence number from 1 and a time in ns (8 bytes each, little-endian), the byte 16, and the publisher's id
of 16 bytes.
Source: rmw_zenoh, docs/design.md and `attachment_helpers.cpp`, versions from Jazzy on.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import zenoh

from rhot.bus.zenoh_config import plain_reason, session_config
from rhot.errors import DeviceError
from rhot.rig import BusConfig
from rhot_bridge.output import Opened

logger = logging.getLogger(__name__)

NODE: Final = "rhot"
DEFAULT_QOS: Final = "::,10:,:,:,,"
MOST_TOPICS: Final = 128
"""Largest number of topics of one node; a rig has about ten."""
_RETRY_S: Final = 5.0
"""Pause before a topic that could not be declared is declared again."""
_ID_BYTES: Final = 16
_CLOSE_LIMIT_S: Final = 1.0


def topic_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """Return the key of a topic such as `/rhot/head` with a type such as `geometry_msgs/msg/PoseStamped`."""
    return f"{domain}/{topic.strip('/')}/{dds_type(type_name)}/{type_hash}"


def dds_type(type_name: str) -> str:
    """Return the middleware's name of a type, such as `geometry_msgs::msg::dds_::PoseStamped_`."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def node_token(domain: int, zid: str) -> str:
    """Return the liveliness token of our node."""
    return f"@ros2_lv/{domain}/{zid}/0/0/NN/%/%/{NODE}"


def publisher_token(domain: int, zid: str, number: int, topic: str, type_name: str, type_hash: str) -> str:
    """Return the liveliness token of a publisher; numbers count from 1 in the node."""
    mangled = topic.replace("/", "%")
    return f"@ros2_lv/{domain}/{zid}/0/{number}/MP/%/%/{NODE}/{mangled}/{dds_type(type_name)}/{type_hash}/{DEFAULT_QOS}"


def attachment(sequence: int, t_ns: int, publisher_id: bytes) -> bytes:
    """Return the attachment of a message."""
    return struct.pack(f"<qqB{_ID_BYTES}s", sequence, t_ns, _ID_BYTES, publisher_id)


@dataclass(slots=True)
class _Publisher:
    publisher: Any
    token: Any
    id: bytes
    sequence: int = 0

    def undeclare(self) -> None:
        """Undeclare publisher and token."""
        for declared in (self.token, self.publisher):
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()


class RmwZenohLink:
    """A separate session with a Zenoh router: ROS's (`rmw_zenohd`), or the rig's router if ROS uses it."""

    def __init__(self, host: str, port: int, domain: int, type_hash: Callable[[str], str]) -> None:
        self._host, self._port = host, port
        self._domain = domain
        self._type_hash = type_hash
        self._session: zenoh.Session | None = None
        self._node: Any = None
        self._publishers: Opened[_Publisher] = Opened(MOST_TOPICS)
        self._announcing: dict[str, asyncio.Task[None]] = {}
        self._announced = 0
        self._looked_ns = 0
        self._problem = ""

    @property
    def where(self) -> str:
        """The router's address and the ROS domain, for people."""
        return f"ROS 2 (rmw_zenoh) at {self._host} port {self._port}, domain {self._domain}"

    @property
    def problem(self) -> str:
        """That the router is gone; empty while it is there."""
        return self._problem

    async def open(self) -> None:
        """Open the session and declare the node.

        Raises:
            DeviceError: no router answers, or it refuses the node.
        """
        config = BusConfig(connect=(f"tcp/{self._host}:{self._port}",))
        try:
            self._session = await asyncio.to_thread(zenoh.open, session_config(config))
            self._node = self._session.liveliness().declare_token(node_token(self._domain, self._zid()))
        except zenoh.ZError as error:
            await self.close()
            raise DeviceError(
                f"no Zenoh router answers at {self._host} port {self._port}; start `ros2 run rmw_zenoh_cpp "
                f"rmw_zenohd`, or name it with --host and --port (Zenoh: {plain_reason(error)})"
            ) from error
        self._problem = ""

    def wanted(self, now_ns: int) -> bool:
        """Return whether a router is there; checked once a second."""
        session = self._session
        if session is None:
            return False
        look_ns = 1_000_000_000
        if now_ns - self._looked_ns >= look_ns:
            self._looked_ns = now_ns
            there = bool(session.info.routers_zid())
            problem = "" if there else f"the Zenoh router at {self._host} port {self._port} has gone; it is tried again"
            if problem != self._problem:
                logger.info("%s", problem or f"the Zenoh router at {self._host} port {self._port} is back")
            self._problem = problem
        return not self._problem

    def put(self, topic: str, type_name: str, payload: bytes) -> bool | None:
        """Send a message; return whether it was sent, None while its topic is being declared.

        Declaring a topic waits for the router, so it runs on a worker thread.
        """
        publisher = self._publishers.get(topic)
        if publisher is None:
            if self._session is not None and topic not in self._announcing and self._has_room():
                self._announced += 1
                announcing = self._announce(self._session, self._announced, topic, type_name)
                self._announcing[topic] = asyncio.create_task(announcing)
            return None
        publisher.sequence += 1
        try:
            publisher.publisher.put(payload, attachment=attachment(publisher.sequence, time.time_ns(), publisher.id))
        except zenoh.ZError:
            return False
        return True

    def _has_room(self) -> bool:
        return self._publishers.make_room(len(self._announcing), _Publisher.undeclare)

    async def _announce(self, session: zenoh.Session, number: int, topic: str, type_name: str) -> None:
        type_hash = self._type_hash(type_name)
        key = topic_key(self._domain, topic, type_name, type_hash)
        token = publisher_token(self._domain, self._zid(), number, topic, type_name, type_hash)

        def declare() -> _Publisher:
            publisher = session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                reliability=zenoh.Reliability.RELIABLE,
            )
            publisher_id = hashlib.blake2b(token.encode(), digest_size=_ID_BYTES).digest()
            declared = session.liveliness().declare_token(token)
            return _Publisher(publisher, declared, publisher_id)

        try:
            self._publishers.add(topic, await asyncio.to_thread(declare))
            logger.info("ROS topic %s is there, %s", topic, type_name)
        except zenoh.ZError as error:
            logger.warning("ROS topic %s cannot be announced: %s", topic, plain_reason(error))
            # Keeps the next frame from declaring it again at once.
            await asyncio.sleep(_RETRY_S)
        finally:
            self._announcing.pop(topic, None)

    def _zid(self) -> str:
        if self._session is None:
            raise RuntimeError("not open")
        return str(self._session.info.zid())

    async def close(self) -> None:
        """Close the session with everything that it has declared."""
        session, self._session = self._session, None
        announcing = list(self._announcing.values())
        for task in announcing:
            task.cancel()
        await asyncio.gather(*announcing, return_exceptions=True)
        self._announcing.clear()
        self._publishers.clear()
        self._node = None
        if session is not None:
            # On a daemon thread, because a close that hangs must not keep the process alive.
            closer = threading.Thread(target=session.close, name="rhot-ros2-close", daemon=True)
            closer.start()
            await asyncio.to_thread(closer.join, _CLOSE_LIMIT_S)
