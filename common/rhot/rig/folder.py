"""Reading and writing a rig folder."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from rhot.atomic_file import why_unread, write_atomic
from rhot.errors import CalibrationError, ConfigError, RhotError
from rhot.messages import first_problem
from rhot.rig.calibration import (
    CameraCalibration,
    CamerasFile,
    HandFile,
    HeadsetFile,
    Matrix3,
    Matrix4,
    RegistrationFile,
    RigidTransform,
    StageFile,
)
from rhot.rig.config import CameraConfig, ObjectSource, RigConfig
from rhot.text import as_argument, parse_json, parse_toml, read_text

logger = logging.getLogger(__name__)

RIG_FILE = "rig.toml"
CAMERAS_FILE = "cameras.json"
COLORS_FILE = "colors.json"
HAND_FILE = "hand.json"
REGISTRATION_FILE = "registration.json"
"""Of all sources of tracked objects that have none of their own; earlier versions knew no other."""
OBJECT_SOURCES: tuple[ObjectSource, ...] = get_args(ObjectSource)
STAGE_FILE = "stage.json"
HEADSET_FILE = "headset.json"

_SETTINGS: Final = (".toml", ".json")
_MOST_SETTINGS_BYTES: Final = 16 << 20

_MADE_BY: Final = {
    "cameras.": "cameras",
    "colors.": "colors",
    "hand.": "hand",
    "registration.": "objects",
    "stage.": "stage",
    "headset.": "headset",
}
"""Beginning of a calibration file's name to the `rhot calibrate` that writes it."""

NO_REGISTRATION: Final = RegistrationFile(T_rig_tracker=RigidTransform.identity())
"""Of a rig without tracked objects, or whose tracking system's space is the rig's."""

