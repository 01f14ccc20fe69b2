"""A whole recording of one foot by its inertial sensor alone, and how far it is from the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot_bench.steps.walks import read_places
from rhot_feet.filter.inertial import InertialModel
from rhot_feet.filter.strapdown import (
    ACCELEROMETER,
    ATTITUDE,
    GYROSCOPE,
    POSITION,
    SIZE,
    VELOCITY,
    InertialNoise,
    InertialState,
    Strapdown,
)
from rhot_feet.filter.zero_velocity_update import zero_velocity_update
from rhot_feet.imu.samples import GRAVITY_M_S2, ImuSamples, level_rotation
from rhot_feet.imu.track import InertialStep
from rhot_feet.imu.zero_velocity_detector import MOVING, ZeroVelocity, ZeroVelocityDetector, ZeroVelocitySettings
from rhot_feet.sources.imu.recorded import read_samples
from rhot_tools.measures.rows import Row

# Dead reckoning by kind of motion, and with the detector's constants chosen without the trial that is judged.
#
# The detector has few constants and no trained part. Each is made smaller and larger; for every recording those
# constants are chosen that do best on all others, at their own speed and played faster, and judged on the one (leave-
# one-out cross-validation). How the mean changes with each constant is its sensitivity.

MM: Final = 1e3
OF_PUBLISHED: Final = 1.2
"""A kind of motion may be so much worse than the published best detector, chosen and tuned for each trial."""
_DEFAULT: Final = ZeroVelocitySettings()
CANDIDATES: Final[Mapping[str, ZeroVelocitySettings]] = {
    "as they are": _DEFAULT,
    "lowest / 3": replace(_DEFAULT, lowest=_DEFAULT.lowest / 3.0),
    "lowest x 3": replace(_DEFAULT, lowest=_DEFAULT.lowest * 3.0),
    "share / 3": replace(_DEFAULT, share=_DEFAULT.share / 3.0),
    "share x 3": replace(_DEFAULT, share=_DEFAULT.share * 3.0),
    "lever_m x 0.6": replace(_DEFAULT, lever_m=_DEFAULT.lever_m * 0.6),
    "lever_m x 1.5": replace(_DEFAULT, lever_m=_DEFAULT.lever_m * 1.5),
}
_KINDS: Final = ("running", "moved by hand", "walking")


@dataclass(frozen=True, slots=True)
class Reckoned:
    """Errors of one recording by each candidate, metres.

    Attributes:
        motion: what the person does, as the data set's table says.
        published_m: error of the best detector.
        error_m: (C,) at its own speed, by each of `CANDIDATES`.
        faster_m: (C,) played faster.
    """

    motion: str
    published_m: float
    error_m: FloatArray
    faster_m: FloatArray

    @property
    def kind(self) -> str:
        """Kind of motion."""
        return kind_of(self.motion)


def kind_of(motion: str) -> str:
    """Return the kind of a motion that is described in words."""
    if motion.startswith("run"):
        return _KINDS[0]
    return _KINDS[1] if "lifted" in motion else _KINDS[2]


def reckoned(file: Path, motion: str, published_m: float, times: float) -> Reckoned:
    """Return the errors of a recording; `times` as fast is what is played faster."""
    samples, truth = read_samples(file), read_places(file)
    quick = faster(samples, times)
    errors, fasts = (
        np.array([horizontal_error_m(reckon(each, detector=found), truth) for found in CANDIDATES.values()])
        for each in (samples, quick)
    )
    return Reckoned(motion, published_m, errors, fasts)


def kind_rows(motions: Sequence[str], errors_mm: Sequence[float], published_mm: Sequence[float]) -> list[Row]:
    """Return mean and worst of each kind of motion, beside what is published of the same recordings."""
    rows = []
    for kind in _KINDS:
        chosen = [k for k, motion in enumerate(motions) if kind_of(motion) == kind]
        if not chosen:
            continue
        ours, theirs = ([values[k] for k in chosen] for values in (errors_mm, published_mm))
        limit = round(OF_PUBLISHED * float(np.mean(theirs)), 1)
        name = f"{kind}, {len(chosen)} trials"
        rows += [
            Row(f"{name}, mean", float(np.mean(ours)), "mm", most=limit, peer=f"{np.mean(theirs):.0f} mm"),
            Row("    worst", max(ours), "mm", peer=f"{max(theirs):.0f} mm"),
        ]
    return rows


def held_out_rows(trials: Sequence[Reckoned], times: float) -> list[Row]:
    """Return what each recording comes to with constants chosen on all others, and how much each constant matters."""
    names = list(CANDIDATES)
    rows = []
    if len(trials) > 1:
        chosen = _chosen([trial.error_m + trial.faster_m for trial in trials])
        own = [MM * float(trial.error_m[best]) for trial, best in zip(trials, chosen, strict=True)]
        rows += kind_rows([trial.motion for trial in trials], own, [MM * trial.published_m for trial in trials])
        quick = [
            MM * float(trial.faster_m[k]) for trial, k in zip(trials, chosen, strict=True) if trial.kind != _KINDS[1]
        ]
        if quick:
            often = max(set(chosen), key=chosen.count)
            note = f"chosen in {chosen.count(often)} of {len(chosen)}: constants {names[often]}"
            name = f"walks played {times:g} times as fast"
            rows += [Row(f"{name}, mean", float(np.mean(quick)), "mm", note=note), Row("    worst", max(quick), "mm")]
    for k, name in enumerate(names):
        rows.append(_sensitivity(f"all trials, {name}", [MM * float(trial.error_m[k]) for trial in trials]))
    return rows


def _sensitivity(name: str, errors_mm: Sequence[float]) -> Row:
    return Row(name, float(np.mean(errors_mm)), "mm", note=f"{name}: worst {max(errors_mm):.0f} mm")


def _chosen(costs: Sequence[FloatArray]) -> list[int]:
    """Return, for each recording, the candidate of least cost over all others."""
    total = np.sum(costs, axis=0)
    return [int(np.argmin(total - cost)) for cost in costs]


_VERDICTS: Final = {False: MOVING, True: ZeroVelocity(still=True, speed_sigma=0.01, rate=None)}
_STRAIGHT_M: Final = 0.8
"""Distance from the start at which headings are made equal, as the published figures do."""


def reckon(
    samples: ImuSamples,
    detector: ZeroVelocitySettings | None = None,
    still: BoolArray | None = None,
) -> FloatArray:
    """Return the positions (N, 3), metres, z up, of a sensor that stands at the origin at first.

    It is the filter and the detector that run live, forwards and without any other measurement.

    Args:
        samples: of the whole recording.
        detector: its settings.
        still: (N,) verdict of another detector, to be used instead.
    """
    gravity = np.array([0.0, 0.0, -GRAVITY_M_S2])
    model = InertialModel(Strapdown(gravity, InertialNoise()), np.eye(3))
    zero_velocity = ZeroVelocityDetector(detector)
    state, refused_s = _at_rest(samples), 0.0
    positions = np.zeros((len(samples), 3))
    for k in range(1, len(samples)):
        h = float(samples.t_ns[k] - samples.t_ns[k - 1]) * 1e-9
        force, rate = samples.specific_force[k], samples.angular_rate[k]
        measured = zero_velocity.add(h, force, rate) if still is None else _VERDICTS[bool(still[k])]
        state = model.predict(state, h, InertialStep(h, samples.specific_force[k - 1], force, h * rate))
        state, refused_s = zero_velocity_update(model, state, measured, rate, h, refused_s, seen=False)
        positions[k] = state.position
    return positions


def faster(samples: ImuSamples, times: float) -> ImuSamples:
    """Return what a sensor would have measured had the foot gone the same way `times` as fast.

    Rotation rates are that much larger, accelerations by its square; gravity g is what it is. With the orientation R to
    a level world that came with the samples,

        ω' = s·ω        f' = s²·f − (s² − 1)·Rᵀ·g

    so that an error of R is an error of f', which is why this is no substitute for somebody who runs.
    """
    R = rotation_from_quaternion(samples.orientation_xyzw)
    force = times**2 * samples.specific_force - (times**2 - 1.0) * GRAVITY_M_S2 * R[:, 2, :]
    t_ns = samples.t_ns[0] + np.round((samples.t_ns - samples.t_ns[0]) / times).astype(np.int64)
    return replace(samples, t_ns=t_ns, specific_force=force, angular_rate=times * samples.angular_rate)


def _at_rest(samples: ImuSamples) -> InertialState:
    P = np.zeros((SIZE, SIZE))
    for part, sigma in (
        (POSITION, 1e-5),
        (VELOCITY, 1e-3),
        (ATTITUDE, math.radians(0.5)),
        (ACCELEROMETER, 0.1),
        (GYROSCOPE, math.radians(0.2)),
    ):
        P[part, part] = sigma**2 * np.eye(3)
    # The heading is not measured by anything: it is what it is.
    P[ATTITUDE.stop - 1, ATTITUDE.stop - 1] = 1e-8
    zero = np.zeros(3)
    # Samples at the start in which the foot stands, for the direction of up.
    R = level_rotation(samples.specific_force[:20].mean(axis=0))
    return InertialState(zero, zero, R, zero, zero, zero, np.eye(3), P)


def horizontal_error_m(positions: FloatArray, truth: FloatArray) -> float:
    """Return the error of a path (N, 3) as the data set's authors measure it ("ARMSE, 2D"), metres.

    Both paths begin at the origin and are rotated into one heading where the first is 0.8 m away; then the mean over
    time of √((Δx² + Δy²)/2).
    """
    path, true = positions - positions[0], truth - truth[0]
    away = np.hypot(path[:, 0], path[:, 1])
    at = int(np.argmax(away >= _STRAIGHT_M)) if away.max() >= _STRAIGHT_M else len(path) - 1
    heading = math.atan2(true[at, 1], true[at, 0]) - math.atan2(path[at, 1], path[at, 0])
    c, s = math.cos(heading), math.sin(heading)
    level = path[:, :2] @ np.array([[c, s], [-s, c]])
    return float(np.sqrt(((level - true[:, :2]) ** 2).mean(axis=1)).mean())
