"""Recorded hands made whole and plausible: every file as 21 joints at 30 Hz, without the noise of its recorder.

Recorded joints are noisy by 1 to 3 mm from frame to frame, which would be accelerations of 10 m/s² and more that no
hand has. They are low-passed forth and back (no delay) by a Butterworth filter of second order at 6 Hz: voluntary
finger motion has 95 % of its power below 5 Hz, and 1 mm of white noise at 30 Hz leaves about 0.6 m/s².

NYU's file knows no knuckles and no outer hinges: the knuckles are those of a person fitted to it (`fit_open_hand`), the
outer hinge lies where the two outer bones meet on the back's side.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from scipy.signal import butter, sosfiltfilt

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot_bench.hands.recorded_hands import fit_person
from rhot_bench.hands.recorded_joints import RATE_HZ, Recorded, fit_open_hand, read_joints, whole_chains

CUTOFF_HZ: Final = 6.0
_FIT_FRAMES: Final = 120
_LEAST_S: Final = 0.7
"""The shortest recording of FPHA lasts 0.83 s; the low-pass needs half a second."""
_FREE_HANDED: Final = ("high_five", "flip_pages")
"""FPHA actions in which the hand closes round nothing."""


@dataclass(frozen=True, slots=True)
class RecordedHand:
    """One recording of a right hand.

    Attributes:
        name: of the file.
        source: `msra`, `nyu` or `fpha`.
        wrists: (F, 3) metres, low-passed.
        chains: (F, 5, 4, 3) metres, low-passed: knuckle, two hinges, the very tip.
        knuckles: (5, 3) metres, wrist frame, of this person.
        bones: (5, 3) metres, the last up to the very tip.
        grasps: whether an object is in the hand.
    """

    name: str
    source: str
    wrists: FloatArray
    chains: FloatArray
    knuckles: FloatArray
    bones: FloatArray
    grasps: bool

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return (len(self.wrists) - 1) / RATE_HZ


def list_recordings(data: Path) -> dict[str, tuple[Path, ...]]:
    """Return the files by source.

    Raises:
        ConfigError: the folder holds none.
    """
    folder = data / "hand_motion" if (data / "hand_motion").is_dir() else data
    found = {
        "msra": tuple(sorted(folder.glob("msra14_*.csv"))),
        "nyu": tuple(sorted(folder.glob("nyu_*.csv"))),
        "fpha": tuple(sorted((folder / "fpha").glob("S*_*.csv"))),
    }
    there = {source: files for source, files in found.items() if files}
    if not there:
        raise ConfigError(
            f"{data}: holds no recorded hands (msra14_*.csv, nyu_*.csv, fpha/S*_*.csv); name the folder that does"
        )
    return there


@lru_cache(maxsize=64)
def read_recording(path: Path, source: str) -> RecordedHand:
    """Return one recording, whole and low-passed.

    Args:
        path: the file.
        source: `msra`, `nyu` or `fpha`.

    Raises:
        ConfigError: it cannot be read or is shorter than `_LEAST_S`.
    """
    if source == "nyu":
        recorded = _nyu_made_whole(path)
    else:
        recorded = read_joints(path, ["W" if source == "fpha" else "wrist"], whole_chains())
    if len(recorded.wrists) < (least := round(_LEAST_S * RATE_HZ)):
        raise ConfigError(f"{path}: {len(recorded.wrists)} frames are too few; {_LEAST_S:g} s need {least}")
    low_pass = butter(2, CUTOFF_HZ, fs=RATE_HZ, output="sos")
    wrists = sosfiltfilt(low_pass, recorded.wrists, axis=0)
    chains = sosfiltfilt(low_pass, recorded.chains, axis=0)
    every = max(1, len(wrists) // _FIT_FRAMES)
    person = fit_person(wrists[::every], chains[::every], "right")
    grasps = source == "fpha" and not path.stem.endswith(_FREE_HANDED)
    return RecordedHand(path.stem, source, wrists, chains, person.knuckles, person.bones, grasps)


def _nyu_made_whole(path: Path) -> Recorded:
    """Return NYU's hands with knuckles and outer hinges."""
    names = [["", "T_mcp", "T_ip", "T_tip"], *(["", f"{finger}_pip", "", f"{finger}_tip"] for finger in "IMRP")]
    recorded = read_joints(path, ["W_thumb_side", "W_pinky_side"], names, "palm")
    every = max(1, len(recorded.wrists) // (4 * _FIT_FRAMES))
    person = fit_open_hand(recorded.part(slice(None, None, every)))
    Z = recorded.wrists - recorded.palms
    Z = Z / np.linalg.norm(Z, axis=1, keepdims=True)
    X = recorded.across - Z * (recorded.across * Z).sum(axis=1, keepdims=True)
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    back = np.cross(Z, X)
    R = np.stack([X, back, Z], axis=-1)
    chains = recorded.chains.copy()
    chains[:, :, 0] = recorded.wrists[:, None] + person.knuckles @ np.swapaxes(R, 1, 2)
    for finger in range(1, 5):
        middle, outer = person.bones[finger, 1:]
        knuckle, hinge, tip = chains[:, finger, 0], chains[:, finger, 1], chains[:, finger, 3]
        reach = np.linalg.norm(tip - hinge, axis=1, keepdims=True)
        along = (tip - hinge) / reach
        reach = np.clip(reach, abs(middle - outer) + 1e-4, middle + outer - 1e-4)
        ahead = (middle**2 - outer**2 + reach**2) / (2.0 * reach)
        first = (hinge - knuckle) / np.linalg.norm(hinge - knuckle, axis=1, keepdims=True)
        # Weight of the back's direction in where an outer hinge lies; it decides only when the finger is
        # straight.
        up = first + 0.3 * back
        up -= along * (up * along).sum(axis=1, keepdims=True)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        chains[:, finger, 2] = hinge + ahead * along + np.sqrt(np.maximum(middle**2 - ahead**2, 0.0)) * up
    return Recorded(recorded.wrists, chains, recorded.across, recorded.palms)
