"""The feet service: depth camera, ankle sensors and the head's poses in, `rhot/foot/<side>` out."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Final

import cv2
from pydantic import BaseModel

from rhot.bus import EventSubscriber
from rhot.errors import ConfigError, DeviceError, RhotError
from rhot.messages import Control, FootPose, HeadPose, Side
from rhot.plugins import load_simulated
from rhot.rig import Rig
from rhot.rig.feet_config import FeetConfig, ImuConfig
from rhot.rig.folder import latest_rig
from rhot.service import Node
from rhot.service.configuration import serve_rig_files
from rhot.service.device_thread import CLOSE_LIMIT_S, OPEN_LIMIT_S, DeviceThread
from rhot.service.grabber import Grabber, GrabberCounts
from rhot.service.spaces import publish_spaces
from rhot_feet.foot_core import FootCore
from rhot_feet.frames import DepthFrame, DepthSource
from rhot_feet.imu.samples import ImuSource
from rhot_feet.input_stream import CAMERA, InputStream
from rhot_feet.preview import FeetPreview
from rhot_feet.sources.imu.recorded import RecordedSource
from rhot_feet.sources.imu.serial import SerialSource

# Make the source that the rig folder asks for.


def make_imu_source(config: ImuConfig, folder: Path, simulated: ImuSource | None = None) -> ImuSource:
    """Return the source of one ankle's sensor, not yet open.

    Args:
        config: of the sensor.
        folder: of the rig; a recording's path counts from it.
        simulated: the sensor of the simulated world, where there is one.

    Raises:
        ConfigError: a simulated sensor is asked for outside of a simulation.
    """
    if config.source == "serial":
        return SerialSource(config)
    if config.source == "recorded":
        return RecordedSource(folder / (config.path or ""), loop=config.loop)
    if simulated is None:
        raise ConfigError(
            'imu source = "simulated" exists only in `rhot sim --feet`; name a serial port or a recording'
        )
    return simulated


def plan_sensors(rig: Rig, feet: FeetConfig) -> dict[Side, ImuSource]:
    """Return the inertial sensors of a rig by foot, not yet open; all simulated ones share one world.

    Raises:
        ConfigError: a sensor cannot be what the rig says.
    """
    configs = {side: foot.imu for side, foot in feet.feet.items() if foot.imu is not None}
    simulated: dict[Side, ImuSource] = {}
    if any(config.source == "simulated" for config in configs.values()):
        simulated = load_simulated("imu")(rig, list(configs))
    return {side: make_imu_source(config, rig.path, simulated.get(side)) for side, config in configs.items()}


# Choosing a depth camera by its kind in `rig.toml`; each kind is imported only when it is asked for.


def open_depth_source(rig: Rig, now_ns: Callable[[], int]) -> DepthSource:
    """Return the depth camera of a rig, not yet opened.

    Args:
        rig: the loaded rig.
        now_ns: rig time.

    Raises:
        ConfigError: the rig has no feet.
    """
    feet = rig.config.feet
    if feet is None:
        raise ConfigError(f"{rig.path / 'rig.toml'} has no [feet]; add [feet.left] or [feet.right] with marker_id")
    camera = feet.camera
    if camera.source == "realsense":
        from rhot_feet.sources.depth_camera.realsense import RealSenseSource  # noqa: PLC0415

        return RealSenseSource(camera, now_ns)
    if camera.source == "recorded":
        from rhot_feet.sources.depth_camera.recorded_frames import (  # noqa: PLC0415
            RecordedDepthSource,
            load_depth_recording,
        )

        path = rig.resolve(camera.path or "")
        return RecordedDepthSource(lambda: load_depth_recording(path), now_ns, loop=camera.loop)
    source: DepthSource = load_simulated("depth_camera").from_rig(rig, now_ns)
    return source


# The newest picture of a depth camera; see `rhot.service.grabber`.


class DepthGrabber(Grabber[DepthFrame]):
    """Reads an opened source on its own thread.

    Attributes:
        busy_s: processor time of the thread: the driver's work and, in a simulation, the drawing.
    """

    def __init__(self, source: DepthSource) -> None:
        """Prepare to read a source; `open` opens it."""
        super().__init__("depth camera", self._read, source.close)
        self._source = source
        self.busy_s = 0.0

    def _read(self) -> Iterator[DepthFrame | None]:
        while not self._source.finished:
            read_s = 0.5
            frame = self._source.read(read_s)
            self.busy_s = time.thread_time()
            yield frame
            del frame


logger = logging.getLogger(__name__)

HEAD_KEY: Final = "rhot/head"
_RETRY_S: Final = 2.0
_HEAD_LATE_S: Final = 0.15
"""Longest wait of an image for the head's pose."""
_HEADLESS_S: Final = 2.0
"""Time without a head pose after which it is reported as missing."""
_PERIOD_S: Final = 0.01
"""Interval of reading the ankle sensors and of publishing poses."""


