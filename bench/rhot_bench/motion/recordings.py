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
from scipy.interpolate import make_interp_spline
from scipy.signal import butter, sosfiltfilt

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import CHAINS, FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.rig import HandFile
from rhot_bench.hands.recorded_hands import fit_person
from rhot_bench.hands.recorded_joints import RATE_HZ, Recorded, fit_open_hand, read_joints, whole_chains

# A recorded hand at any instant: rigid palm, bones of constant length, their directions as recorded.
#
# The low-passed joints are joined by quintic splines, so that velocity and acceleration are smooth between the
# recorder's frames; at an instant, the palm is the rigid one nearest to wrist and long knuckles, and each finger is its
# bones set end to end in the recorded directions. All of it is placed before the cameras by one fixed transform.

_MARGIN: Final = 8
"""Recorded frames beyond a clip's ends that its spline runs through."""


@dataclass(frozen=True, slots=True)
class HandShape:
    """N hands.

    Attributes:
        wrist: (N, 3) metres, rig frame.
        R: (N, 3, 3) axes of the wrist frame (see `rhot.anatomy.hand`) as columns.
        chain: (N, 5, 4, 3) metres: knuckle, two hinges, the very tip.
        joints: (N, 26, 3) metres, in the order of `rhot.anatomy.skeleton`; a tip joint lies one radius behind the very
            tip, as OpenXR has it.
    """

    wrist: FloatArray
    R: FloatArray
    chain: FloatArray
    joints: FloatArray


class HandMotion:
    """One clip of a recording, placed in the rig frame."""

    def __init__(
        self, hand: RecordedHand, start_s: float, seconds: float, scale: float, tip_radius_m: FloatArray
    ) -> None:
        """Prepare a clip; it lies as recorded until `place` is called.

        Args:
            hand: the recording.
            start_s: of the clip in the recording.
            seconds: its length.
            scale: of the hand and its paths.
            tip_radius_m: (5,) of the fingertips.
        """
        first = max(0, int(start_s * RATE_HZ) - _MARGIN)
        last = min(len(hand.wrists), int((start_s + seconds) * RATE_HZ) + _MARGIN + 2)
        self.seconds = seconds
        self.knuckles, self.bones = scale * hand.knuckles, scale * hand.bones
        self.tip_radius_m = np.minimum(tip_radius_m, 0.45 * self.bones[:, 2])
        joints = scale * np.concatenate([hand.wrists[:, None], hand.chains.reshape(-1, 20, 3)], axis=1)[first:last]
        t_s = np.arange(first, last) / RATE_HZ - start_s
        self._spline = make_interp_spline(t_s, joints.reshape(len(joints), -1), k=5)
        reach = float(np.linalg.norm(self.knuckles[2]) + self.bones[2].sum())
        self.length_m = reach
        average = HandModel.from_file(HandFile(length_m=float(np.clip(reach, 0.11, 0.25))), "right")
        self._metacarpals = average.metacarpals
        self._palm = 0.5 * (average.metacarpals[2] + self.knuckles[2])
        self._turn, self._shift = np.eye(3), np.zeros(3)

    def place(self, R: FloatArray, shift_m: FloatArray) -> None:
        """Let x in the recording be R·x + shift in the rig frame."""
        self._turn, self._shift = R, shift_m

    def recorded_at(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return wrists (N, 3) and chains (N, 5, 4, 3) as recorded, placed; bones are not yet constant."""
        joints = np.asarray(self._spline(t_s)).reshape(len(t_s), 21, 3) @ self._turn.T + self._shift
        return joints[:, 0], joints[:, 1:].reshape(-1, 5, 4, 3)

    def at(self, t_s: FloatArray) -> HandShape:
        """Return the hand at times (N,), seconds since the clip's start."""
        wrist, recorded = self.recorded_at(np.asarray(t_s, dtype=np.float64))
        rest = np.concatenate([np.zeros((1, 3)), self.knuckles[1:]])
        seen = np.concatenate([wrist[:, None], recorded[:, 1:, 0]], axis=1)
        middle = seen.mean(axis=1)
        R = _nearest_rotations(np.swapaxes(seen - middle[:, None], 1, 2) @ (rest - rest.mean(axis=0)))
        wrist = middle - R @ rest.mean(axis=0)
        knuckle = wrist[:, None] + self.knuckles @ np.swapaxes(R, 1, 2)
        steps = np.diff(recorded, axis=2)
        steps *= (self.bones / np.linalg.norm(steps, axis=-1))[..., None]
        chain = np.concatenate([knuckle[:, :, None], knuckle[:, :, None] + np.cumsum(steps, axis=2)], axis=2)
        return HandShape(wrist, R, chain, self._joints(wrist, R, chain))

    def _joints(self, wrist: FloatArray, R: FloatArray, chain: FloatArray) -> FloatArray:
        joints = np.empty((len(wrist), len(JOINTS), 3))
        joints[:, JOINTS.index("wrist")] = wrist
        joints[:, JOINTS.index("palm")] = wrist + R @ self._palm
        distal = chain[:, :, 3] - chain[:, :, 2]
        distal /= np.linalg.norm(distal, axis=-1, keepdims=True)
        tips = chain[:, :, 3] - self.tip_radius_m[:, None] * distal
        for number, finger in enumerate(FINGERS):
            place = [JOINTS.index(joint) for joint in CHAINS[finger]]
            if finger != "thumb":
                joints[:, place[0]] = wrist + R @ self._metacarpals[number]
            joints[:, place[-4:-1]] = chain[:, number, :3]
            joints[:, place[-1]] = tips[:, number]
        return joints


def _nearest_rotations(M: FloatArray) -> FloatArray:
    """Return rotations (N, 3, 3) nearest to M (N, 3, 3); see `rhot.geometry.rotations.nearest_rotation`."""
    U, _, Vt = np.linalg.svd(M)
    U[:, :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    rotations: FloatArray = U @ Vt
    return rotations


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
