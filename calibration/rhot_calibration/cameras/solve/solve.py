"""Calibration of all cameras from views of a board: consensus, adjustment, and what does not fit left out by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_calibration.cameras.bundle.adjustment import Adjusted, BoardStand, Key, adjust_views
from rhot_calibration.cameras.solve.consensus import Placement, place_cameras, single_camera
from rhot_calibration.cameras.solve.joint_fit import fit_together
from rhot_calibration.cameras.solve.placement import Relation
from rhot_calibration.cameras.solve.refusals import (
    MIN_VIEWS,
    refuse_contradicting,
    refuse_too_few_views,
    refuse_unlinked,
)
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet

_ROUNDS: Final = 6
_BAD_TIMES: Final = 3.0
_BAD_PX: Final = 0.2
"""A view is bad when its RMS is above so many times the median of all, and this much above it."""

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Solution:
    """A calibration, before it is judged.

    Attributes:
        views: what was used, by (camera, picture number).
        place_of: at which place each view saw the board; views of one number at different places contradict each other.
        adjusted: cameras, places and the board's shape.
        left_out: views that do not fit their own camera, with their RMS, pixels.
        split: views that fit their own camera but not the others' of the same number; they serve for the lens alone.
        relations: (first, second) camera to how they stand by single pictures, before the adjustment.
        flat_rms_px: what the flat board would have left, pixels.
        alone: each camera's own adjustment.
    """

    views: Mapping[Key, BoardView]
    place_of: Mapping[Key, BoardStand]
    adjusted: Adjusted
    left_out: Mapping[Key, float]
    split: tuple[Key, ...]
    relations: Mapping[tuple[str, str], Relation]
    flat_rms_px: float
    alone: Mapping[str, Adjusted]


def solve(views: ViewSet, lenses: Mapping[str, FloatArray], progress: Progress = lambda _: None) -> Solution:
    """Return the rig that explains the views.

    Args:
        views: what the cameras saw.
        lenses: (9,) first guess of every camera's lens; the order of the cameras, the first is the reference.
        progress: told what is being done.

    Raises:
        CalibrationError: too few views, cameras without a link, or parameters that the views do not determine.
    """
    board, widths = views.board, {name: size[0] for name, size in views.sizes.items()}
    refuse_too_few_views(views, tuple(lenses))
    left_out: dict[Key, float] = {}
    alone: dict[str, Adjusted] = {}
    for name, lens in lenses.items():
        progress(f"lens of {name}")
        own = {key: view for key, view in views.views.items() if key[0] == name}
        alone[name], bad = _without_bad(board, own, lens, widths[name])
        left_out |= bad
    kept = {key: view for key, view in views.views.items() if key not in left_out}
    progress("how the cameras stand")
    placement = place_cameras(board, kept, alone)
    refuse_unlinked(placement)
    refuse_contradicting(views, alone, placement)
    return _refine(board, placement, alone, widths, left_out, progress)


def _without_bad(
    board: Board, own: Mapping[Key, BoardView], lens: FloatArray, width: int
) -> tuple[Adjusted, dict[Key, float]]:
    """Return a camera's own adjustment without the views that do not fit it, and those with their RMS."""
    kept, bad = dict(own), dict[Key, float]()
    while True:
        adjusted = single_camera(board, kept, lens, width)
        lens = adjusted.lens(adjusted.cameras[0])
        rms = adjusted.rms_px
        worse = _outliers(rms)
        if not worse or len(kept) - len(worse) < MIN_VIEWS:
            return adjusted, bad
        # One at a time while they may spoil each other; the worst first.
        worst = max(worse, key=lambda key: rms[key])
        bad[worst] = rms[worst]
        del kept[worst]


def _limit(rms: Mapping[Key, float]) -> float:
    median = float(np.median(list(rms.values())))
    return max(_BAD_TIMES * median, median + _BAD_PX)


def _outliers(rms: Mapping[Key, float]) -> list[Key]:
    limit = _limit(rms)
    return [key for key, value in rms.items() if value > limit]


@dataclass(slots=True)
class _Work:
    """What changes from round to round."""

    views: dict[Key, BoardView]
    place_of: dict[Key, BoardStand]
    boards: dict[BoardStand, FloatArray]
    left_out: dict[Key, float]
    second_chance: set[Key] = field(default_factory=set)
    """Views that were taken back once."""
    divided: Counter[int] = field(default_factory=Counter)
    """How often the views of a number were taken apart; they are joined again once at most."""


