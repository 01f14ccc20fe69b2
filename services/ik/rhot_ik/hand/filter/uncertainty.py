"""How sure each joint's position is, from the covariance of the hand's state.

The position of a joint in the rig frame is x = p + R·j(q, l), with the wrist's pose (R, p), the angles q and the
fingers' lengths l. In the wrist's axes its error is δx = −[j]ₓ·δθ + Rᵀδp + ∂j/∂q·δq + ∂j/∂l·δl, and its standard
deviation the root of the trace of J·P·Jᵀ.
"""

from __future__ import annotations

import numpy as np

from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot_ik.hand.filter.kinematics import HandKinematics
from rhot_ik.hand.filter.process import ANGLES, LONGER, POSITION, ROTATION, SIZE, HandState


def joint_variances(kinematics: HandKinematics, state: HandState, positions: FloatArray) -> FloatArray:
    """Return the variance of each joint's position (26,), square metres: the sum over the three axes.

    Args:
        kinematics: of the hand.
        state: of the hand.
        positions: (26, 3) metres, rig frame, of the joints.
    """
    local = (positions - state.p) @ state.R
    J = np.zeros((len(JOINTS), 3, SIZE))
    x, y, z = local.T
    J[:, 0, ROTATION] = np.stack([np.zeros_like(x), z, -y], axis=1)
    J[:, 1, ROTATION] = np.stack([-z, np.zeros_like(x), x], axis=1)
    J[:, 2, ROTATION] = np.stack([y, -x, np.zeros_like(x)], axis=1)
    J[:, :, POSITION] = state.R.T
    by_finger = kinematics.joint_derivatives(state.angles, state.longer)
    J[:, :, ANGLES], J[:, :, LONGER] = by_finger[..., :20], by_finger[..., 20:]
    rows = J.reshape(-1, SIZE)
    variances: FloatArray = np.einsum("ij,ij->i", rows @ state.P, rows).reshape(len(JOINTS), 3).sum(axis=1)
    return np.maximum(variances, 0.0)
