"""Writing pictures of a running rig as a recording folder, which opens whenever the writing ended.

Whoever reaches the bus may publish pictures: names that are no folder of ours, stamps from the future and a flood of
cameras cost nothing but themselves, and are counted.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final

import cv2
import tomlkit

from rhot.atomic_file import sync_file_system, sync_folder, why
from rhot.bus import Bus, Publisher
from rhot.errors import BusError, ConfigError
from rhot.messages import MAX_PAYLOAD_BYTES
from rhot.recording.camera_picture import PICTURES_KEY, CameraPicture
from rhot.recording.folder import (
    COLOR_FOLDER,
    DEPTH_FOLDER,
    INTRINSICS_FILE,
    RECORDING_FILE,
    TIMES_FILE,
    VIDEO_SUFFIXES,
)
from rhot.recording.mcap.gaps import KeyCount
from rhot.recording.model import MOST_CAMERAS
from rhot.recording.tables import TIMES_HEADER, StampGate
from rhot.rig.folder import write_text_atomic

# Frames to whoever records them: coded only while somebody listens, and never at the tracking's cost.
#
# A thread of its own codes and sends. Where it does not keep up, pictures are dropped and counted.

_MOST_WAITING: Final = 8
"""Frames that may wait to be coded: an eighth of a second, 7 MB of 640x480."""

logger = logging.getLogger(__name__)


class PictureStream:
    """Sends one camera's frames.

    Attributes:
        dropped: frames that were to be sent and were not.
    """

    def __init__(self, camera: str, bus: Bus) -> None:
        """Declare `rhot/@pictures/<camera>`."""
        self.dropped = 0
        self._camera = camera
        self._publisher: Publisher[CameraPicture] = bus.publisher(f"{PICTURES_KEY}/{camera}", CameraPicture, bulk=True)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="pictures")
        self._room = threading.BoundedSemaphore(_MOST_WAITING)
        self._told = False

    @property
    def has_reader(self) -> bool:
        """Whether somebody records."""
        return self._publisher.has_reader

    def submit(self, copy: Callable[[], Callable[[], CameraPicture]]) -> None:
        """Send a frame if somebody listens; returns at once.

        Args:
            copy: called here, only when the frame will be sent: copies what the camera may overwrite, and returns what
                codes the picture, which is called on another thread.
        """
        if not self.has_reader:
            return
        if not self._room.acquire(blocking=False):
            self.dropped += 1
            return
        self._worker.submit(self._send, copy())

    def _send(self, coded: Callable[[], CameraPicture]) -> None:
        try:
            picture = coded()
            size = len(picture.jpeg) + len(picture.depth_png or b"")
            envelope_bytes = 4096
            if size > MAX_PAYLOAD_BYTES - envelope_bytes:
                raise BusError(f"a picture of {size} bytes is over the limit of {MAX_PAYLOAD_BYTES}")
            self._publisher.put(picture)
        except (BusError, cv2.error) as error:
            self.dropped += 1
            if not self._told:
                self._told = True
                logger.warning("camera %s: pictures are not sent: %s", self._camera, error)
        finally:
            self._room.release()


_TAKEN: Final = (".csv", ".toml", *VIDEO_SUFFIXES)
"""Endings of files that mean something in a recording folder; a camera's folder must not be called so."""
_JPEG: Final = b"\xff\xd8\xff"
_PNG: Final = b"\x89PNG"


@dataclass(slots=True)
class _Camera:
    gate: StampGate = field(default_factory=StampGate)
    waiting: list[tuple[CameraPicture, int]] = field(default_factory=list)
    count: KeyCount = field(default_factory=KeyCount)
    folder: Path | None = None
    times: IO[str] | None = None
    exposure_s: float = 0.0
    readout_s: float = 0.0
    has_lens: bool = False
    offset: int = 0
    frame: int = -1
    t_ns: int = -1


