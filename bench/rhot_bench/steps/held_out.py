"""Dead reckoning by kind of motion, and with the detector's constants chosen without the trial that is judged.

The detector has few constants and no trained part. Each is made smaller and larger; for every recording those constants
are chosen that do best on all others, at their own speed and played faster, and judged on the one (leave-one-out
cross-validation). How the mean changes with each constant is its sensitivity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_bench.steps.dead_reckoning import faster, horizontal_error_m, reckon
from rhot_bench.steps.walks import read_places
from rhot_feet.imu.zero_velocity_detector import ZeroVelocitySettings
from rhot_feet.sources.imu.recorded import read_samples
from rhot_tools.measures.rows import Row

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
