"""When the views do not tell where the camera sits, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.messages.base import wire_position
from rhot.rig import HeadsetFile, Rig, RigidTransform
from rhot.rig.calibration import today
from rhot_calibration.headset.collector import ViewCollector
from rhot_calibration.headset.fit import HUBER, HeadsetFit, fit_headset, mounting_error

FOOT_M: Final = 1.5
"""From a head to its feet."""
LEAST_VIEWS: Final = 40
MOST_ROTATION_SD_RAD: Final = float(np.radians(0.25))
MOST_POSITION_SD_M: Final = 0.006
"""With these a foot is 4 mm off; the thesis's marker stood within 3.0 mm."""
MOST_DEVIATION: Final = 3.0
"""Root mean square of all views, in standard deviations: the head's noise may be three times what is assumed."""
MOST_LEFT_OUT: Final = 0.25
FARTHEST_M: Final = 0.4
"""A camera on a headset is no farther from its middle."""
MOST_TILT_RAD: Final = float(np.radians(15.0))
FLAT_RAD: Final = float(np.radians(2.0))
"""Floors are flatter, and cards that lie on them."""
LATE_S: Final = 0.008
"""At 60 degrees a second the camera has turned by half a degree in that time."""


@dataclass(frozen=True, slots=True)
class Judged:
    """A fit that passed, and what a person should know about it.

    Attributes:
        fit: where the camera sits.
        left_out: views that contradict the others.
        tilt_rad: of the marker against the floor, by `up` of rig.toml.
        notes: sentences.
    """

    fit: HeadsetFit
    left_out: int
    tilt_rad: float
    notes: tuple[str, ...]


def judged(rig: Rig, collector: ViewCollector, size_m: float) -> Judged:
    """Fit the camera's pose to the views that were collected.

    Args:
        rig: with `[feet]`.
        collector: with its views.
        size_m: side of the marker's black square.

    Raises:
        CalibrationError: the views do not tell it; says what to do.
    """
    count = len(collector.views)
    if collector.camera is None or count < LEAST_VIEWS:
        raise CalibrationError(
            f"{count} views of marker {collector.marker_id}; {LEAST_VIEWS} are the least, {collector.wanted} are good. "
            "Lay it flat on the floor before you, well lit, and look at it from all sides for half a minute"
        )
    fit = fit_headset(collector.views, collector.camera, size_m, rig.T_head_camera)
    left_out = int(np.count_nonzero(fit.deviation > 2.0 * HUBER))
    up = np.array((0.0, 1.0, 0.0) if rig.config.feet is None else rig.config.feet.up)
    tilt_rad = float(np.arccos(np.clip(fit.T_rig_marker[:3, 2] @ up / np.linalg.norm(up), -1.0, 1.0)))
    # First this: views that contradict each other make everything uncertain.
    _check_agreement(fit, left_out, size_m)
    _check_motion(fit, collector)
    distance_m = float(np.linalg.norm(fit.T_head_camera[:3, 3]))
    if distance_m > FARTHEST_M:
        raise CalibrationError(
            f"the camera would sit {1e3 * distance_m:.0f} mm from the headset's middle, {1e3 * FARTHEST_M:.0f} are "
            "believable: is rhot/head the pose of this headset, and the marker "
            f"{1e3 * size_m:g} mm large (--size-mm)?"
        )
    if tilt_rad > MOST_TILT_RAD:
        raise CalibrationError(
            f"the marker would lie tilted by {np.degrees(tilt_rad):.0f}° from the floor: lay it flat, face up, and "
            "check `up` of [feet]: the direction against gravity in the frame of rhot/head"
        )
    return Judged(fit, left_out, tilt_rad, tuple(_notes(fit, left_out, tilt_rad, rig)))


def _check_motion(fit: HeadsetFit, collector: ViewCollector) -> None:
    rotation_sd, position_sd = fit.rotation_sd_rad, fit.position_sd_m
    if np.isfinite(rotation_sd) and rotation_sd <= MOST_ROTATION_SD_RAD and position_sd <= MOST_POSITION_SD_M:
        return
    spread = np.degrees(collector.spread_rad)
    more = f"{' and '.join(collector.lacking)} it more" if collector.lacking else "take more views"
    raise CalibrationError(
        f"too little motion: the camera's rotation is known to {np.degrees(rotation_sd):.2f}° (at most "
        f"{np.degrees(MOST_ROTATION_SD_RAD):g}°) and its position to {1e3 * position_sd:.1f} mm (at most "
        f"{1e3 * MOST_POSITION_SD_M:g} mm). The head nodded by ±{spread[0]:.0f}°, turned by ±{spread[1]:.0f}° and "
        f"tilted by ±{spread[2]:.0f}°: {more}, lean to all sides and bend your knees, with the marker in sight"
    )


