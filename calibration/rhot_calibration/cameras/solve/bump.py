"""When a camera was moved in the middle of a calibration: the change point of two cameras' relative pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import vector_from_rotation
from rhot.geometry.transforms import inverse
from rhot_calibration.cameras.bundle.adjustment import Adjusted

_LEAST: Final = 3
"""Pictures needed before and after."""
_SMALLEST_ANGLE_RAD: Final = float(np.radians(0.15))
_SMALLEST_SHIFT_M: Final = 0.0015
_NOISE: Final = np.repeat((np.radians(0.01), 1e-4), 3)
"""Relative poses of single pictures spread by this much at least, radians and metres."""
_SAME_ANGLE_RAD: Final = float(np.radians(0.4))
_SAME_SHARE: Final = 0.05
"""A step along the old direction, without a turn, is a change of the board's size and no bump."""


@dataclass(frozen=True, slots=True)
class Bump:
    """A camera moved against another one.

    Attributes:
        last_before, first_after: numbers of the pictures between which it happened.
        angle_deg, shift_mm: by how much.
        before, after: numbers of pictures on either side.
        size: of the board afterwards, times that before, when this alone explains the step; else 1.
    """

    last_before: int
    first_after: int
    angle_deg: float
    shift_mm: float
    before: tuple[int, ...]
    after: tuple[int, ...]
    size: float

    def text(self, camera: str, other: str) -> str:
        """Return what happened, for people."""
        if self.size != 1.0:
            return (
                f"the pictures from {self.first_after} on show a board with squares of another size, {self.size:.2f} "
                "times as large as before: use one board for all pictures"
            )
        return (
            f"{camera} was moved against {other} between picture {self.last_before} and picture {self.first_after}, by "
            f"{self.angle_deg:.1f}° and {self.shift_mm:.0f} mm: use the pictures from before or those from after, not "
            "both (those from after show the cameras as they stand now)"
        )


def find_bump(first: Adjusted, second: Adjusted) -> Bump | None:
    """Return when one camera was moved against the other, from their adjustments alone; None when they were not.

    Args:
        first, second: adjustments of single cameras whose pictures of equal number were taken together.
    """
    numbers, steps = _relative_poses(first, second)
    splits = range(_LEAST, len(numbers) - _LEAST + 1)
    if not splits:
        return None
    noise = np.maximum(1.4826 * np.median(np.abs(np.diff(steps, axis=0)), axis=0) / np.sqrt(2.0), _NOISE)
    split = min(splits, key=lambda at: _cost(steps[:at] / noise) + _cost(steps[at:] / noise))
    step = np.median(steps[split:], axis=0) - np.median(steps[:split], axis=0)
    certainty = np.abs(step) / (noise * np.sqrt(1.0 / split + 1.0 / (len(numbers) - split)))
    large = np.abs(step) > np.repeat((_SMALLEST_ANGLE_RAD, _SMALLEST_SHIFT_M), 3)
    # The step has to be so many times as large as chance would make it.
    if not (large & (certainty > 6.0)).any():
        return None
    return Bump(
        last_before=numbers[split - 1],
        first_after=numbers[split],
        angle_deg=float(np.degrees(np.linalg.norm(step[:3]))),
        shift_mm=1e3 * float(np.linalg.norm(step[3:])),
        before=tuple(numbers[:split]),
        after=tuple(numbers[split:]),
        size=_size(np.median(steps[:split], axis=0), np.median(steps[split:], axis=0)),
    )


def _cost(poses: FloatArray) -> float:
    """Return the sum of distances from the median: robust, so that single bad pictures do not count as a step."""
    return float(np.abs(poses - np.median(poses, axis=0)).sum())


def _size(before: FloatArray, after: FloatArray) -> float:
    """Return how many times larger the board became if only the translation's length changed, 1 otherwise."""
    length = float(np.linalg.norm(before[3:]))
    size = float(after[3:] @ before[3:]) / max(length**2, 1e-12)
    aside = float(np.linalg.norm(after[3:] - size * before[3:]))
    turned = float(np.linalg.norm(after[:3] - before[:3]))
    same = size > 0.2 and turned < _SAME_ANGLE_RAD and aside < _SAME_SHARE * length
    # A larger board looks nearer, so the cameras seem to stand closer together.
    return 1.0 / size if same and abs(size - 1.0) > _SAME_SHARE else 1.0


def _relative_poses(first: Adjusted, second: Adjusted) -> tuple[list[int], FloatArray]:
    """Return the numbers of common pictures and T_second_first of each as rotation vector and translation (n, 6)."""
    poses = [{place[0]: each.T_rig_board(place) for place in each.places} for each in (first, second)]
    numbers = sorted(poses[0].keys() & poses[1].keys())
    transforms = [poses[1][number] @ inverse(poses[0][number]) for number in numbers]
    if not transforms:
        return [], np.empty((0, 6))
    # Relative to one of them, rotation vectors stay small whatever the angle between the cameras is.
    reference = transforms[len(transforms) // 2]
    rows = [np.concatenate([vector_from_rotation(T[:3, :3] @ reference[:3, :3].T), T[:3, 3]]) for T in transforms]
    return numbers, np.array(rows)
