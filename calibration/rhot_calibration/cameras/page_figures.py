"""What the page shows of a camera calibration: maps of the pictures, bars, and the figures of the result."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.calibration_step import Figures
from rhot.recording.picture_file import decode_picture
from rhot_calibration.cameras.calibration import Calibrated
from rhot_calibration.cameras.live.coverage import WANTED_FILL, WANTED_SHARED, WANTED_TILTED, WANTED_VIEWS
from rhot_calibration.cameras.live.session import Progress

_SIZE: Final = (320, 240)
_COVERED: Final = (70, 160, 60)
_EMPTY: Final = (30, 30, 30)
_SHARE: Final = 0.45


def coverage_jpeg(area: NDArray[np.bool_], picture: bytes | None) -> bytes:
    """Return a camera's picture with the parts of it tinted in which a board has been, as JPEG.

    Args:
        area: as of `CameraCoverage.area`.
        picture: the newest, coded; None = there is none.
    """
    canvas = np.full((_SIZE[1], _SIZE[0], 3), _EMPTY, np.uint8)
    seen = None if picture is None else decode_picture(picture)
    if seen is not None:
        canvas = np.asarray(cv2.resize(seen, _SIZE, interpolation=cv2.INTER_AREA), np.uint8)
    covered = np.asarray(cv2.resize(area.astype(np.uint8), _SIZE, interpolation=cv2.INTER_NEAREST)) > 0
    canvas[covered] = ((1.0 - _SHARE) * canvas[covered] + _SHARE * np.array(_COVERED)).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", canvas)[1])


def share_of(progress: Progress | None) -> float:
    """Return how much of what is asked for is there: of all cameras, and of the pictures that tie them, 0 to 1."""
    if progress is None:
        return 0.0
    parts = [coverage.share for coverage in progress.cameras.values()]
    parts += [min(1.0, shared / WANTED_SHARED) for shared in progress.pairs.values()] if len(parts) == 2 else []
    return sum(parts) / len(parts)


def coverage_table(progress: Progress) -> Figures:
    """Return what each camera has seen, and what is asked for."""
    rows = []
    for name, coverage in progress.cameras.items():
        tilted = " ".join(
            f"{arrow}{min(count, WANTED_TILTED)}" for arrow, count in zip("←→↑↓", coverage.tilted.values(), strict=True)
        )
        rows.append(
            (
                name,
                f"{coverage.views} of {WANTED_VIEWS}",
                f"{100 * coverage.area_share:.0f} %",
                f"{100 * float(coverage.fills.max(initial=0.0)):.0f} of {100 * WANTED_FILL:.0f} %",
                f"{tilted} of {WANTED_TILTED}",
            )
        )
    shared = ", ".join(f"{a}–{b} {count}" for (a, b), count in progress.pairs.items())
    title = f"Pictures taken: {progress.sets}; seen by two cameras: {shared or '-'}"
    return Figures(title, ("camera", "views", "area", "nearest", "tilted"), tuple(rows))


def result_tables(found: Calibrated) -> tuple[Figures, ...]:
    """Return how good a calibration is."""
    cameras = tuple(
        (name, str(figures.pictures), f"{figures.rms_px:.2f}", f"{found.models[name].K[0, 0]:.1f}")
        for name, figures in found.cameras.items()
    )
    pairs = tuple(
        (
            f"{first}, {second}",
            f"{figures.baseline_mm:.1f} ± {figures.baseline_sd_mm:.1f}",
            f"{figures.epipolar_p95_px:.2f}",
            "-" if (first, second) not in found.held_out_px else f"{found.held_out_px[first, second]:.2f}",
        )
        for (first, second), figures in found.pairs.items()
    )
    errors = tuple(
        (f"{100 * error.distance_m:.0f} cm", f"{error.calibration_mm:.2f}", f"{error.total_mm:.2f}")
        for error in found.errors
    )
    return (
        Figures("Error to expect in space", ("at", "calibration mm", "with marker noise mm"), errors),
        Figures("Pairs", ("cameras", "baseline mm", "epipolar p95 px", "held out px"), pairs),
        Figures("Lenses", ("camera", "pictures", "RMS px", "focal px"), cameras),
    )
