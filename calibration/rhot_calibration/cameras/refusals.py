"""What a calibration may not be: the reasons to refuse it, and those to warn."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.camera import CameraModel
from rhot_calibration.cameras.bundle.adjustment import Key
from rhot_calibration.cameras.figures import CameraFigures, ExpectedError
from rhot_calibration.cameras.live.coverage import camera_coverage, similar
from rhot_calibration.cameras.solve.causes import Cause
from rhot_calibration.cameras.solve.refusals import MIN_COMMON, MIN_VIEWS, find_bump
from rhot_calibration.cameras.solve.solve import Solution
from rhot_calibration.cameras.solve.views import BoardView, ViewSet

MAX_CONTRADICTING: Final = 0.34
"""Share of two cameras' common pictures that may contradict the others."""
MAX_RMS: Final = 1.5e-3
"""Reprojection RMS as a share of the picture's width: 1 px of 640 …"""
WARN_RMS: Final = 0.8e-3
"""… and from where it is worth a warning."""
MAX_FOCAL_SD: Final = 0.01
WARN_FOCAL_SD: Final = 0.004
"""Standard deviation of a focal length, as a share of it."""
MAX_BASELINE_ERROR: Final = 0.03
"""Largest deviation from a baseline that was measured."""
WARN_BASELINE_ERROR: Final = 0.15
"""Largest deviation from the places in `rig.toml`, which are only roughly meant."""
WARN_ERROR_M: Final = 0.01
"""Error in space, as a share of the distance, from which more pictures are asked for."""


@dataclass(frozen=True, slots=True)
class Expected:
    """What is known of the cameras' places before.

    Attributes:
        nominal: centres (3,) in the rig frame by camera, metres, from `rig.toml`: roughly meant.
        previous: centres (3,) of an earlier calibration; empty without one.
        baseline_m: measured distance of the first two cameras; None = not measured.
    """

    nominal: Mapping[str, FloatArray]
    previous: Mapping[str, FloatArray]
    baseline_m: float | None = None


def refuse_contradictions(solution: Solution, causes: Sequence[Cause]) -> list[str]:
    """Refuse when too many pictures contradict each other, and return warnings when a few do.

    Args:
        solution: what was found.
        causes: of the contradictions, one per number.

    Raises:
        CalibrationError: names the most frequent cause.
    """
    warnings = []
    for first, second in combinations(solution.adjusted.cameras, 2):
        common = _common(solution.views, first, second)
        good = {number for number in common if _together(solution, first, second, number)}
        bad = [cause for cause in causes if cause.keys[0][1] in common - good]
        bump = find_bump(solution.alone[first], solution.alone[second]) if len(bad) >= 3 else None
        if len(bad) > MAX_CONTRADICTING * len(common):
            usual, count = Counter(cause.kind for cause in bad).most_common(1)[0]
            why = bump.text(second, first) if bump is not None and usual == "moved" else _EXPLAINED[usual]
            raise CalibrationError(
                f"{len(bad)} of the {len(common)} pictures that {first} and {second} have in common contradict the "
                f"others (numbers {', '.join(str(cause.keys[0][1]) for cause in bad)}); {count} of them because {why}"
            )
        if bump is not None and any(cause.kind == "moved" for cause in bad):
            warnings.append(bump.text(second, first))
        if len(good) < MIN_COMMON and len(solution.adjusted.cameras) == 2:
            raise CalibrationError(
                f"{first} and {second} have {len(good)} usable pictures in common, {MIN_COMMON} are the least and 15 "
                "to 30 are good: take more in which both see the whole board"
            )
    return warnings


_EXPLAINED: Final = {
    "mirrored": "they are mirrored: switch mirroring off and take them again",
    "exchanged": "the pictures of the two cameras are swapped: sort them into the right folders",
    "size": "they show a board with squares of another size: use one board and state its size",
    "unfit": "they do not show this board",
    "moved": "a camera or the board moved between the pictures of one number: hold the board still, take both at once",
}


def _common(views: Mapping[Key, object], first: str, second: str) -> set[int]:
    numbers = [{number for name, number in views if name == camera} for camera in (first, second)]
    return numbers[0] & numbers[1]


