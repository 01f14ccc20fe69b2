"""Why pictures contradict each other: the usual mistakes, tried one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import inverse
from rhot_calibration.cameras.bundle.adjustment import Adjusted, Key
from rhot_calibration.cameras.solve.joint_fit import fit_together
from rhot_calibration.cameras.solve.placement import angle_of
from rhot_calibration.cameras.solve.refusals import mirrored
from rhot_calibration.cameras.solve.solve import Solution
from rhot_calibration.cameras.solve.views import Board, ViewSet

Kind = Literal["misread", "unfit", "mirrored", "exchanged", "size", "moved"]


@dataclass(frozen=True, slots=True)
class Cause:
    """Why one view, or the views of one number, do not fit.

    Attributes:
        kind: which mistake.
        keys: (camera, picture number) of the views that it concerns.
        text: for people, without the names of the pictures.
    """

    kind: Kind
    keys: tuple[Key, ...]
    text: str


def unfit_cause(board: Board, solution: Solution, views: ViewSet, key: Key) -> Cause:
    """Return why a view does not fit its own camera."""
    alone = fit_together(board, solution.adjusted, {key: views.views[key]}, _widths(views))
    if alone is None:
        return Cause("unfit", (key,), "does not fit its own camera at all: not this board")
    distance = np.linalg.norm(alone.bundle.residuals[0][alone.observations.seen[0]], axis=1)
    usual = max(float(np.median(distance)), solution.adjusted.bundle.sigma_px)
    misread_times = 8.0
    wrong = distance > max(misread_times * solution.adjusted.bundle.sigma_px, 4.0 * usual)
    if 0 < wrong.sum() <= 0.25 * len(distance):
        text = f"{int(wrong.sum())} of its {len(distance)} corners were misread, by up to {distance.max():.1f} px"
        return Cause("misread", (key,), text)
    rms = float(np.sqrt(np.mean(distance**2)))
    text = f"does not fit its own camera ({rms:.2f} px): blurred, moving, bent otherwise, or not this board"
    return Cause("unfit", (key,), text)


def contradiction_cause(board: Board, solution: Solution, views: ViewSet, number: int) -> Cause:
    """Return why the views of one number contradict each other though each fits its own camera."""
    adjusted, widths = solution.adjusted, _widths(views)
    members = {key: solution.views[key] for key in solution.split if key[1] == number}
    keys = tuple(members)
    # A mistake explains a contradiction when undoing it brings the RMS below so many times that of the good
    # pictures.
    fits_px = 0.6
    limit = max(4.0 * float(np.median(list(adjusted.rms_px.values()))), fits_px)
    for key in keys:
        changed = {**members, key: mirrored(board, members[key], widths[key[0]])}
        if _rms(fit_together(board, adjusted, changed, widths)) < limit:
            return Cause("mirrored", (key,), "is mirrored")
    if len(keys) == 2:
        (a, b) = keys
        if _rms(fit_together(board, adjusted, {a: members[b], b: members[a]}, widths)) < limit:
            text = f"the pictures of {a[0]} and {b[0]} are swapped"
            return Cause("exchanged", keys, text)
    places = [fit_together(board, adjusted, {key: members[key]}, widths) for key in (keys[0], keys[-1])]
    if places[0] is None or places[1] is None:
        return Cause("unfit", keys, "they do not fit their cameras: not this board")
    first, last = (fit.T_rig_board((number, "")) for fit in places if fit is not None)
    scale = _size(adjusted, keys[0], keys[-1], first, last)
    same_size = 0.02
    other_size = abs(scale - 1.0) > same_size and 0.2 < scale < 5.0
    if other_size and _rms(fit_together(board, adjusted, members, widths, scale)) < limit:
        return Cause("size", keys, f"they show a board {scale:.2f} times as large")
    motion = last @ inverse(first)
    shift_mm = 1e3 * float(np.linalg.norm(last[:3, 3] - first[:3, 3]))
    text = (
        f"they disagree by {shift_mm:.1f} mm and {np.degrees(angle_of(motion[:3, :3])):.2f}°: the board or a camera "
        "moved between the two pictures"
    )
    return Cause("moved", keys, text)


def _rms(fit: Adjusted | None) -> float:
    return float("inf") if fit is None else fit.total_rms_px()


def _size(adjusted: Adjusted, first: Key, second: Key, T_first: FloatArray, T_second: FloatArray) -> float:
    """Return how many times larger the board is if that alone makes two views disagree about its place."""
    centers = [inverse(adjusted.T_camera_rig(key[0]))[:3, 3] for key in (first, second)]
    baseline = centers[1] - centers[0]
    spread = (T_first[:3, 3] - centers[0]) - (T_second[:3, 3] - centers[1])
    return float(spread @ baseline) / max(float(spread @ spread), 1e-12)


def _widths(views: ViewSet) -> dict[str, int]:
    return {name: size[0] for name, size in views.sizes.items()}
