"""Saves exposure, gain, white balance and picture settings of one camera in `rig.toml`.

Each capture service saves the settings of its own camera, in the rig folder that it was started with, so that a camera
on another machine also restarts with them. `rhot/keep/capture/<camera>` answers with the state; `?do=save` and
`?do=undo` change it first. Services that share a folder must be queried one after the other.
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