def _together(solution: Solution, first: str, second: str, number: int) -> bool:
    places = {solution.place_of.get((name, number)) for name in (first, second)}
    return len(places) == 1 and None not in places


def refuse_poor(
    views: ViewSet, solution: Solution, cameras: Mapping[str, CameraFigures], models: Mapping[str, CameraModel]
) -> list[str]:
    """Refuse what is too inaccurate, and return warnings about what is only poor.

    Raises:
        CalibrationError: RMS too high, views too few or too similar.
    """
    warnings = []
    coverage = camera_coverage(views)
    for name, figures in cameras.items():
        width = models[name].width
        if figures.rms_px > MAX_RMS * width:
            _refuse_bumps(solution)
        if figures.rms_px > MAX_RMS * width:
            raise CalibrationError(
                f"camera {name}: reprojection error {figures.rms_px:.2f} px RMS, at most {MAX_RMS * width:.2f} px are "
                "allowed. Is the board flat and glued to something stiff, was it held still, are the pictures sharp, "
                "and is it the board that was stated?"
            )
        # So many of the things that are missing are told at once.
        missing = "; ".join(coverage[name].missing[:4]) or "more pictures, at other places and tilts"
        seen = [view for key, view in solution.views.items() if key[0] == name]
        different = _different(seen, width)
        if different < MIN_VIEWS:
            raise CalibrationError(
                f"camera {name}: of {len(seen)} pictures only {different} differ from one another, {MIN_VIEWS} are the "
                f"least. Still missing: {missing}"
            )
        share = float(max(figures.lens_sd[0], figures.lens_sd[1]) / models[name].K[0, 0])
        if share > MAX_FOCAL_SD:
            raise CalibrationError(
                f"camera {name}: the pictures are too similar to tell the focal length to better than "
                f"{100 * share:.1f} % (at most {100 * MAX_FOCAL_SD:g} % is allowed). Still missing: {missing}"
            )
        if share > WARN_FOCAL_SD:
            warnings.append(f"{name}: focal length known to ±{100 * share:.2f} % only; still missing: {missing}")
        if figures.rms_px > WARN_RMS * width:
            warnings.append(f"{name}: reprojection error {figures.rms_px:.2f} px is high; is the board flat and stiff?")
    return warnings


def _refuse_bumps(solution: Solution) -> None:
    for first, second in combinations(solution.adjusted.cameras, 2):
        bump = find_bump(solution.alone[first], solution.alone[second])
        if bump is not None:
            raise CalibrationError(bump.text(second, first))


def _different(seen: Sequence[BoardView], width: int) -> int:
    chosen: list[BoardView] = []
    for view in seen:
        if not any(similar(view, other, width) for other in chosen):
            chosen.append(view)
    return len(chosen)


def refuse_impossible(
    solution: Solution, models: Mapping[str, CameraModel], expected: Expected, square_m: float
) -> list[str]:
    """Refuse cameras where they cannot be, and return warnings about what is only unlikely.

    Raises:
        CalibrationError: below the desk, swapped, or a scale that contradicts a measured baseline.
    """
    names = list(models)
    centers = {name: model.center for name, model in models.items()}
    desk = float(np.median(solution.adjusted.bundle.geometry.board_t[:, 2]))
    reference_axis = models[names[0]].T_rig_camera[:3, 2]
    for name in names[1:]:
        facing = float(models[name].T_rig_camera[:3, 2] @ reference_axis)
        if centers[name][2] > desk and facing < 0.0:
            raise CalibrationError(
                f"camera {name} comes out {1e3 * centers[name][2]:.0f} mm below {names[0]}, under the desk and looking "
                "up: its pictures are mirrored, or the board was numbered from its other side; use a board whose "
                "counts of corners are one even and one odd, or a ChArUco board"
            )
    warnings = _swapped(names, centers, expected)
    first, second = names[0], names[1]
    found = float(np.linalg.norm(centers[second] - centers[first]))
    if expected.baseline_m is not None and abs(found / expected.baseline_m - 1.0) > MAX_BASELINE_ERROR:
        fitting = 1e3 * square_m * expected.baseline_m / found
        raise CalibrationError(
            f"{first} and {second} come out {1e3 * found:.1f} mm apart, {1e3 * expected.baseline_m:.1f} mm were "
            f"measured: with that baseline the squares would be {fitting:.2f} mm instead of {1e3 * square_m:g} mm. "
            "Measure a square again (ten of them, divided by ten), and the distance of the two lenses"
        )
    nominal = float(np.linalg.norm(expected.nominal[second] - expected.nominal[first]))
    if expected.baseline_m is None and nominal > 0.0 and abs(found / nominal - 1.0) > WARN_BASELINE_ERROR:
        warnings.append(
            f"{first} and {second} come out {1e3 * found:.1f} mm apart, rig.toml says {1e3 * nominal:.0f} mm "
            "(position_m): is the size of the squares right?"
        )
    return warnings


