"""How long a person really is from the neck to the ankles: learned from standing.

Lengths that follow from the height are off by centimetres for most people, and so is a marker on its instep; near the
straight leg one centimetre bends a knee by more than 10°. Who stands with both feet side by side has straight legs.
What is left over between hips and ankles then, or missing, goes half to the legs and half to the trunk, which vary
about equally, as far as both legs agree, and to the height of each ankle as far as they do not. It is learned quickly
in the first seconds, slowly later, and upwards faster than downwards, since a person may stand with bent knees, but no
leg is longer than it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot_ik.legs.hips import hip_joint
from rhot_ik.legs.leg import Ankle

_STANDING: Final = 0.999
"""Hip to ankle of a standing leg over its length: 5° of flexion."""
_STANDS: Final = 0.05
"""A leg that is shorter than straight by this share is bent, not measured wrongly."""
_MOST: Final = 0.05
"""Of what is learned, as a share of legs and trunk."""
_FIRST_S: Final = 0.5
"""Half of what is off is learned in the first half second of standing. Chosen: people are asked to stand for two
or three (`docs/feet.md`)."""
_SLOWEST_S: Final = 30.0
"""From so much standing on, what is new is averaged over this time; chosen."""
_UPWARDS: Final = 3.0
"""How much faster lengths grow than shrink; chosen."""
_LEGS_SHARE: Final = 0.5
"""Of what is learned, the part that the legs get where nobody measured them."""
_MOST_ANKLE_M: Final = 0.015
"""Bound of what is learned of an ankle's height; chosen."""


class Stature:
    """Learns the lengths of one person.

    Attributes:
        body: lengths as far as they are known.
        ankles_m: side to how much higher the ankle is than the foot's configuration says.

    Args:
        body: by the configuration.
        legs_known: the legs were measured: only the trunk is learned.
    """

    def __init__(self, body: BodyModel, *, legs_known: bool) -> None:
        self._configured = body
        self._legs_share = 0.0 if legs_known else _LEGS_SHARE
        self._longer_m = 0.0
        self._stood_s = 0.0
        self.body = body
        self.ankles_m: dict[Side, float] = {"left": 0.0, "right": 0.0}

    def update(self, T_rig_hips: FloatArray, ankles: Mapping[Side, Ankle], elapsed_s: float) -> None:
        """Update with a moment of standing still, feet side by side.

        Args:
            T_rig_hips: (4, 4) as they hang from the head.
            ankles: one foot or both.
            elapsed_s: since the moment before.
        """
        leg_m = self.body.leg_m
        R, position = T_rig_hips[:3, :3], T_rig_hips[:3, 3]
        off_m = {
            side: float(np.linalg.norm(position + R @ hip_joint(side, self.body) - ankle.position)) - _STANDING * leg_m
            for side, ankle in ankles.items()
        }
        if max(abs(off) for off in off_m.values()) > _STANDS * leg_m:
            return
        share = elapsed_s / (_FIRST_S + self._stood_s)
        self._stood_s = min(self._stood_s + elapsed_s, _SLOWEST_S)
        both_m = sum(off_m.values()) / len(off_m)
        for side, off in off_m.items():
            ankle_m = self.ankles_m[side] + share * (off - both_m)
            self.ankles_m[side] = float(np.clip(ankle_m, -_MOST_ANKLE_M, _MOST_ANKLE_M))
        most_m = _MOST * (self._configured.leg_m + self._configured.neck_height_m)
        share *= _UPWARDS if both_m > 0.0 else 1.0
        self._longer_m = float(np.clip(self._longer_m + min(share, 1.0) * both_m, -most_m, most_m))
        legs_m = self._legs_share * self._longer_m
        self.body = self._configured.lengthened(legs_m, self._longer_m - legs_m)
