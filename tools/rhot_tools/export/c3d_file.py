"""C3D (biomechanics, c3d.org), for Mokka, Visual3D, MATLAB and others: markers in millimetres at a steady rate.

A marker that is absent from a frame has the residual −1, which C3D programs show as a gap. Frames are numbered with 16
bits: of longer takes every reader tried shows the first 65,535 frames and no more, so they go into several files.
"""

from __future__ import annotations

import importlib
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.atomic_file import replacing
from rhot.errors import ConfigError
from rhot_tools.export.frames import Frames

MM_PER_M: Final = 1e3
"""C3D programs expect millimetres, whatever POINT:UNITS says."""


MOST_FRAMES: Final = 65_000
"""Of one file."""


def write_c3d(file: Path, frames: Frames, *, y_up: bool) -> list[Path]:
    """Write markers, and return the files: of longer takes `grasp-001.c3d` and so on, each from its own time 0.

    Args:
        file: to write.
        frames: the markers.
        y_up: whether the vertical is known to be y; told to programs that draw the scene.

    Raises:
        ConfigError: ezc3d is not installed, or the file cannot be written.
    """
    try:
        ezc3d = importlib.import_module("ezc3d")
    except ModuleNotFoundError as error:
        raise ConfigError("--c3d needs the Python module ezc3d; pip install 'rhot[c3d]'") from error
    starts = range(0, len(frames.t_s), MOST_FRAMES)
    files = [file] if len(starts) == 1 else [file.with_stem(f"{file.stem}-{k:03d}") for k in range(1, len(starts) + 1)]
    for part, start in zip(files, starts, strict=True):
        _write(ezc3d, part, frames, frames.positions[start : start + MOST_FRAMES], y_up)
    return files


def _write(ezc3d: Any, file: Path, frames: Frames, metres: FloatArray, y_up: bool) -> None:
    """Write one file of positions (F, M, 3), metres."""
    positions = MM_PER_M * np.moveaxis(metres, 0, -1)
    absent: NDArray[np.bool_] = np.asarray(np.isnan(positions).any(axis=1))
    positions = np.where(absent[:, None], 0.0, positions)
    made = ezc3d.c3d()
    point = made["parameters"]["POINT"]
    point["UNITS"]["value"] = ["mm"]
    point["RATE"]["value"] = [frames.rate_hz]
    point["LABELS"]["value"] = list(frames.markers)
    point["DESCRIPTIONS"]["value"] = list(frames.markers)
    if y_up:
        made.add_parameter("POINT", "X_SCREEN", ["+X"])
        made.add_parameter("POINT", "Y_SCREEN", ["+Y"])
    ones = np.ones((1, *positions.shape[::2]))
    made["data"]["points"] = np.concatenate([positions.transpose(1, 0, 2), ones])
    made["data"]["meta_points"]["residuals"] = np.where(absent, -1.0, 0.0)[None]
    made["data"]["meta_points"]["camera_masks"] = np.zeros((7, *absent.shape), dtype=bool)
    with replacing(file) as part, tempfile.TemporaryDirectory(dir=file.parent, prefix=".rhot-c3d-") as folder:
        # ezc3d appends the suffix to any other name.
        whole = Path(folder) / "whole.c3d"
        made.write(str(whole))
        part.write_bytes(whole.read_bytes())
