"""What `rhot doctor` finds out about the floor: is it known, and can it be where `stage.json` says."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.bus import Bus
from rhot.errors import WireError
from rhot.geometry.transforms import inverse
from rhot.messages import HandPose, decode
from rhot.rig import Rig, StageFile
from rhot.rig.folder import STAGE_FILE, registration_path
from rhot.text import as_argument
from rhot_tools.operate.findings import Finding

_WORK_HEIGHTS_M: Final = (0.3, 2.2)
"""Where hands work: from the knees of who sits to the reach of who stands."""
_OVER_DESK_M: Final = (-0.05, 1.2)
"""Where a hand is over a desk at which somebody works."""
_UP_DIFFERS_DEG: Final = 3.0
_FLOOR_DIFFERS_M: Final = 0.05
"""Between two ways of finding the floor; a ruler and a room setup are good to a centimetre or two each."""


def check_stage(rig: Rig) -> Iterator[Finding]:
    """Look at a rig's `stage.json`: up, floor and cameras must fit each other."""
    again = f"rhot calibrate stage --live --board 9x6 --square-mm 25 --desk-mm 740 --rig {as_argument(rig.path)}"
    stage = rig.stage
    if stage is None:
        yield Finding("note", f"{STAGE_FILE} is missing: programs that want a floor get none", again)
        return
    T_stage_rig = inverse(stage.T_rig_stage.matrix)
    problems = [*_heights(rig, stage, T_stage_rig), *_against_registration(rig, stage)]
    yield from (Finding("warn", f"{STAGE_FILE}: {text}", again) for text in problems)
    if not problems:
        residual = "" if stage.residual_m is None else f", residual {1e3 * stage.residual_m:.1f} mm"
        yield Finding("ok", f"{STAGE_FILE}: of {stage.date or 'unknown date'}, by {stage.source}{residual}")


def _heights(rig: Rig, stage: StageFile, T_stage_rig: FloatArray) -> Iterator[str]:
    # Where a camera can be over the floor: not under a low table, not above a high ceiling.
    low, high = (0.3, 4.0)
    for name, camera in rig.cameras.items():
        height_m = _height(T_stage_rig, np.array(camera.T_rig_camera)[:3, 3])
        if not low <= height_m <= high:
            yield f"camera {name} would be {height_m:.2f} m over the floor; {low:g} to {high:g} m is possible"
        elif stage.desk_height_m is not None and height_m <= stage.desk_height_m:
            yield f"camera {name} would be {height_m:.2f} m over the floor, the desk {stage.desk_height_m:.2f} m"
    if rig.cameras:
        low, high = _WORK_HEIGHTS_M
        middle = np.mean(np.array(rig.config.fusion.volume_m), axis=0)
        height_m = _height(T_stage_rig, middle)
        if not low <= height_m <= high:
            yield (
                f"the middle of [fusion] volume_m would be {height_m:.2f} m over the floor; {low:g} to {high:g} m is "
                "where hands work"
            )


def _against_registration(rig: Rig, stage: StageFile) -> Iterator[str]:
    """Compare with the registered tracking system's space, which has a floor of its own."""
    file = registration_path(rig.path, "steamvr")
    if file is None:
        return
    T_tracker_stage = inverse(rig.registration_of("steamvr").T_rig_tracker.matrix) @ stage.T_rig_stage.matrix
    tilt_deg = float(np.degrees(np.arccos(np.clip(T_tracker_stage[1, 1], -1.0, 1.0))))
    floor_m = float(T_tracker_stage[1, 3])
    if tilt_deg > _UP_DIFFERS_DEG or abs(floor_m) > _FLOOR_DIFFERS_M:
        yield (
            f"{file.name} has the floor {100 * abs(floor_m):.0f} cm {'lower' if floor_m > 0 else 'higher'} and "
            f"{tilt_deg:.1f}° tilted against it; one of the two is old or wrong"
        )


async def check_hands(bus: Bus, rig: Rig) -> list[Finding]:
    """Look at what is tracked now: hands must be at heights where hands are."""
    if rig.stage is None:
        return []
    T_stage_rig = inverse(rig.stage.T_rig_stage.matrix)
    findings = []
    for reply in await bus.get("rhot/hand/*", timeout_s=1.0):
        try:
            hand = decode(reply.payload, HandPose) if not reply.error else None
        except WireError:
            continue  # whoever publishes it is told elsewhere
        wrist = None if hand is None else hand.joints.get("wrist")
        if hand is not None and wrist is not None:
            findings.append(_hand_finding(hand, _height(T_stage_rig, np.array(wrist.position)), rig.stage))
    return findings


def _hand_finding(hand: HandPose, height_m: float, stage: StageFile) -> Finding:
    desk_m = stage.desk_height_m
    low, high = _WORK_HEIGHTS_M if desk_m is None else (desk_m + _OVER_DESK_M[0], desk_m + _OVER_DESK_M[1])
    if low <= height_m <= high:
        return Finding("ok", f"the {hand.side} hand is {height_m:.2f} m over the floor")
    return Finding(
        "warn",
        f"the {hand.side} hand would be {height_m:.2f} m over the floor; {low:.2f} to {high:.2f} m is plausible",
        "is the desk's height right, and has nobody moved the cameras? rhot calibrate stage finds the floor again",
    )


def _height(T_stage_rig: FloatArray, point: FloatArray) -> float:
    return float(T_stage_rig[1, :3] @ point + T_stage_rig[1, 3])