def _check_agreement(fit: HeadsetFit, left_out: int, size_m: float) -> None:
    count = len(fit.deviation)
    typical = float(np.sqrt(np.mean(np.minimum(fit.deviation, 2.0 * HUBER) ** 2)))
    if typical <= MOST_DEVIATION and left_out <= MOST_LEFT_OUT * count:
        return
    raise CalibrationError(
        f"views and head contradict each other: {left_out} of {count} are far off, residual {fit.rms_px:.1f} px. Is "
        f"the black square {1e3 * size_m:g} mm wide (--size-mm), did the marker lie still, the headset's tracking "
        "work, and is the camera fixed to the headset?"
    )


def _notes(fit: HeadsetFit, left_out: int, tilt_rad: float, rig: Rig) -> list[str]:
    notes = []
    if left_out:
        notes.append(f"{left_out} views contradict the others and were left out")
    if tilt_rad > FLAT_RAD:
        notes.append(
            f"the marker lay tilted by {np.degrees(tilt_rad):.1f}° from what `up` of [feet] says is level; is the "
            "floor?"
        )
    if abs(fit.delay_s) > LATE_S:
        notes.append(
            f"the head's poses are {1e3 * abs(fit.delay_s):.0f} ms too {'late' if fit.delay_s > 0 else 'early'} "
            "against the pictures; feet of a head that turns will be off"
        )
    before = rig.T_head_camera
    if before is not None:
        angle_rad, distance_m = mounting_error(fit.T_head_camera, before)
        notes.append(
            f"the camera's pose so far was {np.degrees(angle_rad):.2f}° and {1e3 * distance_m:.1f} mm from this"
        )
    return notes


def report_lines(found: Judged) -> tuple[str, ...]:
    """Return what was found, in lines for people."""
    fit = found.fit
    right, up, back = 1e3 * fit.T_head_camera[:3, 3]
    pitch, yaw, roll = np.degrees(camera_angles_rad(fit.T_head_camera))
    return (
        f"residual  {fit.rms_px:.2f} px RMS over {len(fit.deviation) - found.left_out} views",
        f"position  {right:.1f} right, {up:.1f} up, {back:.1f} mm back of the head's middle, "
        f"± {1e3 * fit.position_sd_m:.1f} mm",
        f"pitch     {pitch:.2f}° down, yaw {yaw:.2f}° to the left, roll {roll:.2f}°, "
        f"± {np.degrees(fit.rotation_sd_rad):.2f}°",
        f"at a foot ± {1e3 * fit.foot_sd_m(FOOT_M):.1f} mm, {FOOT_M:g} m away",
        f"marker    flat within {np.degrees(found.tilt_rad):.1f}°; head's poses {1e3 * fit.delay_s:+.1f} ms",
    )


def camera_angles_rad(T_head_camera: FloatArray) -> tuple[float, float, float]:
    """Return pitch (down), yaw (to the left) and roll (clockwise, as the camera sees it), radians.

    T_head_camera = rotation_y(yaw) · rotation_x(−pitch) · diag(1, −1, −1) · rotation_z(roll).
    """
    R = T_head_camera[:3, :3]
    forward = R[:, 2]
    pitch = float(np.arcsin(np.clip(-forward[1], -1.0, 1.0)))
    yaw = float(np.arctan2(-forward[0], -forward[2]))
    level = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    roll = float(np.arctan2(-R[:, 1] @ level, R[:, 0] @ level))
    return pitch, yaw, roll


def headset_file(found: Judged) -> HeadsetFile:
    """Return the file to write."""
    fit = found.fit
    pose = RigidTransform.from_matrix(fit.T_head_camera)
    return HeadsetFile(
        date=today(),
        T_head_camera=pose.model_copy(update={"position": wire_position(np.round(fit.T_head_camera[:3, 3], 6))}),
        quality={
            "views": len(fit.deviation) - found.left_out,
            "left_out": found.left_out,
            "residual_rms_px": round(fit.rms_px, 3),
            "position_sd_mm": round(1e3 * fit.position_sd_m, 3),
            "rotation_sd_deg": round(float(np.degrees(fit.rotation_sd_rad)), 4),
            "foot_sd_mm": round(1e3 * fit.foot_sd_m(FOOT_M), 3),
            "marker_tilt_deg": round(float(np.degrees(found.tilt_rad)), 3),
            "head_delay_ms": round(1e3 * fit.delay_s, 3),
        },
    )
