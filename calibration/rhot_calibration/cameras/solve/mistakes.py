"""Mistakes in taking pictures that make most of them contradict each other."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rhot.arrays import FloatArray
from rhot_calibration.cameras.solve.placement import Candidate, pose_candidates, relate
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet


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
