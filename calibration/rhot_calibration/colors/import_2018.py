"""Colours and camera settings of the original 2018 tracker, in the terms of `colors.json` and `rig.toml`.

Its settings are percentages for the raspicam library, which turned them into camera parameters: `Exposure` 0 to 100
into a shutter time of 0 to 330 ms, `Gain` 0 to 100 into ISO 0 to 800, white balance 0 into automatic, `Brightness`,
`Contrast` and `Saturation` around a neutral 50 (raspicam, `RaspiCam_Cv::set`). On the camera module v2, ISO 100
is an overall gain of 1.84 (picamera documentation, `PiCamera.iso`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rhot.atomic_file import why_unread
from rhot.errors import ConfigError
from rhot.rig.colors import ColorsFile, RgbBoxColor
from rhot.text import parse_json, read_text

_SHUTTER_S: Final = 0.33
_ISO: Final = 800.0
_NEUTRAL: Final = 50.0
_PERCENTAGES: Final = ("Exposure", "Gain", "Brightness", "Contrast", "Saturation")
_WHITE_BALANCE: Final = ("awb red", "awb blue")


@dataclass(frozen=True, slots=True)
class ImportedSettings:
    """Camera settings as far as they have an equivalent.

    Attributes:
        lines: for the table of a camera in `rig.toml`.
        remarks: what has no equivalent or needs a decision, for people.
    """

    lines: tuple[str, ...]
    remarks: tuple[str, ...]


def load_camera_settings(path: Path) -> ImportedSettings:
    """Read a `cameraCalib.json` of the original tracker.

    Raises:
        ConfigError: not such a file, or a value out of bounds; names the field.
    """
    values = _read(path)
    lines: list[str] = []
    remarks: list[str] = []
    if values["Exposure"] > 0.0:
        lines.append(f"exposure_s = {_SHUTTER_S * values['Exposure'] / 100.0:.4f}")
    else:
        remarks.append("Exposure = 0 was automatic; rhot locks it: set exposure_s yourself, 0.004 is a good start")
    iso = _ISO * values["Gain"] / 100.0
    gain_at_iso_100 = 1.84
    gain = iso / 100.0 * gain_at_iso_100
    if iso > 0.0:
        gain_bounds = (1.0, 64.0)
        low, high = gain_bounds
        lines.append(f"gain = {min(max(gain, low), high):.2f}")
        remarks.append(
            f"gain: Gain = {values['Gain']:g} was ISO {iso:.0f}, an overall gain of about {gain:.2f} on a camera "
            "module v2; part of it was digital, so look at a picture before you trust it"
        )
    else:
        remarks.append("Gain = 0 was automatic ISO; rhot locks it: set gain yourself, 4 is a good start")
    red, blue = (values[name] for name in _WHITE_BALANCE)
    if red > 0.0 and blue > 0.0:
        lines.append(f"white_balance = [{red:.2f}, {blue:.2f}]")
    else:
        remarks.append(
            "awb red, awb blue = 0 was automatic white balance; rhot locks it: set white_balance so that white paper "
            "looks grey. Colours taken under an automatic one fit only roughly: calibrate again from pictures"
        )
    remarks += [
        f"{name} = {values[name]:g} (neutral was {_NEUTRAL:g}) has no equivalent: rhot leaves the image processor's "
        "curve alone, so the imported colour limits will not fit exactly"
        for name in ("Brightness", "Contrast", "Saturation")
        if values[name] != _NEUTRAL
    ]
    return ImportedSettings(tuple(lines), tuple(remarks))


def load_box_calibration(path: Path, markers: Sequence[str]) -> ColorsFile:
    """Read the colour file of the original 2018 tracker: RGB limits as strings, one entry per colour.

    Args:
        path: JSON with `colors: [{"rLower": "0", "rUpper": "60", …}, …]`.
        markers: marker names in the order of the file's entries.

    Raises:
        ConfigError: not such a file, limits that contradict each other (names the entry and the field), or fewer
            colours than markers are named.
    """
    data = _json(path)
    entries = data.get("colors") if isinstance(data, dict) else None
    if not isinstance(entries, list):
        raise ConfigError(f"{path}: holds no list `colors` of RGB limits, as colorCalibration.json of 2018 does")
    mode = data.get("colorMode", "rgb")
    if mode != "rgb":
        raise ConfigError(f"{path}: colorMode = {mode!r}: only rgb limits can be read")
    if len(entries) < len(markers):
        raise ConfigError(f"{path}: holds {len(entries)} colours, too few for {', '.join(markers)}")
    boxes = [_limits(f"{path}: colors[{number}]", entry) for number, entry in enumerate(entries)]
    return ColorsFile(markers=dict(zip(markers, boxes, strict=False)))


def _limits(where: str, entry: Any) -> RgbBoxColor:
    """Return one entry's limits; `where` names file and entry in errors."""
    if not isinstance(entry, dict):
        raise ConfigError(f"{where} is not a set of RGB limits but {entry!r:.60}")
    limits: dict[str, list[float]] = {"Lower": [], "Upper": []}
    for channel in "rgb":
        for end, values in limits.items():
            field = f"{channel}{end}"
            if field not in entry:
                raise ConfigError(f"{where}.{field} is missing")
            values.append(_number(f"{where}.{field}", entry[field], 255.0))
        if limits["Lower"][-1] > limits["Upper"][-1]:
            raise ConfigError(
                f"{where}: {channel}Lower = {limits['Lower'][-1]:g} is above {channel}Upper = {limits['Upper'][-1]:g}; "
                "swap them"
            )
    (low_r, low_g, low_b), (high_r, high_g, high_b) = limits["Lower"], limits["Upper"]
    return RgbBoxColor(low=(low_r, low_g, low_b), high=(high_r, high_g, high_b))


def rig_lines(settings: ImportedSettings, cameras: Sequence[str]) -> str:
    """Return the lines to put into `rig.toml`, for all cameras."""
    return "\n".join(f"[cameras.{camera}]\n" + "\n".join(settings.lines) for camera in cameras)


def _read(path: Path) -> dict[str, float]:
    data = _json(path)
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: holds a {type(data).__name__} where camera settings are expected")
    values = {}
    for name in (*_PERCENTAGES, *_WHITE_BALANCE):
        if name not in data:
            raise ConfigError(f"{path}: {name} is missing; a cameraCalib.json of the 2018 tracker has it")
        values[name] = _number(f"{path}: {name}", data[name], 100.0)
    return values


def _number(field: str, value: Any, most: float) -> float:
    """Return a number from 0 to `most`; `field` names file and field in errors."""
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{field} = {value!r} is not a number from 0 to {most:g}") from error
    if not 0.0 <= number <= most:
        raise ConfigError(f"{field} = {number:g} is out of bounds, 0 to {most:g}")
    return number


def _json(path: Path) -> Any:
    try:
        return parse_json(read_text(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {why_unread(error)}") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from error