def _refine(
    board: Board,
    placement: Placement,
    alone: Mapping[str, Adjusted],
    widths: Mapping[str, int],
    left_out: dict[Key, float],
    progress: Progress,
) -> Solution:
    work = _Work(dict(placement.views), dict(placement.place_of), dict(placement.board_poses), left_out)
    lenses = {name: adjusted.lens(name) for name, adjusted in alone.items()}
    cameras = placement.camera_poses
    release = all(adjusted.released for adjusted in alone.values())
    corners: FloatArray | None = None
    sigma = 1.0
    for number in range(_ROUNDS):
        progress(f"adjusting everything together, round {number + 1}")
        adjusted = adjust_views(
            board,
            work.views,
            work.place_of,
            lenses,
            cameras,
            work.boards,
            widths,
            corners=corners,
            release=release,
            sigma_px=sigma,
        )
        lenses = {name: adjusted.lens(name) for name in lenses}
        cameras = {name: adjusted.T_camera_rig(name) for name in lenses}
        work.boards |= {place: adjusted.T_rig_board(place) for place in adjusted.places}
        corners, sigma = (adjusted.bundle.geometry.corners if release else None), adjusted.bundle.sigma_px
        if number == _ROUNDS - 1:
            break
        divided = _divide(adjusted, work)
        joined = _join(board, adjusted, work, widths)
        readmitted = _readmit(board, adjusted, work, placement.views, widths)
        if not (divided or joined or readmitted):
            break
    flat = adjusted
    if release:
        progress("comparing with a flat board")
        flat = adjust_views(board, work.views, work.place_of, lenses, cameras, work.boards, widths)
        # The board counts as bent when releasing its shape brings the residuals below this share.
        if adjusted.bundle.sigma_px > 0.90 * flat.bundle.sigma_px:
            adjusted = flat
    split = tuple(key for key in work.views if len(_places_of(key[1], work)) > 1)
    return Solution(
        work.views, work.place_of, adjusted, left_out, split, placement.relations, flat.total_rms_px(), alone
    )


def _places_of(number: int, work: _Work) -> set[BoardStand]:
    return {place for (_, other), place in work.place_of.items() if other == number}


def _divide(adjusted: Adjusted, work: _Work) -> bool:
    """Take what does not fit out of its place, or out altogether when it is on its own; return whether any was."""
    rms = adjusted.rms_px
    changed = False
    for key in sorted(_outliers(rms), key=lambda key: -rms[key]):
        place = work.place_of[key]
        company = [other for other in work.views if work.place_of[other] == place and other != key]
        if not company:
            work.left_out[key] = rms[key]
            del work.views[key], work.place_of[key]
        elif any(rms[other] > rms[key] for other in company):
            continue
        else:
            # The worst of its place goes its own way; of two nobody knows which one it is.
            for each in (key, *(company if len(company) == 1 else ())):
                work.place_of[each] = each[1], each[0]
                work.boards[work.place_of[each]] = work.boards[place]
            work.divided[key[1]] += 1
        changed = True
    return changed


def _readmit(
    board: Board, adjusted: Adjusted, work: _Work, views: Mapping[Key, BoardView], widths: Mapping[str, int]
) -> bool:
    """Take back, once, views that were left out while others still spoiled the solution; return whether any was."""
    limit = _limit(adjusted.rms_px)
    changed = False
    for key in [key for key in work.left_out if key in views and key not in work.second_chance]:
        alone = fit_together(board, adjusted, {key: views[key]}, widths)
        if alone is not None and alone.total_rms_px() <= limit:
            work.second_chance.add(key)
            place = key[1], key[0]
            work.views[key], work.place_of[key] = views[key], place
            work.boards[place] = alone.T_rig_board((key[1], ""))
            del work.left_out[key]
            changed = True
    return changed


def _join(board: Board, adjusted: Adjusted, work: _Work, widths: Mapping[str, int]) -> bool:
    """Put views of one number at one place again where they fit by now; return whether any was."""
    rms = adjusted.rms_px
    limit = _limit(rms)
    changed = False
    for number in sorted({number for _, number in work.views}):
        places = _places_of(number, work)
        members = [key for key in work.views if key[1] == number]
        if len(places) < 2 or work.divided[number] > 1 or any(rms.get(key, np.inf) > limit for key in members):
            continue
        together = fit_together(board, adjusted, {key: work.views[key] for key in members}, widths)
        if together is not None and max(together.rms_px.values()) <= limit:
            place = number, ""
            work.place_of |= dict.fromkeys(members, place)
            work.boards[place] = together.T_rig_board(place)
            changed = True
    return changed
