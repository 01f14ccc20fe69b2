"""Which pictures tell the same story: the rough rig, and the places at which the board stood."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import inverse, rigid
from rhot_calibration.cameras.board.grid import half_turn_ambiguous
from rhot_calibration.cameras.bundle.adjustment import Adjusted, BoardStand, Key, adjust_views
from rhot_calibration.cameras.solve.placement import (
    Candidate,
    Relation,
    agree,
    pose_candidates,
    relate,
    spanning_tree,
)
from rhot_calibration.cameras.solve.views import Board, BoardView


@dataclass(frozen=True, slots=True)
class Placement:
    """The rig, roughly.

    Attributes:
        views: as given; those that show a symmetric board from its other end are turned.
        place_of: at which place each view saw the board.
        camera_poses: T_camera_rig (4, 4) of every camera that is linked to the first.
        board_poses: T_rig_board (4, 4) of every place.
        relations: (first, second) camera to how they stand.
        groups: of cameras that common pictures link, the first camera's first.
    """

    views: Mapping[Key, BoardView]
    place_of: Mapping[Key, BoardStand]
    camera_poses: Mapping[str, FloatArray]
    board_poses: Mapping[BoardStand, FloatArray]
    relations: Mapping[tuple[str, str], Relation]
    groups: Sequence[Sequence[str]]


def single_camera(board: Board, views: Mapping[Key, BoardView], lens: FloatArray, width: int) -> Adjusted:
    """Return a camera's lens and the places of the board before it, from its own pictures alone.

    Args:
        board: what was shown.
        views: of one camera.
        lens: (9,) a first guess.
        width: of the pictures, pixels.
    """
    (camera,) = {name for name, _ in views}
    poses = {key: pose_candidates(board.points[view.ids], view.corners, lens) for key, view in views.items()}
    usable = {key: view for key, view in views.items() if poses[key]}
    place_of: dict[Key, BoardStand] = {key: (key[1], "") for key in usable}
    at: dict[BoardStand, FloatArray] = {place_of[key]: poses[key][0].T for key in usable}
    widths = {camera: width}
    adjusted = adjust_views(board, usable, place_of, {camera: lens}, {camera: np.eye(4)}, at, widths)
    whole = sum(len(view.ids) > 0.8 * board.columns * board.rows for view in usable.values())
    # So many views of (nearly) the whole board let its shape be estimated together with a lens.
    if whole < 8:
        return adjusted
    start = {place: adjusted.T_rig_board(place) for place in adjusted.places}
    return adjust_views(
        board,
        usable,
        place_of,
        {camera: adjusted.lens(camera)},
        {camera: np.eye(4)},
        start,
        widths,
        release=True,
        sigma_px=adjusted.bundle.sigma_px,
    )


def place_cameras(board: Board, views: Mapping[Key, BoardView], alone: Mapping[str, Adjusted]) -> Placement:
    """Return where cameras and boards stand, by what most pictures say.

    Args:
        board: what was shown.
        views: of all cameras.
        alone: each camera's own adjustment; the first camera is the reference.
    """
    candidates = {name: _candidates(board, views, adjusted) for name, adjusted in alone.items()}
    relations = {
        (first, second): found
        for first, second in combinations(alone, 2)
        if (found := relate(candidates[first], candidates[second])) is not None
    }
    camera_poses, groups = spanning_tree(relations, list(alone))
    chosen: dict[Key, BoardView] = {}
    place_of: dict[Key, BoardStand] = {}
    board_poses: dict[BoardStand, FloatArray] = {}
    for number in sorted({number for poses in candidates.values() for number in poses}):
        claims = [
            _Claim(name, inverse(camera_poses[name]) @ each.T, each)
            for name in camera_poses
            for each in candidates[name].get(number, ())
        ]
        together = _largest_group(claims)
        alone_here = {claim.camera: claim for claim in reversed(claims) if claim.camera not in together}
        for name, claim in (together | alone_here).items():
            key = name, number
            place = number, "" if name in together and len(together) > 1 else name
            place_of[key] = place
            board_poses.setdefault(place, claim.T_rig_board)
            chosen[key] = turned(board, views[key]) if claim.candidate.turned else views[key]
    return Placement(chosen, place_of, camera_poses, board_poses, relations, groups)


def turned(board: Board, view: BoardView) -> BoardView:
    """Return a view of a board that looks the same after half a turn, numbered from the other end."""
    ids = board.columns * board.rows - 1 - view.ids
    order = np.argsort(ids)
    return BoardView(ids[order], view.corners[order], view.sharpness)


@dataclass(frozen=True, slots=True)
class _Claim:
    camera: str
    T_rig_board: FloatArray
    candidate: Candidate


def _largest_group(claims: Sequence[_Claim]) -> dict[str, _Claim]:
    """Return, by camera, the claims of one moment that agree; the best one first."""
    best: dict[str, _Claim] = {}
    best_error = np.inf
    for claim in claims:
        distance = float(np.linalg.norm(claim.candidate.T[:3, 3]))
        group = {claim.camera: claim}
        for other in claims:
            if other.camera == claim.camera or not agree(claim.T_rig_board, other.T_rig_board, distance):
                continue
            if other.camera not in group or other.candidate.error_px < group[other.camera].candidate.error_px:
                group[other.camera] = other
        error = sum(each.candidate.error_px for each in group.values()) / len(group)
        if (len(group), -error) > (len(best), -best_error):
            best, best_error = group, error
    return best


def _candidates(board: Board, views: Mapping[Key, BoardView], alone: Adjusted) -> dict[int, list[Candidate]]:
    """Return the possible poses of the board in each picture of a camera, by number."""
    (camera,) = alone.cameras
    lens = alone.lens(camera)
    rms = alone.rms_px
    half_turn = rigid(
        np.diag([-1.0, -1.0, 1.0]), board.square_m * np.array([board.columns - 1.0, board.rows - 1.0, 0.0])
    )
    found: dict[int, list[Candidate]] = {}
    for key, place in zip(alone.keys, alone.places, strict=True):
        adjusted = Candidate(alone.T_rig_board(place), rms[key])
        flat = pose_candidates(board.points[views[key].ids], views[key].corners, lens)
        # The adjusted pose knows the board's shape; of the flat board's two only the other one is news.
        others = [
            Candidate(each.T, adjusted.error_px * each.error_px / max(flat[0].error_px, 1e-6))
            for each in flat
            if not agree(each.T, adjusted.T, float(np.linalg.norm(each.T[:3, 3])))
        ]
        poses = [adjusted, *others]
        if half_turn_ambiguous(board):
            poses += [Candidate(each.T @ half_turn, each.error_px, turned=True) for each in poses]
        found[key[1]] = poses
    return found
