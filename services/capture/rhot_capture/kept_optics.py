"""What was set with the sliders, kept: exposure, gain, whites and picture of one camera in its node's own `rig.toml`.

Each capture service keeps its own camera's, in the rig folder that it was started with, so that a camera on another
machine comes up again as it was left, too. `rhot/keep/capture/<camera>` answers how things stand; with `?do=save` and
`?do=undo` it changes them first. Two services that share a folder must be asked one after the other.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from rhot.errors import ConfigError
from rhot.rig.config import CameraConfig
from rhot.rig.file_model import FileModel, Positive
from rhot.rig.folder import load_config, read_json_model, write_json_model
from rhot.rig.picture_config import Brightness, Contrast, Saturation
from rhot.rig.toml_edit import change_rig_file
from rhot_capture.settings import CameraSettings

_DIGITS: Final = 6


class Optics(FileModel):
    """What is kept of a camera's settings; fields as in `CameraSettings`."""

    exposure_s: Positive
    gain: Positive
    white_balance: tuple[Positive, Positive]
    saturation: Saturation = 1.0
    contrast: Contrast = 1.0
    brightness: Brightness = 0.0

    @classmethod
    def of(cls, settings: CameraSettings | CameraConfig) -> Optics:
        """Return what is kept, rounded so that a slider's 4 ms are written as 0.004."""
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
    """How a camera's settings stand to its `rig.toml`.

    Attributes:
        saved: what the file says.
        differs: the running camera is set otherwise.
        can_undo: there is a former state to go back to.
    """

    saved: Optics
    differs: bool
    can_undo: bool


class KeptOptics:
    """One camera's optics in a rig folder.

    The values before the last saving are in `<camera>.optics.previous.json` beside `rig.toml`; comments and all other
    values of `rig.toml` stay as they are, whatever was changed there meanwhile.
    """

    def __init__(self, rig_path: Path, camera: str) -> None:
        self._rig_path = rig_path
        self._camera = camera
        self._previous = rig_path / f"{camera}.optics.previous.json"

    def saved(self) -> Optics:
        """Return what `rig.toml` says.

        Raises:
            ConfigError: it cannot be used, or names this camera no longer.
        """
        camera = load_config(self._rig_path).cameras.get(self._camera)
        if camera is None:
            raise ConfigError(f"{self._rig_path / 'rig.toml'} names no camera {self._camera} any more")
        return Optics.of(camera)

    def state(self, settings: CameraSettings) -> KeepState:
        """Return how the running camera's settings stand to the file; raises as `saved`."""
        saved = self.saved()
        return KeepState(saved=saved, differs=saved != Optics.of(settings), can_undo=self._previous.exists())

    def save(self, settings: CameraSettings) -> None:
        """Write settings into `rig.toml`.

        Raises:
            ConfigError: it cannot be changed; nothing is.
        """
        self._write(Optics.of(settings))

    def undo(self) -> Optics:
        """Bring back what was there before the last saving, and return it; twice brings the saved values back.

        Raises:
            ConfigError: there is nothing to go back to, or `rig.toml` cannot be changed.
        """
        if not self._previous.exists():
            raise ConfigError(f"camera {self._camera}: nothing was saved, so there is nothing to go back to")
        former = read_json_model(self._previous, Optics)
        self._write(former)
        return former

    def _write(self, optics: Optics) -> None:
        before = self.saved()
        # Only what changes: a file that says nothing of a picture goes on saying nothing.
        there = before.model_dump()
        changes = {name: value for name, value in optics.model_dump().items() if value != there[name]}
        change_rig_file(self._rig_path, {("cameras", self._camera): changes})
        write_json_model(self._previous, before)
