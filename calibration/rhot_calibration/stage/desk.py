"""The plane of a desk, from a calibration board that lies on it at one place or several.

All pictures are explained at once by one plane, on which each board has a position and a rotation of its own; what is
minimised is the distance in pixels between the corners found and the corners expected. Boards that do not lie in that
plane, such as those held in the air for calibrating the cameras, are left out: the desk is the plane in which most
boards lie, and nothing lies under it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from scipy.optimize import least_squares

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import rigid, rotation_from_vector, vector_from_rotation
from rhot_calibration.cameras.board.grid import half_turn_ambiguous
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet

SAME_PLANE_M: Final = 0.004
"""RMS distance of a board's corners from the desk's plane up to which it lies on the desk: twice what the intrinsics'
error of 0.2 % amounts to at 1 m, and what a board of 20 cm has at its rim when it is tilted by 3°."""
MAX_RESIDUAL_PX: Final = 1.5
"""RMS, above which board, cameras and pictures do not belong together; good calibrations have 0.1 to 0.4 px."""
_PLANE: Final = 3
_PLACE: Final = 3
_X: Final = np.array([1.0, 0.0, 0.0])
_Z: Final = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class DeskFit:
    """A desk's plane, `up · p = offset_m`, rig frame.

    Attributes:
        up: (3,) unit normal, towards the cameras.
        offset_m: metres.
        middle: (3,) metres, the middle of all corners, on the plane.
        residual_m: how well cameras and corners agree on the plane: the RMS distance from it of the corners, each
            triangulated by itself, and of the boards' middles as each camera alone has them, from the board's size;
            root of the sum of squares. None where one camera alone saw the desk, which says nothing about its lens.
        rms_px: of the corners in the pictures, per coordinate.
        tilt_sd_rad: standard deviation of `up` in its least certain direction, from the corners' scatter alone.
        height_sd_m: standard deviation of the plane's height at `middle`; same.
        boards: how many places were used.
        left_out: picture number to why it was not.
    """

    up: FloatArray
    offset_m: float
    middle: FloatArray
    residual_m: float | None
    rms_px: float
    tilt_sd_rad: float
    height_sd_m: float
    boards: int
    left_out: Mapping[int, str]


@dataclass(frozen=True, slots=True)
class _Place:
    """One place of the board: what the cameras saw of it, its pose, and how far the corners are from that, pixels."""

    seen: Mapping[str, BoardView]
    T_rig_board: FloatArray
    rms_px: float

    def corners(self, board: Board) -> FloatArray:
        """Return all inner corners (N, 3), metres, rig frame."""
        return _moved(self.T_rig_board, board.points)


def fit_desk(cameras: Mapping[str, CameraModel], views: ViewSet) -> DeskFit:
    """Return the plane in which the boards lie.

    Args:
        cameras: calibrated, by name.
        views: where the board was found; pictures of one number show it at one place.

    Raises:
        CalibrationError: no board was found, the pictures do not fit the cameras, or the boards share no plane.
    """
    places = {number: _located(cameras, views.board, seen) for number, seen in _by_number(views).items()}
    if not places:
        raise CalibrationError(
            f"no picture shows the board ({views.board}): it must lie wholly in view of at least one camera, flat and "
            "evenly lit; check --board (inner corners) and --square-mm"
        )
    _refuse_misfit(float(np.median([place.rms_px for place in places.values()])))
    center = np.mean([camera.center for camera in cameras.values()], axis=0)
    chosen, left_out = _lying(places, views.board, center)
    return _fitted(cameras, views.board, [places[number] for number in chosen], center, left_out)


def residual_text(fit: DeskFit) -> str:
    """Return the residual for people."""
    return "not known from one camera" if fit.residual_m is None else f"{1e3 * fit.residual_m:.1f} mm"


def _by_number(views: ViewSet) -> dict[int, dict[str, BoardView]]:
    found: dict[int, dict[str, BoardView]] = {}
    for (name, number), view in views.views.items():
        min_corners = 6
        if len(view.ids) >= min_corners:
            found.setdefault(number, {})[name] = view
    return dict(sorted(found.items()))


def _located(cameras: Mapping[str, CameraModel], board: Board, seen: Mapping[str, BoardView]) -> _Place:
    """Return a place with the pose that fits what all its cameras saw."""
    first = max(seen, key=lambda name: len(seen[name].ids))
    best: _Place | None = None
    for start in _poses_from(cameras[first], board, seen[first]):
        # Cameras on opposite sides of a plain board may number its corners from opposite ends.
        numbered = {name: _numbered(cameras[name], board, view, start) for name, view in seen.items()}
        refined = least_squares(_pose_residuals, np.zeros(6), args=(start, cameras, board, numbered))
        rms_px = float(np.sqrt((refined.fun**2).mean()))
        if best is None or rms_px < best.rms_px:
            best = _Place(numbered, _stepped(start, refined.x), rms_px)
    if best is None:
        raise CalibrationError("no pose fits a picture of the board; take the pictures again")
    return best


def _poses_from(camera: CameraModel, board: Board, view: BoardView) -> list[FloatArray]:
    """Return the two poses T_rig_board that a single view of a plane allows."""
    pixels = camera.undistort(view.corners)
    found, turns, moves, _ = cv2.solvePnPGeneric(
        board.points[view.ids], pixels, np.eye(3), np.zeros(0), flags=cv2.SOLVEPNP_IPPE
    )
    poses = []
    for turn, move in zip(turns, moves, strict=True) if found else ():
        T_camera_board = rigid(
            rotation_from_vector(np.asarray(turn, np.float64).ravel()), np.asarray(move, np.float64).ravel()
        )
        poses.append(camera.T_rig_camera @ T_camera_board)
    return poses


def _numbered(camera: CameraModel, board: Board, view: BoardView, T_rig_board: FloatArray) -> BoardView:
    if not half_turn_ambiguous(board):
        return view
    other = BoardView(len(board.points) - 1 - view.ids[::-1], view.corners[::-1], view.sharpness)
    errors = [
        np.nansum((camera.project(_moved(T_rig_board, board.points[v.ids])) - v.corners) ** 2) for v in (view, other)
    ]
    return view if errors[0] <= errors[1] else other


def _pose_residuals(
    step: FloatArray, start: FloatArray, cameras: Mapping[str, CameraModel], board: Board, seen: Mapping[str, BoardView]
) -> FloatArray:
    return _misses(cameras, board, seen, _stepped(start, step))


def _misses(
    cameras: Mapping[str, CameraModel], board: Board, seen: Mapping[str, BoardView], T_rig_board: FloatArray
) -> FloatArray:
    parts = [
        (cameras[name].project(_moved(T_rig_board, board.points[view.ids])) - view.corners).ravel()
        for name, view in seen.items()
    ]
    return np.nan_to_num(np.concatenate(parts), nan=1e3)


def _stepped(T: FloatArray, step: FloatArray) -> FloatArray:
    return rigid(rotation_from_vector(step[:3]) @ T[:3, :3], T[:3, 3] + step[3:])


def _moved(T: FloatArray, points: FloatArray) -> FloatArray:
    moved: FloatArray = points @ T[:3, :3].T + T[:3, 3]
    return moved


def _lying(places: Mapping[int, _Place], board: Board, center: FloatArray) -> tuple[list[int], dict[int, str]]:
    """Return the numbers of the boards that lie on the desk, and why the others are left out."""
    if len(places) == 1:
        return list(places), {}
    corners = {number: place.corners(board) for number, place in places.items()}
    best: list[int] = []
    depth = -np.inf
    for place in places.values():
        up, offset = _plane_of(place.T_rig_board, center)
        heights = {number: points @ up - offset for number, points in corners.items()}
        if any(float(each.mean()) < -SAME_PLANE_M for each in heights.values()):
            continue
        lying = [number for number, each in heights.items() if float(np.sqrt((each**2).mean())) <= SAME_PLANE_M]
        below = float(center @ up - offset)
        if (len(lying), below) > (len(best), depth):
            best, depth = lying, below
    if len(best) < 2:
        raise CalibrationError(
            f"no two of {len(places)} pictures show the board in one plane with all others above it, so none can be "
            "told to lie on the desk; lay it flat on the desk for at least two, or give one picture of it alone"
        )
    return best, {number: "not in the desk's plane" for number in places if number not in best}


def _plane_of(T_rig_board: FloatArray, center: FloatArray) -> tuple[FloatArray, float]:
    normal = T_rig_board[:3, 2]
    up = -normal if (center - T_rig_board[:3, 3]) @ normal < 0.0 else normal
    return up, float(up @ T_rig_board[:3, 3])


def _fitted(
    cameras: Mapping[str, CameraModel],
    board: Board,
    places: Sequence[_Place],
    center: FloatArray,
    left_out: Mapping[int, str],
) -> DeskFit:
    corners = np.concatenate([place.corners(board) for place in places])
    start_middle = corners.mean(axis=0)
    normal = np.linalg.svd(corners - start_middle)[2][2] if len(places) > 1 else places[0].T_rig_board[:3, 2]
    normal = -normal if (center - start_middle) @ normal < 0.0 else normal
    # Axes of the plane: two in it and `up`; a step turns them about the first two and lifts them along the third.
    R_rig_desk = _axes(normal)
    flat = [_on_plane(R_rig_desk, start_middle, place.T_rig_board) for place in places]

    def residuals(x: FloatArray) -> FloatArray:
        R = R_rig_desk @ rotation_from_vector(np.array([x[0], x[1], 0.0]))
        parts = []
        for index, (place, (x0, y0, yaw0, facing)) in enumerate(zip(places, flat, strict=True)):
            dx, dy, dyaw = x[_PLANE + _PLACE * index : _PLANE + _PLACE * (index + 1)]
            R_desk_board = rotation_from_vector((yaw0 + dyaw) * _Z) @ facing
            T = rigid(R @ R_desk_board, start_middle + R @ np.array([x0 + dx, y0 + dy, x[2]]))
            parts.append(_misses(cameras, board, place.seen, T))
        return np.concatenate(parts)

    solved = least_squares(residuals, np.zeros(_PLANE + _PLACE * len(places)), x_scale="jac")
    rms_px = float(np.sqrt((solved.fun**2).mean()))
    _refuse_misfit(rms_px)
    freedom = max(1, len(solved.fun) - len(solved.x))
    covariance = np.linalg.pinv(solved.jac.T @ solved.jac)[:_PLANE, :_PLANE] * (solved.fun**2).sum() / freedom
    R = R_rig_desk @ rotation_from_vector(np.array([solved.x[0], solved.x[1], 0.0]))
    up, point = R[:, 2], start_middle + R @ np.array([0.0, 0.0, solved.x[2]])
    offset = float(up @ point)
    middle = start_middle - (up @ start_middle - offset) * up
    return DeskFit(
        up=up,
        offset_m=offset,
        middle=middle,
        residual_m=_disagreement_m(cameras, board, places, up, offset),
        rms_px=rms_px,
        tilt_sd_rad=float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])),
        height_sd_m=float(np.sqrt(covariance[2, 2])),
        boards=len(places),
        left_out=left_out,
    )


def _refuse_misfit(rms_px: float) -> None:
    if rms_px > MAX_RESIDUAL_PX:
        raise CalibrationError(
            f"the board's corners are {rms_px:.1f} px (RMS) from where this board would have them in these cameras; "
            f"{MAX_RESIDUAL_PX:g} px is the limit. Did the board lie still and flat, do --board and --square-mm fit "
            "it, and have the cameras stood still since their calibration? `rhot doctor` checks that"
        )


def _axes(up: FloatArray) -> FloatArray:
    """Return a rotation (3, 3) whose third column is `up`."""
    first = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(up, first), up])


def _on_plane(
    R_rig_desk: FloatArray, origin: FloatArray, T_rig_board: FloatArray
) -> tuple[float, float, float, FloatArray]:
    """Return where a board lies in the desk's axes: x, y, yaw, and which of its faces is up as a rotation."""
    R_desk_board = R_rig_desk.T @ T_rig_board[:3, :3]
    x, y, _ = R_rig_desk.T @ (T_rig_board[:3, 3] - origin)
    facing = np.eye(3) if R_desk_board[2, 2] > 0.0 else rotation_from_vector(np.pi * _X)
    turned = vector_from_rotation(R_desk_board @ facing.T)
    return float(x), float(y), float(turned[2]), facing


