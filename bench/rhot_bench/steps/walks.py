"""Recordings of a sensor on a foot with motion capture beside it (PyShoe's data): swings that nobody sees.

The truth is shown to the foot filter only while the foot stands, as a camera would show a marker that the knee hides in
every swing. The captured point is not quite the sensor, and a foot that is seen standing alone does not tell the lever
between them; so what counts is the end of each swing, where the foot is level again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot_bench.feet.heads import START_NS
from rhot_bench.processes import read_columns
from rhot_feet.filter.foot_filter import FootFilter
from rhot_feet.filter.model import FootFilterSettings
from rhot_feet.imu.samples import ImuSamples, RawImuConverter

SIGMA_M: Final = 0.003
"""Noise of the positions that are shown, per axis."""
PICTURE_S: Final = 1.0 / 60.0
_ALIGNED_FOR_S: Final = 0.2
"""Swings count from so long after the sensor is aligned: the one in which it becomes so was hardly followed."""
_COLUMNS: Final = ("t", "ax", "ay", "az", "gx", "gy", "gz", "px", "py", "pz", "zv")


@dataclass(frozen=True, slots=True)
class StepTrial:
    """One recording; N samples.

    Attributes:
        samples: of the sensor, as the service reads them.
        t_s: (N,) since its start.
        position: (N, 3) metres, z up: the captured point.
        stands: (N,) whether the foot does.
    """

    samples: ImuSamples
    t_s: FloatArray
    position: FloatArray
    stands: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class HiddenSwings:
    """How far the filter was off as the foot came down.

    Attributes:
        aligned_s: when the sensor was aligned; infinite = never.
        ends_m: (K,) distance from the truth at the end of each swing after that, metres.
    """

    aligned_s: float
    ends_m: FloatArray


def read_step_trial(file: Path, longest_s: float = np.inf) -> StepTrial:
    """Read a recording: columns t, ax ay az (m/s²), gx gy gz (rad/s), px py pz (m), zv (1 = stands).

    Args:
        file: the table.
        longest_s: leave out what comes after so long.

    Raises:
        ConfigError: unreadable, or a column is missing; names the file.
    """
    table = read_columns(file, _COLUMNS)
    table = {name: column[table["t"] < longest_s] for name, column in table.items()}
    t_s = table["t"]
    if not len(t_s) or (np.diff(t_s) <= 0.0).any():
        raise ConfigError(f"{file}: holds no rows, or their times do not rise")
    t_ns = START_NS + np.round(1e9 * t_s).astype(np.int64)
    force, rate, position = (_vectors(table, kind) for kind in "agp")
    return StepTrial(RawImuConverter().convert(t_ns, force, rate), t_s, position, table["zv"] > 0.5)


def read_places(file: Path) -> FloatArray:
    """Return the captured positions (N, 3), metres, z up, of a recording: columns px, py, pz.

    Raises:
        ConfigError: unreadable, or a column is missing; names the file.
    """
    return _vectors(read_columns(file, ("px", "py", "pz")), "p")


def _vectors(table: dict[str, FloatArray], kind: str) -> FloatArray:
    return np.stack([table[f"{kind}{axis}"] for axis in "xyz"], axis=1)


def hide_swings(trial: StepTrial) -> HiddenSwings:
    """Follow a foot that is seen only while it stands, with noise."""
    foot, random = FootFilter(FootFilterSettings(up=(0.0, 0.0, 1.0))), np.random.default_rng(1)
    shown_s, stood_s, aligned_s, ends_m = -1.0, 0.0, np.inf, []
    for k, t_s in enumerate(trial.t_s.tolist()):
        t_ns = int(trial.samples.t_ns[k])
        foot.add_imu_samples(trial.samples.rows(k, k + 1))
        # What is shorter is no swing: a foot that rolls, or the label of the motion capture that wavers.
        lands = trial.stands[k] and t_s - stood_s >= 0.2
        stood_s = t_s if trial.stands[k] else stood_s
        if lands and t_s > aligned_s + _ALIGNED_FOR_S:
            state = foot.state(t_ns)
            position = np.full(3, np.nan) if state is None else state.position
            ends_m.append(float(np.linalg.norm(position - trial.position[k])))
        if trial.stands[k] and t_s - shown_s >= PICTURE_S:
            shown_s = t_s
            foot.update_marker(t_ns, trial.position[k] + random.normal(0.0, SIGMA_M, 3), SIGMA_M**2 * np.eye(3))
        if foot.aligned:
            aligned_s = min(aligned_s, t_s)
    return HiddenSwings(aligned_s, np.array(ends_m))
