"""What may change while a camera runs: its optics, the width of each marker's colour, and the colours themselves."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field, ValidationError, model_validator

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.messages import Name, first_problem
from rhot.rig import Rig
from rhot.rig.colors import ColorsFile, HsvRangeColor, Share, Tolerance, load_colors
from rhot.rig.config import CameraConfig
from rhot.rig.file_model import FileModel, NotNegative, Positive
from rhot.rig.kept_file import KeptFile, file_stamp
from rhot.rig.sections import PICTURE_NEUTRAL, Brightness, Contrast, Saturation
from rhot_capture.detection.color_table import ColorTable, build_color_table, hsv_of, table_colors

# The colours of a running camera: `colors.json` as it changes, and the live settings.

# Bounds of a marker's colour in hue, saturation and value, for the sliders of the page.
#
# A learned colour is a distribution, not a box. Its bounds are percentiles of the colours that it labels. Once a user
# has moved them, the bounds replace the learned colour as an `hsv_range`.

_TYPICAL: Final = 255.0 * np.exp(-0.5 * 2.0**2)
"""Likelihood two standard deviations from the mean of a class."""
_ENDS: Final = (1.0, 99.0)
"""Percentiles used as bounds of a learned colour, so that single cells of the table do not matter."""

Degrees = Annotated[float, Field(ge=0.0, le=360.0)]


class ColorBounds(FileModel):
    """Bounds of one marker's colour.

    Attributes:
        hue_deg: from, to, degrees on the colour circle; 340 to 20 passes through red.
        saturation: lowest and highest, 0 to 1.
        value: lowest and highest, 0 to 1.
        in_force: whether these bounds replace the colour in colors.json; otherwise they only describe it.
    """

    hue_deg: tuple[Degrees, Degrees]
    saturation: tuple[Share, Share]
    value: tuple[Share, Share]
    in_force: bool = False

    @model_validator(mode="after")
    def _ordered(self) -> ColorBounds:
        self.color(1.0)
        return self

    def color(self, tolerance: float) -> HsvRangeColor:
        """Return these bounds as a colour range."""
        return HsvRangeColor(hue_deg=self.hue_deg, saturation=self.saturation, value=self.value, tolerance=tolerance)


def bounds_of(colors: ColorsFile, table: ColorTable) -> dict[Name, ColorBounds]:
    """Return the bounds of all colours that label at least one cell of the table.

    Args:
        colors: the colours from which the table was built.
        table: the table of their markers.
    """
    hsv = hsv_of(table_colors())
    found = {}
    for label, name in enumerate(table.names, start=1):
        color = colors.markers.get(name)
        if isinstance(color, HsvRangeColor):
            found[name] = ColorBounds(hue_deg=color.hue_deg, saturation=color.saturation, value=color.value)
            continue
        claimed = hsv[(table.labels == label) & (table.likelihoods >= _TYPICAL)]
        if len(claimed):
            found[name] = _around(claimed)
    return found


def with_bounds(colors: ColorsFile, bounds: Mapping[str, ColorBounds]) -> ColorsFile:
    """Return colours in which the bounds in force replace the learned colours."""
    ranges = {
        name: each.color(colors.markers[name].tolerance)
        for name, each in bounds.items()
        if each.in_force and name in colors.markers
    }
    return colors.model_copy(update={"markers": {**colors.markers, **ranges}})


def _around(hsv: FloatArray) -> ColorBounds:
    angle = np.radians(hsv[:, 0])
    middle = np.degrees(np.arctan2(np.sin(angle).mean(), np.cos(angle).mean()))
    offset = (hsv[:, 0] - middle + 180.0) % 360.0 - 180.0
    start, end = (float(np.round(middle + at) % 360.0) for at in np.percentile(offset, _ENDS))
    (low_s, low_v), (high_s, high_v) = np.round(np.percentile(hsv[:, 1:], _ENDS, axis=0), 2).tolist()
    return ColorBounds(hue_deg=(start, end), saturation=(low_s, high_s), value=(low_v, high_v))


# The colours of a running camera: `colors.json` as it changes, and the live settings.

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


# The settings that may change while a camera runs: its optics and the width of each marker's colour.

OPTICS: Final = ("exposure_s", "gain", "white_balance", "focus_dioptres", *PICTURE_NEUTRAL)
"""Fields of `CameraSettings` that are also in rig.toml."""


class CameraSettings(FileModel):
    """Live settings of one camera node.

    Attributes:
        exposure_s: exposure time, seconds; a V4L2 camera supports only this one of the first four.
        gain: analogue gain.
        white_balance: red and blue gains.
        focus_dioptres: lens position; None leaves it unchanged.
        saturation, contrast, brightness: of the picture; 1, 1 and 0 leave it unchanged.
        tolerances: marker name to the factor on the width of its colour; above 1 includes more colours.
        bounds: marker name to the bounds of its colour; see `ColorBounds`.
        outlines: whether the outline of each marker is published.
    """

    exposure_s: Annotated[float, Field(gt=0.0, le=1.0)]
    gain: Annotated[float, Field(ge=1.0, le=64.0)]
    white_balance: tuple[Positive, Positive]
    focus_dioptres: NotNegative | None = None
    saturation: Saturation = 1.0
    contrast: Contrast = 1.0
    brightness: Brightness = 0.0
    tolerances: dict[Name, Tolerance] = {}
    bounds: dict[Name, ColorBounds] = {}
    outlines: bool = False

    @classmethod
    def from_config(cls, camera: CameraConfig, colors: ColorsFile) -> CameraSettings:
        """Return the initial settings of a camera."""
        return cls(
            exposure_s=camera.exposure_s,
            gain=camera.gain,
            white_balance=camera.white_balance,
            focus_dioptres=camera.focus_dioptres,
            saturation=camera.saturation,
            contrast=camera.contrast,
            brightness=camera.brightness,
            tolerances={name: color.tolerance for name, color in colors.markers.items()},
        )

    def changed(self, changes: Mapping[str, Any], rate_hz: float) -> CameraSettings:
        """Return the settings with some of them replaced; `tolerances` and `bounds` may name single markers.

        Args:
            changes: field name to new value.
            rate_hz: frame rate, which bounds the exposure.

        Raises:
            ConfigError: an unknown field or marker, or a value out of bounds; these settings stay as they are.
        """
        data = {**self.model_dump(), **changes}
        for field in ("tolerances", "bounds"):
            parts, mine = changes.get(field, {}), getattr(self, field)
            if isinstance(parts, Mapping):
                unknown = [str(name) for name in parts if name not in mine]
                if unknown:
                    known = ", ".join(mine) or "none"
                    raise ConfigError(f"{field}.{unknown[0]}: no such marker; this camera knows {known}")
                data[field] = {**mine, **parts}
        try:
            settings = CameraSettings.model_validate(data)
        except ValidationError as error:
            raise ConfigError(first_problem(error)) from error
        if settings.exposure_s > 1.0 / rate_hz:
            raise ConfigError(
                f"exposure_s: {settings.exposure_s:g} s is longer than a frame at {rate_hz:g} Hz; "
                f"at most {1.0 / rate_hz:.6f} s"
            )
        return settings

    @property
    def optics(self) -> dict[str, Any]:
        """Settings of the camera itself by field: exposure, gain, white balance, focus and picture."""
        return {name: getattr(self, name) for name in OPTICS}

    @property
    def picture(self) -> dict[str, float]:
        """Saturation, contrast and brightness, by field."""
        return {name: getattr(self, name) for name in PICTURE_NEUTRAL}

    def same_lens_and_sensor(self, other: CameraSettings) -> bool:
        """Return whether exposure, gain, white balance and focus are equal; picture and colours may differ."""
        return all(getattr(self, name) == getattr(other, name) for name in OPTICS if name not in PICTURE_NEUTRAL)

    def same_optics(self, other: CameraSettings) -> bool:
        """Return whether all settings of the camera itself are equal; colours may differ."""
        return self.optics == other.optics

    def with_optics_of(self, other: CameraSettings) -> CameraSettings:
        """Return these settings with the optics of others."""
        return self.model_copy(update=other.optics)
