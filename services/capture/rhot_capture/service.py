"""The capture service: frames in, marker positions out."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from pydantic import BaseModel

from rhot.anatomy.markers import own_paints, worn_paints
from rhot.arrays import ImageArray
from rhot.bus import Answer, Bus, Publisher, Request, json_answer
from rhot.clock import NodeClock, difference_ns
from rhot.errors import ConfigError, DeviceError, RhotError
from rhot.messages import Control, MarkerFrame
from rhot.recording.camera_picture import CameraPicture, jpeg_of
from rhot.recording.picture_folder import PictureStream
from rhot.rig import Rig
from rhot.rig.config import CameraConfig
from rhot.rig.file_model import FileModel, Positive
from rhot.rig.folder import latest_rig, load_config, read_json_model, write_json_model
from rhot.rig.sections import Brightness, Contrast, Saturation
from rhot.rig.toml_edit import change_rig_file
from rhot.service import Node
from rhot.service.grabber import Grabber
from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.cutouts import marker_mask
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.detection.result import Detection
from rhot_capture.preview import preview_jpeg, preview_png
from rhot_capture.settings import CameraSettings, LiveColors
from rhot_capture.sources import Frame, ReportsProblem, Source, grab, open_source
from rhot_capture.timing import marker_frame, row_time_ns

# Saves exposure, gain, white balance and picture settings of one camera in `rig.toml`.
#
# Each capture service saves the settings of its own camera, in the rig folder that it was started with, so that a
# camera on another machine also restarts with them. `rhot/keep/capture/<camera>` answers with the state; `?do=save`
# and `?do=undo` change it first. Services that share a folder must be queried one after the other.

_DIGITS: Final = 6


class Optics(FileModel):
    """The saved settings of a camera; fields as in `CameraSettings`."""

    exposure_s: Positive
    gain: Positive
    white_balance: tuple[Positive, Positive]
    saturation: Saturation = 1.0
    contrast: Contrast = 1.0
    brightness: Brightness = 0.0

    @classmethod
    def of(cls, settings: CameraSettings | CameraConfig) -> Optics:
        """Return the saved part of some settings, rounded so that 4 ms are written as 0.004."""
        red, blue = settings.white_balance
        return cls(
            exposure_s=round(settings.exposure_s, _DIGITS),
            gain=round(settings.gain, _DIGITS),
            white_balance=(round(red, _DIGITS), round(blue, _DIGITS)),
            saturation=round(settings.saturation, _DIGITS),
            contrast=round(settings.contrast, _DIGITS),
            brightness=round(settings.brightness, _DIGITS),
        )


class KeepState(FileModel):
    """State of a camera's settings relative to its `rig.toml`.

    Attributes:
        saved: the settings in the file.
        differs: whether the running camera has other settings.
        can_undo: whether there is a previous state to restore.
    """

    saved: Optics
    differs: bool
    can_undo: bool


class KeptOptics:
    """One camera's optics in a rig folder.

    `<camera>.optics.previous.json` beside `rig.toml` holds the values before the last save; comments and all other
    values of `rig.toml` are preserved.
    """

    def __init__(self, rig_path: Path, camera: str) -> None:
        self._rig_path = rig_path
        self._camera = camera
        self._previous = rig_path / f"{camera}.optics.previous.json"

    def saved(self) -> Optics:
        """Return the settings in `rig.toml`.

        Raises:
            ConfigError: the file is invalid, or no longer contains this camera.
        """
        camera = load_config(self._rig_path).cameras.get(self._camera)
        if camera is None:
            raise ConfigError(f"{self._rig_path / 'rig.toml'} names no camera {self._camera} any more")
        return Optics.of(camera)

    def state(self, settings: CameraSettings) -> KeepState:
        """Return the state of the running camera's settings relative to the file; raises as `saved`."""
        saved = self.saved()
        return KeepState(saved=saved, differs=saved != Optics.of(settings), can_undo=self._previous.exists())

    def save(self, settings: CameraSettings) -> None:
        """Write settings into `rig.toml`.

        Raises:
            ConfigError: the file cannot be changed; nothing is written.
        """
        self._write(Optics.of(settings))

    def undo(self) -> Optics:
        """Restore and return the values before the last save; a second call restores the saved values.

        Raises:
            ConfigError: there is no previous state, or `rig.toml` cannot be changed.
        """
        if not self._previous.exists():
            raise ConfigError(f"camera {self._camera}: nothing was saved, so there is nothing to go back to")
        former = read_json_model(self._previous, Optics)
        self._write(former)
        return former

    def _write(self, optics: Optics) -> None:
        before = self.saved()
        # Only changed values are written, so that defaults are not added to the file.
        there = before.model_dump()
        changes = {name: value for name, value in optics.model_dump().items() if value != there[name]}
        change_rig_file(self._rig_path, {("cameras", self._camera): changes})
        write_json_model(self._previous, before)


