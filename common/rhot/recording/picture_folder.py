"""Writing pictures of a running rig as a recording folder, which opens whenever the writing ended."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from rhot.errors import ConfigError
from rhot.recording.camera_picture import CameraPicture
from rhot.recording.folder import RECORDING_FILE, TIMES_FILE
from rhot.recording.mcap.gaps import KeyCount
from rhot.recording.tables import TIMES_HEADER
from rhot.rig.folder import write_text_atomic


@dataclass(slots=True)
class _Camera:
    folder: Path
    times: IO[str]
    exposure_s: float
    readout_s: float
    count: KeyCount
    offset: int = 0
    frame: int = -1
    t_ns: int = -1


class PictureFolder:
    """A recording folder that grows; use as a context manager.

    Attributes:
        path: the folder; it appears with the first picture.
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
        self._notes = notes
        self._cameras: dict[str, _Camera] = {}

    def __enter__(self) -> PictureFolder:
        return self

    def __exit__(self, *_: object) -> None:
        for camera in self._cameras.values():
            camera.times.close()

    @property
    def counts(self) -> dict[str, KeyCount]:
        """Pictures written and lost, by camera."""
        return {name: camera.count for name, camera in self._cameras.items()}

    def write(self, picture: CameraPicture) -> None:
        """Add a picture; one that is not later than the camera's last is left out.

        Raises:
            ConfigError: the disk is full, or the folder cannot be written.
        """
        with self._failing_clearly():
            camera = self._cameras.get(picture.camera) or self._begin(picture)
            camera.count.note(picture.seq, len(picture.jpeg))
            if picture.t_ns <= camera.t_ns:
                return
            if picture.frame + camera.offset <= camera.frame:
                # The source counts anew: the rig was stopped and started.
                camera.offset = camera.frame + 1 - picture.frame
            camera.frame, camera.t_ns = picture.frame + camera.offset, picture.t_ns
            (camera.folder / f"{camera.frame:06d}.jpg").write_bytes(picture.jpeg)
            camera.times.write(f"{camera.frame},{camera.t_ns}\n")
            camera.times.flush()

    def _begin(self, picture: CameraPicture) -> _Camera:
        folder = self.path / picture.camera
        folder.mkdir(parents=True)
        times = (folder / TIMES_FILE).open("w", encoding="utf-8")
        times.write(",".join(TIMES_HEADER) + "\n")
        camera = _Camera(folder, times, picture.exposure_s, picture.readout_s, KeyCount())
        self._cameras[picture.camera] = camera
        lines = ["version = 1", f'notes = "{self._notes}"']
        for name, known in sorted(self._cameras.items()):
            lines += ["", f"[cameras.{name}]", f"exposure_s = {known.exposure_s}", f"readout_s = {known.readout_s}"]
        write_text_atomic(self.path / RECORDING_FILE, "\n".join(lines) + "\n")
        return camera

    @contextlib.contextmanager
    def _failing_clearly(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise ConfigError(
                f"{self.path}: pictures cannot be written any more: {error.strerror or error}; those before this open; "
                "make room, or record with --out on another disk"
            ) from error
