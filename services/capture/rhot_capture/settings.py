"""The settings that may change while a camera runs: its optics and the width of each marker's colour."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final

from pydantic import Field, ValidationError

from rhot.errors import ConfigError
from rhot.messages import Name, first_problem
from rhot.rig.colors import ColorsFile, Tolerance
from rhot.rig.config import CameraConfig
from rhot.rig.file_model import FileModel, NotNegative, Positive
from rhot.rig.picture_config import PICTURE_NEUTRAL, Brightness, Contrast, Saturation
from rhot_capture.color_bounds import ColorBounds

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
