"""What views may not lack before cameras can be placed by them: the reasons to refuse them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from rhot.errors import CalibrationError
from rhot_calibration.cameras.bundle.adjustment import Adjusted
from rhot_calibration.cameras.solve.bump import find_bump
from rhot_calibration.cameras.solve.consensus import Placement
from rhot_calibration.cameras.solve.mistakes import common_mistake
from rhot_calibration.cameras.solve.views import ViewSet

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
