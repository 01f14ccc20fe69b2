"""A recorded hand at any instant: rigid palm, bones of constant length, their directions as recorded.

The low-passed joints are joined by quintic splines, so that velocity and acceleration are smooth between the
recorder's frames; at an instant, the palm is the rigid one nearest to wrist and long knuckles, and each finger is its
bones set end to end in the recorded directions. All of it is placed before the cameras by one fixed transform.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import make_interp_spline

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import CHAINS, FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.rig import HandFile
from rhot_bench.hands.recorded_joints import RATE_HZ
from rhot_bench.motion.recordings import RecordedHand

_MARGIN: Final = 8
"""Recorded frames beyond a clip's ends that its spline runs through."""


@dataclass(frozen=True, slots=True)
class HandShape:
    """N hands.

    Attributes:
        wrist: (N, 3) metres, rig frame.
        R: (N, 3, 3) axes of the wrist frame (see `rhot.hand`) as columns.
        chain: (N, 5, 4, 3) metres: knuckle, two hinges, the very tip.
        joints: (N, 26, 3) metres, in the order of `rhot.skeleton.JOINTS`; a tip joint lies one radius behind the very
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
    """Return rotations (N, 3, 3) nearest to M (N, 3, 3); see `rhot.rotations.nearest_rotation`."""
    U, _, Vt = np.linalg.svd(M)
    U[:, :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    rotations: FloatArray = U @ Vt
    return rotations
