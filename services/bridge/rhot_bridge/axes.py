"""From the rig's axes to other programs' axes.

**Rig to stage.** The rig frame is the reference camera's; the stage has a floor: right-handed, metres, +y up, −z
forward, origin on the floor (OpenXR's STAGE). `rhot/space/stage` gives T_rig_stage, hence, with (R, t) its inverse
and q_R the quaternion of R,

    p_stage = R · p_rig + t            q_stage = q_R ⊗ q_rig

**Stage to Unity.** Unity is left-handed: +x right, +y up, +z forward. With M = diag(1, 1, −1),

    p_unity = M · p_stage = (x, y, −z)
    R_unity = M · R_stage · M, so q_unity = (−x, −y, z, w)

A joint's own axes are mirrored as well: OpenXR's +Z from the tip to the wrist becomes +z from the wrist to the tip,
which is Unity's "forward along the finger"; +Y still points out of the back of the hand. OpenVR's axes (SteamVR) are
the stage's.

**Euler angles** of VRChat: degrees, in Unity's axes, applied about z, then x, then y, each about the fixed axes:
R = Ry(y) · Rx(x) · Rz(z), Unity's own order. With left-handed axes a positive angle turns clockwise seen along the
axis, and the matrices are the usual ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, TypeVar, cast

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import inverse, product_matrix, quaternion_from_rotation
from rhot_bridge.scene import Axes, Poses, Scene

_UNITY_POSITION: Final = np.array([1.0, 1.0, -1.0])
_UNITY_ORIENTATION: Final = np.array([-1.0, -1.0, 1.0, 1.0])
_MOST_KNOWN: Final = 64
"""Size of the cache of converted poses, which bridges with the same axes share."""

P = TypeVar("P", bound=Poses)
K = TypeVar("K", bound=str)


class Converter:
    """Converts poses from the rig's axes to those of a target.

    Attributes:
        axes: the target's axes.
    """

    def __init__(self, axes: Axes, T_rig_stage: FloatArray | None = None) -> None:
        """Precompute the conversion.

        Args:
            axes: the target's axes.
            T_rig_stage: (4, 4) metres; required for all axes except the rig's.

        Raises:
            ValueError: T_rig_stage is required and not given.
        """
        self.axes: Axes = axes
        if axes == "rig":
            T_stage_rig = np.eye(4)
        elif T_rig_stage is None:
            raise ValueError(f"{axes} axes need T_rig_stage")
        else:
            T_stage_rig = inverse(T_rig_stage)
        rotation = product_matrix(*quaternion_from_rotation(T_stage_rig[:3, :3]).tolist())
        mirror, mirror_q = (_UNITY_POSITION, _UNITY_ORIENTATION) if axes == "unity" else (1.0, 1.0)
        self._rotate = (T_stage_rig[:3, :3].T * mirror).copy()
        self._shift = T_stage_rig[:3, 3] * mirror
        self._multiply = (rotation.T * mirror_q).copy()
        self._known: dict[int, tuple[Poses, Poses]] = {}

    def poses(self, poses: P) -> P:
        """Return poses converted from the rig's to the target's axes; results are cached by identity."""
        found = self._known.get(id(poses))
        if found is not None and found[0] is poses:
            return cast(P, found[1])
        if len(self._known) >= _MOST_KNOWN:
            self._known.clear()
        moved = poses.moved(poses.positions @ self._rotate + self._shift, poses.orientations @ self._multiply)
        self._known[id(poses)] = poses, moved
        return moved

    def scene(self, scene: Scene) -> Scene:
        """Return a scene converted from the rig's to the target's axes."""
        return Scene(
            self.axes,
            scene.t_ns,
            self._all(scene.hands),
            self._all(scene.objects),
            None if scene.head is None else self.poses(scene.head),
            self._all(scene.feet),
            None if scene.body is None else self.poses(scene.body),
        )

    def _all(self, group: Mapping[K, P]) -> dict[K, P]:
        return {name: self.poses(poses) for name, poses in group.items()}


def unity_euler_deg(xyzw: FloatArray) -> tuple[float, float, float]:
    """Return Unity's Euler angles x, y, z, degrees, of a unit quaternion (4,), x y z w, in Unity's axes.

    At x = ±90° (gimbal lock), where only the sum or difference of y and z is determined, z is 0.
    """
    x, y, z, w = xyzw.tolist()
    # Elements of R: R12 = −sin x, R02 : R22 = tan y, R10 : R11 = tan z.
    sine_x = min(max(-2.0 * (y * z - w * x), -1.0), 1.0)
    gimbal_lock = 1.0 - 1e-9
    if abs(sine_x) > gimbal_lock:
        about_y, about_z = math.atan2(-2.0 * (x * z - w * y), 1.0 - 2.0 * (y * y + z * z)), 0.0
    else:
        about_y = math.atan2(2.0 * (x * z + w * y), 1.0 - 2.0 * (x * x + y * y))
        about_z = math.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z))
    return math.degrees(math.asin(sine_x)), math.degrees(about_y), math.degrees(about_z)