class FeetService:
    """Publishes `rhot/foot/<side>`; implements `rhot.service.Service`."""

    name = "feet"
    instance = "main"

    def __init__(
        self,
        rig: Rig,
        *,
        open_camera: Callable[[Rig, Callable[[], int]], DepthSource] = open_depth_source,
        sensors: Callable[[Rig, FeetConfig], dict[Side, ImuSource]] = plan_sensors,
    ) -> None:
        """Create the tracking core.

        Args:
            rig: the loaded rig.
            open_camera: returns the depth camera, not yet open, given the rig and a function that returns the rig time.
            sensors: returns the inertial sensors by foot, not yet open.

        Raises:
            ConfigError: the rig has no feet, or they cannot be tracked as it says.
        """
        if rig.config.feet is None:
            raise ConfigError(f"{rig.path / 'rig.toml'} names no feet; add [feet.left] or [feet.right] with marker_id")
        self._rig = rig
        self._config = rig.config.feet
        self._open_camera = open_camera
        self._plan_sensors = sensors
        # A rig without hands has no fusion service, which owns the rig clock otherwise.
        self.owns_clock = not rig.config.cameras
        self._T_head_camera = rig.T_head_camera
        self._stage = FootCore(self._config, self._T_head_camera)
        sensors(rig, self._config)
        self._sensors: dict[Side, ImuSource] = {}
        self._failures: dict[Side, asyncio.Future[None]] = {}
        self._grabber: DepthGrabber | None = None
        self._troubles: dict[str, str] = {}
        self._heads: EventSubscriber | None = None
        self._inputs: InputStream | None = None
        self._preview = FeetPreview()
        self._head_came = asyncio.Event()
        self._head_known_s = 0.0
        # Detection takes some milliseconds, during which samples must still be processed.
        self._looking = ThreadPoolExecutor(1, thread_name_prefix="look")

    @property
    def config(self) -> FeetConfig:
        """`[feet]` of the rig."""
        return self._config

    def reconfigure(self, config: BaseModel) -> None:
        """Refuse all changes: feet are configured in `rig.toml`.

        Raises:
            ConfigError: always.
        """
        raise ConfigError("feet are described in rig.toml; change it there and restart this service")

    def attach(self, node: Node) -> None:
        """Subscribe to the head, declare the recorded inputs; a foot's key is declared with its first pose."""
        self._heads = node.bus.events(HEAD_KEY)
        self._inputs = InputStream(node.bus, self._config.feet)
        node.bus.queryable(f"rhot/preview/{CAMERA}", self._preview.answer, slow=True)
        node.status.include(self._counts)
        node.status.watch(self._figures)
        if self.owns_clock:
            publish_spaces(node, self._rig.path)
            serve_rig_files(node.bus, self._rig.path)

    def _counts(self) -> Mapping[str, int]:
        counts = GrabberCounts() if self._grabber is None else self._grabber.counts
        unsent = 0 if self._inputs is None else self._inputs.dropped
        return {
            **self._stage.counts,
            "dropped_late": counts.dropped_late,
            "missed": counts.missed,
            "pictures_dropped": unsent,
        }

    def _figures(self) -> tuple[Mapping[str, float], str]:
        grabber_s = 0.0 if self._grabber is None else self._grabber.busy_s
        # Both are cumulative: their increase per second is the number of cores in use.
        figures = {"processor_s": time.process_time(), "camera_processor_s": grabber_s}
        return figures, "; ".join(self._troubles.values())

    async def run(self, node: Node, start: Control) -> None:
        """Read camera and sensors until cancelled; a missing device does not delay the others."""
        if self._heads is None:
            raise RuntimeError("run before attach")
        self._T_head_camera = latest_rig(self._rig).T_head_camera
        self._start_over()
        self._troubles.clear()
        self._head_known_s = asyncio.get_running_loop().time()
        heads, sources = self._heads, self._plan_sensors(self._rig, self._config)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._follow_head(node, heads))
            tasks.create_task(self._keep("depth camera", node, lambda: self._watch(node, start)))
            for side, source in sources.items():
                tasks.create_task(self._keep(f"{side} sensor", node, partial(self._use_sensor, start, side, source)))
            tasks.create_task(self._publish(node))

    async def _keep(self, device: str, node: Node, use: Callable[[], Awaitable[None]]) -> None:
        """Use a device; after a failure, use it again every two seconds."""
        while True:
            try:
                await use()
                # The end of a recording.
                return
            except DeviceError as error:
                node.status.count("device_errors")
                node.status.error(str(error))
                if self._troubles.get(device) != str(error):
                    logger.warning("%s: %s; looking again every %.0f s", device, error, _RETRY_S)
                self._troubles[device] = str(error)
            await asyncio.sleep(_RETRY_S)

    def _works(self, device: str) -> None:
        if self._troubles.pop(device, None) is not None:
            logger.info("%s: is there again", device)

    async def _follow_head(self, node: Node, heads: EventSubscriber) -> None:
        async for pose in node.receive(heads, HeadPose):
            node.status.tick("heads")
            self._stage.add_head_pose(pose)
            self._head_came.set()

    async def _await_head(self, t_ns: int) -> None:
        """Wait for the head's pose at a time, as long as poses are arriving."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_HEAD_LATE_S):
                while self._stage.awaits_head(t_ns):
                    self._head_came.clear()
                    await self._head_came.wait()

    def _knows_head(self, *, known: bool) -> None:
        """Record whether an image's head pose was known; report it when it has been missing for long."""
        now_s = asyncio.get_running_loop().time()
        if known:
            self._head_known_s = now_s
            self._works(HEAD_KEY)
        elif now_s - self._head_known_s > _HEADLESS_S and HEAD_KEY not in self._troubles:
            self._troubles[HEAD_KEY] = (
                f"{HEAD_KEY}: no measured pose of the head for the time of the pictures, so that they cannot be used; "
                "is `rhot objects`, or what else publishes it, running?"
            )
            logger.warning("%s", self._troubles[HEAD_KEY])

    async def _watch(self, node: Node, start: Control) -> None:
        source = self._open_camera(self._rig, node.clock.now_ns)
        grabber = self._grabber = DepthGrabber(source)
        try:
            await grabber.open(partial(source.open, start.start_t_ns))
            grabber.start()
            self._preview.begin()
            while (frame := await grabber.next_frame()) is not None:
                self._works("depth camera")
                if self._inputs is not None:
                    self._inputs.offer(frame)
                await self._look(node, frame)
        finally:
            self._preview.end()
            await grabber.stop()

    async def _look(self, node: Node, frame: DepthFrame) -> None:
        status, stage = node.status, self._stage
        status.tick("frames")
        status.latency("frame_age", (node.clock.now_ns() - frame.t_ns) / 1e9)
        await self._await_head(frame.t_ns)
        begun = time.perf_counter()
        try:
            view = stage.predict(frame)
            self._knows_head(known=view is not None)
            if view is None:
                self._preview.offer(frame, None)
                return
            seen = await asyncio.get_running_loop().run_in_executor(self._looking, stage.detect, view)
            stage.update(seen)
            self._preview.offer(frame, seen)
        except (ValueError, ArithmeticError, cv2.error) as error:
            self._failed(node, error)
        status.latency("picture", time.perf_counter() - begun)

    async def _use_sensor(self, start: Control, side: Side, source: ImuSource) -> None:
        device = DeviceThread(f"{side} sensor")
        try:
            await device.call("open", partial(source.open, start.start_t_ns), OPEN_LIMIT_S)
            self._sensors[side] = source
            # `_publish` reads the sensor, so that poses use its newest samples; here only failures are awaited.
            failed = self._failures[side] = asyncio.get_running_loop().create_future()
            await failed
        finally:
            self._sensors.pop(side, None)
            try:
                await device.call("close", source.close, CLOSE_LIMIT_S)
            finally:
                device.end()

    def _read_sensors(self, node: Node) -> None:
        for side, source in list(self._sensors.items()):
            try:
                samples = source.read(node.clock.now_ns())
            except Exception as error:  # whatever a driver raises: one sensor ends no service
                del self._sensors[side]
                if not self._failures[side].done():
                    known = isinstance(error, RhotError)
                    self._failures[side].set_exception(error if known else DeviceError(f"{side} sensor: {error!r}"))
                continue
            if len(samples):
                self._works(f"{side} sensor")
                node.status.counts[f"{side}_samples"] += len(samples)
                self._stage.add_imu_samples(side, samples)
                if self._inputs is not None:
                    self._inputs.offer_samples(side, samples)

    async def _publish(self, node: Node) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        published_ns = 0
        ahead_ns = node.clock.now_ns() - time.monotonic_ns()
        while True:
            begun = time.perf_counter()
            now_ns = node.clock.now_ns()
            before_ns, ahead_ns = ahead_ns, now_ns - time.monotonic_ns()
            # A larger step of the rig clock resets the tracking, because older state would reject all new
            # measurements for as long as the step.
            if abs(ahead_ns - before_ns) > 500_000_000:
                logger.warning("the rig clock was set by %.1f s; the feet start over", (ahead_ns - before_ns) / 1e9)
                self._start_over()
                published_ns = 0
            try:
                self._read_sensors(node)
                t_ns = self._stage.due_ns(now_ns)
                outputs = self._stage.poses(t_ns) if t_ns > published_ns else []
            except (ValueError, ArithmeticError) as error:
                self._failed(node, error)
                outputs = []
            else:
                published_ns = max(published_ns, t_ns)
            node.status.latency("pose", time.perf_counter() - begun)
            for key, message in outputs:
                node.publish(key, message)
                if isinstance(message, FootPose):
                    node.status.tick(f"{message.side}_{message.stage}")
            # If processing is slower than the rate, missed cycles are skipped.
            due = max(due + _PERIOD_S, loop.time())
            await asyncio.sleep(due - loop.time())

    def _failed(self, node: Node, error: Exception) -> None:
        """Count an error of the core and reset it, so that the service continues."""
        node.failed(error)
        self._start_over()

    def _start_over(self) -> None:
        self._stage = FootCore(self._config, self._T_head_camera)