class PictureFolder:
    """A recording folder that grows; use as a context manager.

    Attributes:
        path: the folder; it appears with the first picture.
        refused: pictures whose camera cannot be recorded: its name is no folder's, or there are too many.
    """

    def __init__(self, path: Path, notes: str = "") -> None:
        """Prepare.

        Args:
            path: of the folder.
            notes: for people.

        Raises:
            ConfigError: the path is taken.
        """
        if path.exists():
            raise ConfigError(f"{path} exists already and is not overwritten; choose another --out")
        self.path = path
        self.refused = 0
        self._notes = notes
        self._cameras: dict[str, _Camera] = {}

    def __enter__(self) -> PictureFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            for camera in self._cameras.values():
                if camera.times is not None:
                    # Every row was flushed; what a full disk has kept in the buffer was told of then.
                    with contextlib.suppress(OSError):
                        camera.times.close()

    def _finish(self) -> None:
        with self._failing_clearly():
            for camera in self._cameras.values():
                camera.gate.settle()
                self._judge_waiting(camera)
            if self.path.exists():
                self._describe(complete=True)
                self.sync()

    @property
    def counts(self) -> dict[str, KeyCount]:
        """Pictures written, lost and left out, by camera."""
        return {name: camera.count for name, camera in self._cameras.items()}

    @property
    def depth_camera(self) -> Path | None:
        """The folder of the first camera that sends depth; None before its first picture."""
        return next((camera.folder for camera in self._cameras.values() if camera.has_lens), None)

    def write(self, picture: CameraPicture, arrived_ns: int | None = None) -> None:
        """Add a picture; one that is not later than the camera's last, or whose time has not come, is left out.

        Args:
            picture: to add.
            arrived_ns: when it arrived, monotonic; None = its stamp is beyond doubt.

        Raises:
            ConfigError: the disk is full, or the folder cannot be written.
        """
        camera = self._cameras.get(picture.camera)
        if camera is None:
            if len(self._cameras) >= MOST_CAMERAS or not _is_folder_name(picture.camera):
                self.refused += 1
                return
            camera = self._cameras[picture.camera] = _Camera()
        depth = picture.depth_png or b""
        camera.count.note(picture.seq, len(picture.jpeg) + len(depth))
        if not (picture.jpeg.startswith(_JPEG) and (not depth or (depth.startswith(_PNG) and picture.lens))):
            camera.count.left_out += 1
            return
        was_ready = camera.gate.ready
        with self._failing_clearly():
            if arrived_ns is None:
                self._add(camera, picture)
            elif was_ready:
                self._add_if_admitted(camera, picture, arrived_ns)
            else:
                camera.waiting.append((picture, arrived_ns))
                camera.gate.admits(picture.t_ns, arrived_ns)
                if camera.gate.ready:
                    self._judge_waiting(camera)

    def sync(self) -> None:
        """Bring what is written to the disk: a power cut costs what came after this.

        Raises:
            ConfigError: the disk reports that it could not be written.
        """
        if self.path.exists():
            with self._failing_clearly():
                sync_file_system(self.path)

    def _judge_waiting(self, camera: _Camera) -> None:
        waiting, camera.waiting = camera.waiting, []
        for picture, arrived_ns in waiting:
            self._add_if_admitted(camera, picture, arrived_ns)

    def _add_if_admitted(self, camera: _Camera, picture: CameraPicture, arrived_ns: int) -> None:
        if camera.gate.admits(picture.t_ns, arrived_ns):
            self._add(camera, picture)
        else:
            camera.count.left_out += 1

    def _add(self, camera: _Camera, picture: CameraPicture) -> None:
        if picture.t_ns <= camera.t_ns:
            camera.count.left_out += 1
            return
        folder, times = self._place_of(camera, picture)
        if picture.frame + camera.offset <= camera.frame:
            # The counter of the source starts over: the rig was stopped and started.
            camera.offset = camera.frame + 1 - picture.frame
        camera.frame, camera.t_ns = picture.frame + camera.offset, picture.t_ns
        name = f"{camera.frame:06d}"
        ((folder / COLOR_FOLDER if camera.has_lens else folder) / f"{name}.jpg").write_bytes(picture.jpeg)
        if camera.has_lens and picture.depth_png is not None:
            (folder / DEPTH_FOLDER / f"{name}.png").write_bytes(picture.depth_png)
        times.write(f"{camera.frame},{camera.t_ns}\n")
        times.flush()

    def _place_of(self, camera: _Camera, picture: CameraPicture) -> tuple[Path, IO[str]]:
        if camera.folder is None or camera.times is None:
            camera.folder = self.path / picture.camera
            camera.folder.mkdir(parents=True)
            camera.exposure_s, camera.readout_s = picture.exposure_s, picture.readout_s
            camera.has_lens = picture.lens is not None
            if picture.lens is not None:
                (camera.folder / COLOR_FOLDER).mkdir()
                (camera.folder / DEPTH_FOLDER).mkdir()
                write_text_atomic(camera.folder / INTRINSICS_FILE, json.dumps(picture.lens.model_dump()) + "\n")
            camera.times = (camera.folder / TIMES_FILE).open("w", encoding="utf-8")
            camera.times.write(",".join(TIMES_HEADER) + "\n")
            self._describe(complete=False)
            sync_folder(self.path.parent)
        return camera.folder, camera.times

    def _describe(self, *, complete: bool) -> None:
        cameras = {
            name: {"exposure_s": camera.exposure_s, "readout_s": camera.readout_s}
            for name, camera in sorted(self._cameras.items())
            if camera.folder is not None and not camera.has_lens
        }
        content = {"version": 1, "notes": self._notes, "complete": complete, "cameras": cameras}
        write_text_atomic(self.path / RECORDING_FILE, tomlkit.dumps(content))

    @contextlib.contextmanager
    def _failing_clearly(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise ConfigError(
                f"{self.path}: pictures cannot be written any more: {why(error)}; those before this open; or record "
                "with --out on another disk"
            ) from error


def _is_folder_name(camera: str) -> bool:
    """Tell whether a camera's name can be a folder's: `..` leads out of the recording, hidden ones are not read."""
    return not camera.startswith(".") and not camera.lower().endswith(_TAKEN)
