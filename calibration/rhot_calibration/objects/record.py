"""What `registration.json` says about its own registration, and how a later one starts from it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationError

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot.messages import first_problem
from rhot.messages.base import wire_position, wire_quaternion
from rhot.rig import RegistrationFile, RigidTransform
from rhot.rig.calibration import today
from rhot.rig.file_model import FileModel, Vector3
from rhot_calibration.objects.fit import LEVER, PARAMETERS, POSITION, ROTATION, Estimate, Places, RegistrationFit

_Row = Annotated[tuple[float, ...], Field(min_length=PARAMETERS, max_length=PARAMETERS)]
_LARGEST_SURPRISE = 5.0
"""A correction of more than this many standard deviations of what was expected is none."""


class TouchQuality(FileModel):
    """How the frame of one object on its device was found by touching it.

    Attributes:
        date: of the touches, ISO 8601.
        finger: side and finger, such as `right index`.
        touches, left_out: how many were used and how many contradicted the others.
        residual_rms_mm: distance of the finger's skin from the faces.
        position_sd_mm, rotation_sd_deg: along the least certain direction, about the least certain axis.
        flesh_mm: what the finger kept from the faces beyond its radius.
    """

    date: str
    finger: str
    touches: int
    left_out: int
    residual_rms_mm: float
    position_sd_mm: float
    rotation_sd_deg: float
    flesh_mm: float


class RegistrationQuality(FileModel):
    """`quality` of `registration.json` as `rhot calibrate objects` writes it.

    Attributes:
        method: fitted to places alone, or an earlier registration corrected by them.
        places, left_out: how many were used, and the names of those that were not.
        residual_rms_mm: distance between measured and fitted positions.
        position_sd_mm: standard deviation of the centre's position, root of the sum of the three variances.
        rotation_sd_deg: about the least certain axis.
        object, marker: what was shown, empty when a table did not say it.
        center_tracker_m: the point of the tracker's space that the covariance is about.
        lever_m: the marker in the device's frame, metres; not the object's own frame, which is `T_tracker_object`.
        covariance: (9, 9) of rotation vector (rad, rig frame), centre in the rig (m) and lever arm (m).
        moved_mm, turned_deg: what a re-alignment changed at the centre.
        touched: objects whose frames on their devices were found by touching them.
    """

    method: Literal["places", "realigned"]
    places: int
    left_out: tuple[str, ...] = ()
    residual_rms_mm: float
    position_sd_mm: float
    rotation_sd_deg: float
    object: str = ""
    marker: str = ""
    center_tracker_m: Vector3
    lever_m: Vector3
    covariance: Annotated[tuple[_Row, ...], Field(min_length=PARAMETERS, max_length=PARAMETERS)]
    moved_mm: float | None = None
    turned_deg: float | None = None
    touched: dict[str, TouchQuality] | None = None


def read_quality(path: Path, file: RegistrationFile) -> RegistrationQuality | None:
    """Return the quality record of a registration; None when it was not written by `rhot calibrate objects`.

    Raises:
        CalibrationError: it was, and is damaged; names the field.
    """
    if not isinstance(file.quality, dict) or "covariance" not in file.quality:
        return None
    remedy = "register again without --realign"
    try:
        record = RegistrationQuality.model_validate(file.quality)
    except ValidationError as error:
        raise CalibrationError(f"{path}: quality.{first_problem(error)}; {remedy}") from error
    covariance = np.array(record.covariance)
    if not np.allclose(covariance, covariance.T, rtol=1e-3, atol=1e-12) or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise CalibrationError(f"{path}: quality.covariance is not a covariance (symmetric, positive); {remedy}")
    return record


def prior_of(
    file: RegistrationFile,
    record: RegistrationQuality | None,
    places: Places,
    *,
    lever_m: FloatArray | None,
    lever_sd_m: float,
    drift_m: float,
    drift_rad: float,
) -> Estimate:
    """Return what an earlier registration says about today's.

    Args:
        file: the earlier registration.
        record: its quality, when it has one.
        places: today's, for the centre when there is no record.
        lever_m: (3,) metres, the marker on the device when it is not the recorded one; None = as recorded.
        lever_sd_m: its standard deviation along each axis.
        drift_m: standard deviation of what the centre may have moved since, along each axis.
        drift_rad: standard deviation of what the space may have rotated since, about each axis.
    """
    R = rotation_from_quaternion(np.array(file.T_rig_tracker.orientation))
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    lever = np.zeros(3)
    if record is None:
        center = places.marker_in_space(lever if lever_m is None else lever_m).mean(axis=0)
    else:
        center, lever = np.array(record.center_tracker_m), np.array(record.lever_m)
        covariance = np.array(record.covariance)
    if record is None or lever_m is not None:
        lever = lever if lever_m is None else lever_m
        covariance[LEVER, :], covariance[:, LEVER] = 0.0, 0.0
        covariance[LEVER, LEVER] = np.eye(3) * lever_sd_m**2
    covariance[ROTATION, ROTATION] += np.eye(3) * drift_rad**2
    covariance[POSITION, POSITION] += np.eye(3) * drift_m**2
    center_rig = R @ center + np.array(file.T_rig_tracker.position)
    return Estimate(R, center, center_rig, lever, covariance)


def change(prior: Estimate, estimate: Estimate) -> tuple[float, float]:
    """Return how far a correction moved the centre, metres, and rotated the space, radians."""
    step = estimate.offset_from(prior)
    return float(np.linalg.norm(step[POSITION])), float(np.linalg.norm(step[ROTATION]))


def check_change(prior: Estimate, estimate: Estimate) -> None:
    """Refuse a correction that is none.

    Raises:
        CalibrationError: the places are further from the earlier registration than it may have drifted.
    """
    step = estimate.offset_from(prior)
    surprise = float(np.sqrt(step @ np.linalg.solve(prior.covariance, step)))
    if surprise > _LARGEST_SURPRISE:
        moved_m, rotated_rad = change(prior, estimate)
        raise CalibrationError(
            f"the places lie {1e3 * moved_m:.0f} mm and {np.degrees(rotated_rad):.1f}° from the earlier registration, "
            f"{surprise:.0f} standard deviations; {_LARGEST_SURPRISE:.0f} is the limit of a re-alignment. Register "
            "again without --realign, with ten places, or allow more with --drift-mm and --drift-deg"
        )


def registration_file(
    fit: RegistrationFit,
    places: Places,
    earlier: RegistrationFile,
    *,
    object_id: str = "",
    marker: str = "",
    prior: Estimate | None = None,
) -> RegistrationFile:
    """Return the file to write.

    Args:
        fit: the registration.
        places: what it was fitted to.
        earlier: the file that it replaces; its objects' frames on their devices stay.
        object_id, marker: what was shown.
        prior: the earlier registration that was corrected; None = fitted to places alone.
    """
    estimate = fit.estimate
    moved = None if prior is None else change(prior, estimate)
    quality = RegistrationQuality(
        method="places" if prior is None else "realigned",
        places=int(np.count_nonzero(fit.kept)),
        left_out=tuple(name for name, kept in zip(places.names, fit.kept, strict=True) if not kept),
        residual_rms_mm=round(1e3 * fit.rms_m, 4),
        position_sd_mm=round(1e3 * float(np.linalg.norm(estimate.position_sd_m)), 4),
        rotation_sd_deg=round(float(np.degrees(estimate.rotation_sd_rad)), 5),
        object=object_id,
        marker=marker,
        center_tracker_m=wire_position(estimate.center_space),
        lever_m=wire_position(estimate.lever_m),
        covariance=tuple(tuple(row) for row in estimate.covariance.tolist()),
        moved_mm=None if moved is None else round(1e3 * moved[0], 4),
        turned_deg=None if moved is None else round(float(np.degrees(moved[1])), 5),
    ).model_dump(mode="json", exclude_none=True)
    if isinstance(earlier.quality, dict) and "touched" in earlier.quality:
        quality["touched"] = earlier.quality["touched"]
    orientation = wire_quaternion(quaternion_from_rotation(estimate.R_rig_tracker))
    return RegistrationFile(
        date=today(),
        quality=quality,
        T_rig_tracker=RigidTransform(position=wire_position(estimate.t_rig_tracker), orientation=orientation),
        T_tracker_object=earlier.T_tracker_object,
    )