_F = TypeVar("_F", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class Rig:
    """A loaded rig folder.

    Attributes:
        path: the folder.
        config: `rig.toml`.
        cameras: geometry of every configured camera, in the order of `rig.toml`.
        calibrated: whether that geometry comes from `cameras.json`; otherwise it is nominal (field of view and
            position from `rig.toml`, no distortion).
        hand: `hand.json`, or the default scaled by `[hand] length_m`.
        registration: `registration.json`, or identity; it holds for sources that have none of their own.
        quality: what `cameras.json` says of itself; see `rhot.rig.calibration`.
        stage: `stage.json`, where the floor is; None when it is not known.
        registrations: those of one source of tracked objects alone, `registration.<source>.json`.
        headset: `headset.json`, where the feet's camera sits; None when only `rig.toml` says so.
    """

    path: Path
    config: RigConfig
    cameras: dict[str, CameraCalibration]
    calibrated: bool
    hand: HandFile
    registration: RegistrationFile
    quality: Any = None
    stage: StageFile | None = None
    registrations: Mapping[str, RegistrationFile] = field(default_factory=dict)
    headset: HeadsetFile | None = None

    def registration_of(self, source: str) -> RegistrationFile:
        """Return where the space of a source of tracked objects (`steamvr`, …) lies in the rig."""
        return self.registrations.get(source, self.registration)

    @property
    def T_head_camera(self) -> NDArray[np.float64] | None:
        """(4, 4) of the feet's depth camera, as calibrated, else as typed in; None in a rig without feet."""
        if self.config.feet is None:
            return None
        return self.config.feet.camera.T_head_camera if self.headset is None else self.headset.T_head_camera.matrix

    @property
    def colors_path(self) -> Path:
        """Where the colours of the markers are kept."""
        return self.path / COLORS_FILE

    def resolve(self, path: str) -> Path:
        """Return a path of `rig.toml`, which may be relative to the rig folder."""
        return self.path / Path(path).expanduser()


def load_rig(path: Path) -> Rig:
    """Load and validate a rig folder.

    Raises:
        ConfigError: `rig.toml` is missing, is not TOML or holds a wrong value.
        CalibrationError: a calibration file is not valid or contradicts `rig.toml`.
    """
    config = load_config(path)
    cameras_path = path / CAMERAS_FILE
    calibrated = cameras_path.exists()
    if calibrated:
        cameras, quality = _calibrated_cameras(cameras_path, config)
    else:
        cameras, quality = {name: nominal_camera(camera) for name, camera in config.cameras.items()}, None
    hand = _optional(path / HAND_FILE, HandFile) or HandFile(length_m=config.hand.length_m)
    registration = _optional(path / REGISTRATION_FILE, RegistrationFile) or NO_REGISTRATION
    stage = _optional(path / STAGE_FILE, StageFile)
    own = {source: _optional(path / registration_name(source), RegistrationFile) for source in OBJECT_SOURCES}
    registrations: dict[str, RegistrationFile] = {source: file for source, file in own.items() if file is not None}
    headset = _optional(path / HEADSET_FILE, HeadsetFile)
    return Rig(path, config, cameras, calibrated, hand, registration, quality, stage, registrations, headset)


def registration_name(source: str) -> str:
    """Return the name of the file with the registration of one source of tracked objects."""
    return f"registration.{source}.json"


def registration_path(path: Path, source: str) -> Path | None:
    """Return the file that holds a source's registration now: its own, else `registration.json`; None without one."""
    return next((file for file in (path / registration_name(source), path / REGISTRATION_FILE) if file.exists()), None)


def latest_rig(rig: Rig) -> Rig:
    """Return a rig as its folder holds it now; as it was, with a line in the log, where that cannot be used."""
    try:
        return load_rig(rig.path)
    except RhotError as error:
        logger.error("the rig stays as it was loaded before: %s", error)
        return rig


def load_config(path: Path) -> RigConfig:
    """Load `rig.toml` alone.

    Raises:
        ConfigError: missing, not TOML, or a wrong value; names the field.
    """
    file = path / RIG_FILE
    if not path.is_dir():
        raise ConfigError(
            f"{path}: no such rig folder; name yours with --rig, or make one: `rhot init {as_argument(path)}`"
        )
    try:
        data = parse_toml(read_text(file))
    except FileNotFoundError as error:
        raise ConfigError(f"{path} holds no {RIG_FILE}; `rhot init {as_argument(path)}` makes one") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error
    except ValueError as error:
        raise ConfigError(f"{file}: not TOML: {error}") from error
    try:
        config = RigConfig.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{file}: {first_problem(error, RigConfig)}") from error
    # Processes know the bus without the rig folder; from here on the path holds by itself.
    keys = str((path / config.bus.keys).resolve())
    return config.model_copy(update={"bus": config.bus.model_copy(update={"keys": keys})})


def nominal_camera(camera: CameraConfig) -> CameraCalibration:
    """Return the geometry of an uncalibrated camera: a pinhole of the given field of view, facing along +z."""
    focal_px = 0.5 * camera.width / float(np.tan(np.radians(camera.fov_deg) / 2.0))
    K: Matrix3 = (
        (focal_px, 0.0, 0.5 * (camera.width - 1)),
        (0.0, focal_px, 0.5 * (camera.height - 1)),
        (0.0, 0.0, 1.0),
    )
    x, y, z = camera.position_m
    T: Matrix4 = ((1.0, 0.0, 0.0, x), (0.0, 1.0, 0.0, y), (0.0, 0.0, 1.0, z), (0.0, 0.0, 0.0, 1.0))
    return CameraCalibration(width=camera.width, height=camera.height, K=K, T_rig_camera=T)


def _calibrated_cameras(file: Path, config: RigConfig) -> tuple[dict[str, CameraCalibration], Any]:
    """Return the cameras of `rig.toml` as `cameras.json` holds them, and what it says of its own quality."""
    content = read_json_model(file, CamerasFile)
    calibrated = content.cameras
    missing = [name for name in config.cameras if name not in calibrated]
    if missing:
        raise CalibrationError(
            f"{file}: no calibration of camera {', '.join(missing)} (it holds {', '.join(calibrated)}); "
            "calibrate again with `rhot calibrate cameras`, or take the camera out of rig.toml"
        )
    for name, camera in config.cameras.items():
        found = calibrated[name]
        if (found.width, found.height) != (camera.width, camera.height):
            raise CalibrationError(
                f"{file}: camera {name} was calibrated at {found.width}x{found.height}, rig.toml runs it at "
                f"{camera.width}x{camera.height}; use one size for both"
            )
    return {name: calibrated[name] for name in config.cameras}, content.quality


def _optional(file: Path, model: type[_F]) -> _F | None:
    return read_json_model(file, model) if file.exists() else None


def read_json_model(file: Path, model: type[_F], error_class: type[RhotError] = CalibrationError) -> _F:
    """Read and validate a JSON file of a rig folder.

    Raises:
        CalibrationError (or `error_class`): unreadable, not JSON, or a wrong value; names the field.
    """
    try:
        data = parse_json(read_text(file))
    except FileNotFoundError as error:
        raise error_class(f"{file}: is missing{_remedy(file)}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise error_class(f"{file}: cannot be read: {why_unread(error)}") from error
    except ValueError as error:
        raise error_class(f"{file}: not JSON, perhaps cut off: {error}{_remedy(file)}") from error
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise error_class(f"{file}: {first_problem(error, model)}") from error


def _remedy(file: Path) -> str:
    """Return how to get a calibration file back that is missing or damaged; empty for other files."""
    command = next((f"rhot calibrate {what}" for start, what in _MADE_BY.items() if file.name.startswith(start)), "")
    former = file.with_name(f"{file.stem}.previous{file.suffix}")
    ways = [f"make it again with `{command}`"] if command else []
    ways += [f"copy {former.name} over it"] if former.exists() else []
    return "; " + ", or ".join(ways) if ways else ""


def write_json_model(file: Path, model: BaseModel) -> None:
    """Write a JSON file of a rig folder in one step: a crash leaves the old file or the new one, never half."""
    write_text_atomic(file, json.dumps(model.model_dump(mode="json", exclude_none=True), indent=1) + "\n")


def write_text_atomic(file: Path, text: str) -> None:
    """Replace a text file in one step, also over a power cut.

    Raises:
        ConfigError: the folder cannot be written.
    """
    write_atomic(file, text.encode())


def settings_files(folder: Path) -> dict[str, bytes]:
    """Return the settings of a rig folder, its `*.toml` and `*.json`, by name; keys and recordings are not among them.

    Raises:
        ConfigError: a file cannot be read.
    """
    found: dict[str, bytes] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix not in _SETTINGS or file.name.startswith(".") or not file.is_file():
            continue
        try:
            if file.stat().st_size > _MOST_SETTINGS_BYTES:
                logger.warning("%s is over %d MB and is left out", file, _MOST_SETTINGS_BYTES >> 20)
                continue
            found[file.name] = file.read_bytes()
        except OSError as error:
            raise ConfigError(f"{file}: cannot be read: {error.strerror or error}") from error
    return found