_MIRRORED_OR_SWAPPED: Final = (
    "Look at a picture with writing in it: if it reads backwards, the cameras mirror (switch that off, take all "
    "pictures again); if not, exchange the two folders (or the cables)"
)


def _swapped(names: Sequence[str], centers: Mapping[str, FloatArray], expected: Expected) -> list[str]:
    """Refuse cameras that stand the other way round than in the last calibration or in `rig.toml`.

    Exchanging the folders of cameras that both mirror would give a mirrored world, which fits as well. Cameras that
    stand elsewhere, and would do so with exchanged names, too, are only worth a warning: `rig.toml` is roughly meant.

    Raises:
        CalibrationError: names the two cameras.
    """
    warnings = []
    # What was calibrated before was accepted then.
    is_known = all(name in expected.previous for name in names)
    known = expected.previous if is_known else expected.nominal
    for first, second in _opposite(names, centers, known):
        exchanged = {**centers, first: centers[second], second: centers[first]}
        where = (
            f"{second} stands {_direction(centers[second] - centers[first])} of {first}, rig.toml (position_m) has it "
            f"{_direction(known[second] - known[first])}"
        )
        if is_known:
            raise CalibrationError(
                f"{first} and {second} are swapped: {second} stands on the other side of {first} than in the "
                f"present cameras.json. {_MIRRORED_OR_SWAPPED}; if the cameras really changed places, move "
                "cameras.json away first"
            )
        if not _opposite(names, exchanged, known):
            raise CalibrationError(
                f"{first} and {second} are swapped: {where}. {_MIRRORED_OR_SWAPPED}; if {second} really stands there, "
                "state so in rig.toml"
            )
        warnings.append(where)
    return warnings


def _opposite(
    names: Sequence[str], centers: Mapping[str, FloatArray], known: Mapping[str, FloatArray]
) -> list[tuple[str, str]]:
    """Return the pairs of cameras that stand opposite to where they are known to, by more than half of the way.

    No mere turn of the reference camera explains that.
    """
    pairs = []
    for first, second in combinations(names, 2):
        if first not in known or second not in known:
            continue
        found, before = centers[second] - centers[first], known[second] - known[first]
        length = float(np.linalg.norm(before))
        if length >= 0.01 and float(found @ before) <= -0.5 * length * float(np.linalg.norm(found)):
            pairs.append((first, second))
    return pairs


def _direction(shift: FloatArray) -> str:
    axis = int(np.argmax(np.abs(shift)))
    words = (("left", "right"), ("above", "below"), ("behind", "in front"))[axis]
    return f"{1e3 * abs(shift[axis]):.0f} mm {words[int(shift[axis] > 0)]}"


def accuracy_warnings(errors: Sequence[ExpectedError]) -> list[str]:
    """Return what the expected errors ask for."""
    poor = [error for error in errors if error.calibration_mm > 1e3 * WARN_ERROR_M * error.distance_m]
    if not poor:
        return []
    worst = poor[-1]
    return [
        f"points {100 * worst.distance_m:.0f} cm away will be off by about {worst.calibration_mm:.1f} mm from this "
        "calibration alone: more pictures with the board tilted, near and in the corners of the picture improve it"
    ]
