"""The five fingers as one batch of FABRIK chains."""

from __future__ import annotations

import numpy as np

from rhot.arrays import FloatArray
from rhot_bench.thesis.fabrik.chains import ABDUCTION, FLEXION, Chains
from rhot_bench.thesis.fabrik.fabrik import ChainPose, solve
from rhot_ik.hand.fingers.geometry import FingerGeometry


def finger_chains(geometry: FingerGeometry) -> Chains:
    """Return the chains of a hand in the frames of `FingerGeometry.in_finger_frames`: knuckle, hinge, hinge.

    The knuckle's limits are the rectangle that the hand model states; the last hinge follows the middle one.
    """
    model = geometry.model
    fingers = len(model.bones)
    bones = np.zeros((fingers, 3, 3))
    bones[:, :2, 2] = -model.bones[:, :2]
    bones[:, 2] = geometry.mirrored_ends
    lowest, highest = np.zeros((fingers, 3, 3)), np.zeros((fingers, 3, 3))
    for limits, given in ((lowest, model.angle_min), (highest, model.angle_max)):
        limits[:, :, FLEXION] = given[:, (0, 2, 3)]
        limits[:, 0, ABDUCTION] = given[:, 1]
    coupling = np.full((fingers, 3), np.nan)
    coupling[:, 2] = model.coupling
    rest = np.broadcast_to(np.eye(3), (fingers, 3, 3, 3))
    return Chains(rest, bones, lowest, highest, coupling)


class FabrikFingers:
    """FABRIK on the fingers of one hand; stateless, the start is handed in."""

    def __init__(self, geometry: FingerGeometry) -> None:
        self._geometry = geometry
        self._chains = finger_chains(geometry)

    def solve(
        self, targets: FloatArray, start: FloatArray, tolerance_m: float, max_iterations: int
    ) -> tuple[FloatArray, ChainPose]:
        """Return angles (5, 4), radians, for marker centres (5, 3), metres, wrist frame, and the chains' own result.

        Args:
            targets: a row that is not finite keeps its start.
            start: (5, 4) radians, the last angles.
            tolerance_m: as in `fabrik.solve`.
            max_iterations: as in `fabrik.solve`.
        """
        warm = np.zeros((len(start), 3, 3))
        warm[:, :, FLEXION] = start[:, (0, 2, 3)]
        warm[:, 0, ABDUCTION] = start[:, 1]
        pose = solve(self._chains, self._geometry.in_finger_frames(targets), warm, tolerance_m, max_iterations)
        flexion = pose.angles[:, :, FLEXION]
        angles = np.column_stack([flexion[:, 0], pose.angles[:, 0, ABDUCTION], flexion[:, 1], flexion[:, 2]])
        return angles, pose