# Publishes a camera's frames for recording.


class FrameStream(PictureStream):
    """Publishes one camera's frames after detection."""

    def __init__(self, camera: str, bus: Bus) -> None:
        """Declare `rhot/@pictures/<camera>`."""
        super().__init__(camera, bus)
        self._name = camera

    def offer(self, frame: Frame, t_first_row_ns: int) -> None:
        """Send a frame if there is a subscriber; does not block.

        Args:
            frame: its image is copied.
            t_first_row_ns: start of the first row's exposure, rig clock.
        """
        self.submit(
            lambda: partial(
                self._coded, frame.image.copy(), t_first_row_ns, frame.index, frame.exposure_s, frame.readout_s
            )
        )

    def _coded(self, image: ImageArray, t_ns: int, index: int, exposure_s: float, readout_s: float) -> CameraPicture:
        return CameraPicture(
            t_ns=t_ns,
            camera=self._name,
            frame=index,
            exposure_s=exposure_s,
            readout_s=readout_s,
            jpeg=jpeg_of(image),
        )


_PREVIEW_PARAMETERS: Final = ("overlay", "format", "mask")
_PREVIEW_WAIT_S: Final = 0.4
_APPLY_LIMIT_S: Final = 1.5
_KEEP_EVERY_S: Final = 1.0
_LOOK_EVERY: Final = 32
"""Number of frames between two checks of `colors.json` for changes."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Seen:
    """A processed frame for the preview; the image is a copy."""

    image: ImageArray
    table: ColorTable
    detections: dict[str, Detection]
    index: int


def _log_failure(building: Future[None]) -> None:
    """Log an unexpected error of a worker thread, which nobody awaits; the old colours stay in force."""
    if not building.cancelled() and (error := building.exception()) is not None:
        logger.error("new colours failed, the old ones stay: %s", error, exc_info=error)


class CaptureService:
    """Detects the markers in one camera's images; implements `rhot.service.Service`."""

    name = "capture"
    owns_clock = False

    def __init__(self, camera: str, rig: Rig, clock: NodeClock, source: Source | None = None) -> None:
        """Prepare detection.

        Args:
            camera: name of the camera in `rig.toml`.
            rig: the loaded rig; without colours no marker is detected, so that colours can be calibrated.
            clock: the node's clock, on which frames are timed.
            source: of the first session, where it is made already; not yet opened.

        Raises:
            ConfigError: no such camera.
            CalibrationError: `colors.json` is missing or wrong.
        """
        config = rig.config.cameras.get(camera)
        if config is None:
            raise ConfigError(f"no camera {camera} in {rig.path / 'rig.toml'}; it has {', '.join(rig.config.cameras)}")
        self.instance = camera
        self._rig = rig
        self._clock = clock
        self._ahead = source
        self._rate_hz = config.rate_hz
        self._size = (config.width, config.height)
        self._worn = worn_paints(rig.config.markers)
        self._colors = LiveColors(rig, tuple(own_paints(rig.config.markers)), camera)
        self._kept = KeptOptics(rig.path, camera)
        self._settings = self._colors.initial(CameraSettings.from_config(config, self._colors.file))
        self._detector = MarkerDetector(rig.config.markers, self._colors.table, *self._size)
        self._publisher: Publisher[MarkerFrame] | None = None
        self._frame_stream: FrameStream | None = None
        self._grabber: Grabber[Frame] | None = None
        self._source: Source | None = None
        self._building = ThreadPoolExecutor(1, thread_name_prefix="colors")
        self._seen: _Seen | None = None
        self._seen_at = 0.0
        self._wanted = threading.Event()
        self._fresh = threading.Event()
        self._running = False

    @property
    def config(self) -> CameraSettings:
        """The live settings in force."""
        return self._settings

    def reconfigure(self, config: BaseModel) -> None:
        """Change camera and colours while running.

        Raises:
            ConfigError: a value is invalid, or the camera refuses it; all settings stay as they were.
        """
        settings = self._settings.changed(config.model_dump(), self._rate_hz)
        if self._source is not None and not settings.same_optics(self._settings):
            try:
                self._source.apply(settings)
            except ConfigError:
                raise
            except Exception as error:  # whatever the driver raises: a refused setting must not end the service
                raise ConfigError(str(error) or type(error).__name__) from error
        settings = self._colors.with_moved_bounds(settings, self._settings)
        if (settings.tolerances, settings.bounds) != (self._settings.tolerances, self._settings.bounds):
            # Takes a fraction of a second; until then frames are processed with the old colours.
            self._building.submit(self._rebuild, settings).add_done_callback(_log_failure)
        self._settings = settings

    def _rebuild(self, settings: CameraSettings) -> None:
        self._detector.table = self._colors.table_of(settings)

    def _reload(self, node: Node) -> None:
        """Load the new `colors.json`; if it is invalid, the old colours stay in use."""
        try:
            self._colors.reload()
        except RhotError as error:
            node.status.error(f"new colours refused, the old ones stay: {error}")
            return
        self._detector.table = self._colors.table
        self._settings = self._colors.initial(self._settings)
        logger.info("%s: new colours of %s", self.instance, ", ".join(self._colors.file.markers) or "no marker")

    def _look_for_colors(self, node: Node) -> None:
        if self._colors.has_changed():
            self._building.submit(self._reload, node).add_done_callback(_log_failure)

    def attach(self, node: Node) -> None:
        """Declare `rhot/markers`, `rhot/@pictures`, `rhot/preview` and `rhot/keep/capture`, each for this camera."""
        self._publisher = node.bus.publisher(f"rhot/markers/{self.instance}", MarkerFrame)
        self._frame_stream = FrameStream(self.instance, node.bus)
        node.bus.queryable(f"rhot/preview/{self.instance}", self._answer_preview, slow=True)
        loop = asyncio.get_running_loop()
        key = f"rhot/keep/capture/{self.instance}"
        node.bus.queryable(key, lambda request: self._answer_keep(loop, request), slow=True)
        node.status.include(self._counts)
        node.status.watch(self._figures_and_problem)

    def _figures_and_problem(self) -> tuple[dict[str, float], str]:
        red, blue = self._detector.light
        problem = self._source.problem if isinstance(self._source, ReportsProblem) else ""
        return {"light_red": red, "light_blue": blue}, problem

    def _counts(self) -> dict[str, int]:
        unsent = {} if self._frame_stream is None else {"pictures_dropped": self._frame_stream.dropped}
        if self._grabber is None:
            return {"dropped_late": 0, "missed": 0, **unsent}
        counts = self._grabber.counts
        return {"dropped_late": counts.dropped_late, "missed": counts.missed, **unsent}

    async def run(self, node: Node, start: Control) -> None:
        """Open the camera, start at the start time (or join late) and publish until cancelled."""
        source = self._next_source()
        start_ns = start.start_t_ns + difference_ns(node.node_clock.now_ns, node.clock.now_ns)
        grabber = grab(source, self.instance)

        def open_as_set() -> None:
            source.open(start_ns, start.start_t_ns)
            if self._is_changed():
                self._apply_changes(node, source)

        try:
            await grabber.open(open_as_set)
            self._source, self._grabber, self._running = source, grabber, True
            self._seen = None  # a picture of an earlier session is out of date
            self._detector.reset()
            grabber.start()
            # Off the event loop, which answers clock and preview queries meanwhile.
            await grabber.work(partial(self._process, node, asyncio.get_running_loop()))
        except DeviceError as error:
            # Reported before the device is closed, because closing may take long or hang.
            node.status.error(str(error))
            raise
        finally:
            self._source, self._running = None, False
            await grabber.stop()

    def _next_source(self) -> Source:
        """Return the source of a session, by the rig file as it is now: the one made ahead, if it still fits."""
        source, self._ahead, before = self._ahead, None, self._rig.config
        self._follow_rig_file()
        if source is not None and self._rig.config == before:
            return source
        if source is not None:
            source.close()
        return open_source(self.instance, self._rig, self._clock)

    def _follow_rig_file(self) -> None:
        """Apply changes of this camera in `rig.toml`, as far as a running service can."""
        latest = latest_rig(self._rig)
        camera = latest.config.cameras.get(self.instance)
        same = camera is not None and worn_paints(latest.config.markers) == self._worn
        if camera is None or not same or (camera.width, camera.height) != self._size:
            logger.error("%s: cameras or markers of rig.toml have changed; start this service again", self.instance)
            return
        before = CameraSettings.from_config(self._rig.config.cameras[self.instance], self._colors.file)
        after = CameraSettings.from_config(camera, self._colors.file)
        if not after.same_optics(before):
            # The last change wins: the file was written after the sliders were moved.
            self._settings = self._settings.with_optics_of(after)
        self._rig, self._rate_hz = latest, camera.rate_hz

    def _is_changed(self) -> bool:
        return not self._of_rig().same_optics(self._settings)

    def _of_rig(self) -> CameraSettings:
        return CameraSettings.from_config(self._rig.config.cameras[self.instance], self._colors.file)

    def _apply_changes(self, node: Node, source: Source) -> None:
        """Apply settings changed before the camera was opened; if it refuses them, use those of the rig."""
        try:
            source.apply(self._settings)
        except ConfigError as error:
            self._settings = self._settings.with_optics_of(self._of_rig())
            node.status.error(str(error))
            logger.warning("%s; what rig.toml says holds", error)

    def _process(self, node: Node, loop: asyncio.AbstractEventLoop, frame: Frame) -> None:
        """Find a frame's markers and publish them, on the grabber's thread of work."""
        if self._publisher is None or self._frame_stream is None:
            raise RuntimeError("run before attach")
        height = self._size[1]
        middle_ns = row_time_ns(frame.t_first_row_ns, 0.5 * (height - 1), height, frame.exposure_s, frame.readout_s)
        age_s = (self._clock.now_ns() - middle_ns) / 1e9
        detections, detect_s = self._detect(frame)
        first_row_ns = node.clock.to_rig_ns(frame.t_first_row_ns)
        message = marker_frame(
            self.instance,
            self._size,
            detections,
            first_row_ns,
            frame.exposure_s,
            frame.readout_s,
            frame.index,
            {"age": age_s, "detect": detect_s},
            self._settings.outlines,
        )
        self._publisher.put(message)
        output_age_s = (node.clock.now_ns() - message.t_ns) / 1e9
        self._frame_stream.offer(frame, first_row_ns)
        latencies = {"frame_age": age_s, "detect": detect_s, "output_age": output_age_s}
        loop.call_soon_threadsafe(self._note, node, frame.index, latencies)

    def _note(self, node: Node, index: int, latencies: Mapping[str, float]) -> None:
        node.status.tick("frames")
        for stage, seconds in latencies.items():
            node.status.latency(stage, seconds)
        if index % _LOOK_EVERY == 0:
            self._look_for_colors(node)

    def _detect(self, frame: Frame) -> tuple[dict[str, Detection], float]:
        begun = time.perf_counter()
        detections = self._detector.detect(frame.image)
        seconds = time.perf_counter() - begun
        if self._wanted.is_set() or begun - self._seen_at > _KEEP_EVERY_S:
            # Copied, because the image may be the camera's memory; only while somebody requests previews.
            self._seen = _Seen(frame.image.copy(), self._detector.table, detections, frame.index)
            self._seen_at = begun
            self._wanted.clear()
            self._fresh.set()
        return detections, seconds

    def _answer_keep(self, loop: asyncio.AbstractEventLoop, request: Request) -> Answer:
        """Save or undo the optics, or save colour bounds, and return their state; runs on a worker thread."""
        wanted = request.parameters.get("do")
        if wanted == "save":
            self._kept.save(self._settings)
        elif wanted == "save_bounds":
            self._colors.save_bounds(self._settings)
        elif wanted == "undo":
            optics = self._kept.undo().model_dump()

            async def apply() -> None:
                self.reconfigure(self._settings.model_copy(update=optics))

            asyncio.run_coroutine_threadsafe(apply(), loop).result(timeout=_APPLY_LIMIT_S)
        elif wanted is not None:
            raise ConfigError(f"do={wanted}: only do=save, do=undo and do=save_bounds are known")
        return json_answer(self._kept.state(self._settings).model_dump(mode="json"))

    def _answer_preview(self, request: Request) -> Answer:
        """Answer with a picture of the newest frame; runs on a worker thread."""
        if request.wants_json:
            width, height = self._size
            return json_answer(
                {"width": width, "height": height, "query": "?overlay=markers, ?mask=<marker> or ?format=png"}
            )
        if self._running:
            self._fresh.clear()
            self._wanted.set()
            self._fresh.wait(_PREVIEW_WAIT_S)
        seen = self._seen
        if seen is None:
            raise DeviceError(f"camera {self.instance} has delivered no frame yet; is the rig started (`rhot start`)?")
        # Zenoh's own parameters begin with an underscore.
        unknown = [name for name in request.parameters if name not in _PREVIEW_PARAMETERS and name[:1] != "_"]
        if unknown:
            raise ConfigError(f"{unknown[0]}: only overlay=markers, mask=<marker> and format= are known")
        overlay = request.parameters.get("overlay", "")
        if overlay not in ("", "markers"):
            raise ConfigError(f"overlay={overlay}: only overlay=markers is known")
        coding = request.parameters.get("format", "jpeg")
        if coding not in ("jpeg", "png"):
            raise ConfigError(f"format={coding}: only format=jpeg, format=png and format=json are known")
        name = request.parameters.get("mask")
        mask = None if name is None else marker_mask(seen.image, seen.table, self._worn.get(name, name))
        code = preview_png if coding == "png" else preview_jpeg
        return Answer(code(seen.image, seen.detections if overlay else None, mask), f"image/{coding}")