def _disagreement_m(
    cameras: Mapping[str, CameraModel], board: Board, places: Sequence[_Place], up: FloatArray, offset: float
) -> float | None:
    """Return how far corners and cameras are from the plane (see `DeskFit.residual_m`); None with one camera alone."""
    if len({name for place in places for name in place.seen}) < 2:
        return None
    corners: list[float] = []
    boards: list[float] = []
    for place in places:
        for corner in range(len(board.points)):
            rays = [
                (cameras[name], view.corners[view.ids == corner])
                for name, view in place.seen.items()
                if (view.ids == corner).any()
            ]
            if len(rays) >= 2:
                corners.append(float(triangulated(rays) @ up) - offset)
        for name, view in place.seen.items():
            alone = least_squares(_pose_residuals, np.zeros(6), args=(place.T_rig_board, cameras, board, {name: view}))
            T_rig_board = _stepped(place.T_rig_board, alone.x)
            boards.append(float(_moved(T_rig_board, board.points).mean(axis=0) @ up) - offset)
    return float(np.sqrt(sum(np.mean(np.square(part)) for part in (corners, boards) if part)))


def triangulated(rays: Sequence[tuple[CameraModel, FloatArray]]) -> FloatArray:
    """Return the point (3,) nearest to the viewing rays of pixels (1, 2)."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for camera, pixel in rays:
        direction = camera.rays(pixel)[0]
        across = np.eye(3) - np.outer(direction, direction)
        A += across
        b += across @ camera.center
    return np.asarray(np.linalg.solve(A, b), np.float64)
