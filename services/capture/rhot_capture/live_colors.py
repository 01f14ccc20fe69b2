"""The colours of a running camera: `colors.json` as it changes, and the live settings."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from rhot.errors import ConfigError
from rhot.rig import Rig
from rhot.rig.colors import ColorsFile, load_colors
from rhot.rig.kept_file import KeptFile, file_stamp
from rhot_capture.color_bounds import bounds_of, with_bounds
from rhot_capture.detection.color_table import ColorTable, build_color_table
from rhot_capture.settings import CameraSettings

logger = logging.getLogger(__name__)


class LiveColors:
    """Colours of the markers of one camera.

    Attributes:
        file: `colors.json` as last read; empty if it is missing.
        table: built from the file, without live settings.
    """

    def __init__(self, rig: Rig, names: Sequence[str], camera: str) -> None:
        """Read `colors.json`; if it is missing, no marker is detected, so that colours can be calibrated.

        Args:
            rig: the loaded rig.
            names: markers in the order of their labels.
            camera: name of the camera.

        Raises:
            CalibrationError: the file is invalid.
        """
        self._path = rig.colors_path
        self._names = tuple(names)
        self._camera = camera
        self._stamp = file_stamp(self._path)
        self.file = self._read()
        self.table = build_color_table(self.file, self._names, camera)
        self._shown = bounds_of(self.file, self.table)

    def has_changed(self) -> bool:
        """Return whether `colors.json` has changed since the last call."""
        before, self._stamp = self._stamp, file_stamp(self._path)
        return self._stamp != before

    def reload(self) -> None:
        """Read `colors.json` again.

        Raises:
            RhotError: the file is invalid; the former colours stay in use.
        """
        file = self._read()
        self.table = build_color_table(file, self._names, self._camera)
        self._shown = bounds_of(file, self.table)
        self.file = file

    def initial(self, settings: CameraSettings) -> CameraSettings:
        """Return settings with the tolerances and bounds of the file."""
        tolerances = {name: color.tolerance for name, color in self.file.markers.items()}
        return settings.model_copy(update={"tolerances": tolerances, "bounds": self._shown})

    def with_moved_bounds(self, settings: CameraSettings, before: CameraSettings) -> CameraSettings:
        """Return settings with moved bounds in force, and released bounds reset to those of the file's colours.

        Args:
            settings: the requested settings.
            before: the settings in force until now.
        """
        bounds = dict(settings.bounds)
        for name, each in settings.bounds.items():
            former = before.bounds.get(name)
            if each.in_force or each == former:
                continue
            released = former is not None and former.in_force
            bounds[name] = self._shown[name] if released else each.model_copy(update={"in_force": True})
        return settings.model_copy(update={"bounds": bounds})

    def in_force(self, settings: CameraSettings) -> ColorsFile:
        """Return the file's colours with the tolerances and bounds of settings."""
        return with_bounds(self.file, settings.bounds).with_tolerances(settings.tolerances)

    def table_of(self, settings: CameraSettings) -> ColorTable:
        """Return the colour table of `in_force`; takes a fraction of a second."""
        return build_color_table(self.in_force(settings), self._names, self._camera)

    def save_bounds(self, settings: CameraSettings) -> None:
        """Write the bounds in force to `colors.json`, from which all cameras of the folder reload them.

        Raises:
            ConfigError: no bounds are in force, the page is trying out colours, or the folder cannot be written.
        """
        if not any(each.in_force for each in settings.bounds.values()):
            raise ConfigError("no bounds are in force, so there is nothing to save; move a colour's bounds first")
        kept = KeptFile(self._path, ColorsFile)
        if kept.on_trial:
            raise ConfigError(f"{self._path}: colours are on trial; save or undo them in the step Colours first")
        kept.try_out(self.in_force(settings))
        kept.save()

    def _read(self) -> ColorsFile:
        if self._path.exists():
            return load_colors(self._path)
        logger.warning("%s is missing: no marker is found until `rhot calibrate colors` has written it", self._path)
        return ColorsFile(markers={})
