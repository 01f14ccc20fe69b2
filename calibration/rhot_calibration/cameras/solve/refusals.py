"""Why pictures of a board are refused or contradict each other: what is missing, usual mistakes, a moved camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import inverse, vector_from_rotation
from rhot_calibration.cameras.bundle.adjustment import Adjusted
from rhot_calibration.cameras.solve.consensus import Placement
from rhot_calibration.cameras.solve.placement import Candidate, pose_candidates, relate
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet

# When a camera was moved in the middle of a calibration: the change point of two cameras' relative pose.

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
        size=_bump_size(np.median(steps[:split], axis=0), np.median(steps[split:], axis=0)),
    )


def _cost(poses: FloatArray) -> float:
    """Return the sum of distances from the median: robust, so that single bad pictures do not count as a step."""
    return float(np.abs(poses - np.median(poses, axis=0)).sum())


def _bump_size(before: FloatArray, after: FloatArray) -> float:
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


# Why pictures contradict each other: the usual mistakes, tried one after the other.


# Mistakes in taking pictures that make most of them contradict each other.


def mirrored(board: Board, view: BoardView, width: int) -> BoardView:
    """Return a view as it would be in the mirrored picture, its corners numbered as from the printed face."""
    row, column = np.divmod(view.ids, board.columns)
    # Of the two ways to number the mirrored board, the one that keeps the first square dark.
    if board.rows % 2 == 0:
        row = board.rows - 1 - row
    else:
        column = board.columns - 1 - column
    ids = row * board.columns + column
    order = np.argsort(ids)
    corners = view.corners * (-1.0, 1.0) + (width - 1.0, 0.0)
    return BoardView(ids[order], corners[order], view.sharpness)


def common_mistake(views: ViewSet, lenses: Mapping[str, FloatArray], first: str, second: str) -> str | None:
    """Return what makes most pictures of two cameras contradict each other; None when no usual mistake explains it."""
    board = views.board

    def poses(camera: str, change: int = 0, flip: bool = False) -> dict[int, list[Candidate]]:
        found = {}
        for (name, number), view in views.views.items():
            if name == camera:
                shown = mirrored(board, view, views.sizes[name][0]) if flip else view
                found[number + change] = pose_candidates(board.points[shown.ids], shown.corners, lenses[camera])
        return found

    def agreeing(a: dict[int, list[Candidate]], b: dict[int, list[Candidate]]) -> float:
        relation = relate(a, b)
        return 0.0 if relation is None else len(relation.agreeing) / max(len(a.keys() & b.keys()), 3)

    if agreeing(poses(first, flip=True), poses(second)) > 0.7:
        return (
            f"The pictures of {first} or those of {second} are mirrored: switch that camera's mirroring off and take "
            "them again (text in a picture tells which)"
        )
    for change in (1, -1):
        if agreeing(poses(first, change), poses(second)) > 0.7:
            return f"Picture N of {first} was taken together with picture N{change:+d} of {second}; number them alike"
    return None


# What views may not lack before cameras can be placed by them: the reasons to refuse them.

MIN_VIEWS: Final = 5
"""Pictures that each camera needs …"""
MIN_COMMON: Final = 3
"""… and that two linked cameras need in common."""
_ENOUGH_AGREE: Final = 0.3
"""Of two cameras' pictures this share has to agree roughly, or their relation is only a guess."""


def refuse_too_few_views(views: ViewSet, cameras: tuple[str, ...]) -> None:
    """Refuse fewer views than a lens needs.

    Raises:
        CalibrationError: names the camera.
    """
    for name in cameras:
        number = sum(camera == name for camera, _ in views.views)
        if number < MIN_VIEWS:
            raise CalibrationError(
                f"camera {name}: the board was found in {number} pictures only, {MIN_VIEWS} are the least and 15 to 30 "
                f"are good; looked for: {views.board}"
            )


def refuse_unlinked(placement: Placement) -> None:
    """Refuse cameras that no chain of common pictures links.

    Raises:
        CalibrationError: names the groups.
    """
    if len(placement.groups) > 1:
        groups = " | ".join(", ".join(group) for group in placement.groups)
        raise CalibrationError(
            f"no picture of the board links these cameras: {groups}. Take some in which a camera of each group sees "
            "the board at the same time"
        )


def refuse_contradicting(views: ViewSet, alone: Mapping[str, Adjusted], placement: Placement) -> None:
    """Refuse pictures of which most contradict each other.

    Raises:
        CalibrationError: names the mistake behind it when one of the usual ones explains it.
    """
    lenses = {name: adjusted.lens(name) for name, adjusted in alone.items()}
    for (first, second), relation in placement.relations.items():
        agreeing, others = len(relation.agreeing), len(relation.others)
        total = agreeing + others
        if total < MIN_COMMON or agreeing > 0.5 * total or _linked_otherwise(placement, first, second):
            continue
        mistake = common_mistake(views, lenses, first, second)
        if mistake is None and agreeing >= max(MIN_COMMON, _ENOUGH_AGREE * total):
            continue
        if mistake is None:
            moved = find_bump(alone[first], alone[second])
            mistake = "" if moved is None else moved.text(second, first)
        raise CalibrationError(
            f"the pictures of {first} and {second} contradict each other: only {agreeing} of {total} agree "
            f"about how the cameras stand. "
            + (mistake or "Were pictures of the same number taken at the same moment, with cameras that stand still?")
        )


def _linked_otherwise(placement: Placement, first: str, second: str) -> bool:
    """Tell whether a chain of agreeing pairs links two cameras without their own common pictures."""
    good = [
        pair
        for pair, relation in placement.relations.items()
        if len(relation.agreeing) >= MIN_COMMON and len(relation.agreeing) > len(relation.others)
    ]
    reached, waiting = {first}, [first]
    while waiting:
        name = waiting.pop()
        for pair in good:
            if name in pair:
                other = pair[1] if pair[0] == name else pair[0]
                if other not in reached:
                    reached.add(other)
                    waiting.append(other)
    return second in reached
