"""Hand geometry for the finger solvers: where each finger is attached, and where its marker is painted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import CHAINS, FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.rig import MarkerConfig


@dataclass(frozen=True, slots=True)
class FingerGeometry:
    """The five fingers as chains that end in their markers.

    Attributes:
        model: the hand.
        ends: (5, 3) metres: from the last hinge to the painted centre, in the frame of the last bone. Fingers that
            wear no marker end in their tip.
        markers: finger to the name of its marker.
        reaches: (5,) metres: no marker is further from its knuckle.
    """

    model: HandModel
    ends: FloatArray
    markers: Mapping[str, str]
    reaches: FloatArray

    @classmethod
    def of(cls, model: HandModel, markers: Mapping[str, MarkerConfig]) -> FingerGeometry:
        """Bind the markers of a hand to its fingers; a marker on the tip wins over one on the last hinge."""
        ends = np.zeros((len(FINGERS), 3))
        bound: dict[str, str] = {}
        for place, finger in enumerate(FINGERS):
            tip, hinge = CHAINS[finger][-1], CHAINS[finger][-2]
            length = float(model.bones[place, 2])
            ends[place] = (0.0, 0.0, -length)
            for joint, start in ((hinge, 0.0), (tip, -length)):
                for name, marker in markers.items():
                    if marker.hand == model.side and marker.joint == joint:
                        ends[place] = model.marker_offset(name, marker) + np.array([0.0, 0.0, start])
                        bound[finger] = name
        ends.setflags(write=False)
        reaches = model.bones[:, :2].sum(axis=1) + np.sqrt((ends * ends).sum(axis=1))
        reaches.setflags(write=False)
        return cls(model, ends, bound, reaches)

    def in_finger_frames(self, targets: FloatArray) -> FloatArray:
        """Return points (..., 5, 3) of the wrist frame in the rest frames of their fingers, metres.

        A left finger is mirrored at x = 0, so that positive abduction is a positive turn about y for either hand.
        """
        local: FloatArray = ((targets - self.model.knuckles)[..., None, :] @ self.model.frames)[..., 0, :]
        local[..., 0] *= self.model.handedness
        return local

    @property
    def mirrored_ends(self) -> FloatArray:
        """(5, 3) `ends` in the mirrored frames of `in_finger_frames`."""
        mirrored: FloatArray = self.ends * np.array([self.model.handedness, 1.0, 1.0])
        return mirrored

    def marker_points(self, angles: FloatArray) -> FloatArray:
        """Return the modelled marker centres (..., 5, 3), metres, wrist frame, of angles (..., 5, 4)."""
        chain, axes = self.model.finger_chains(angles)
        ends = (axes[..., 2, :, :] @ self.ends[:, :, None])[..., 0]
        points: FloatArray = chain[..., 2, :] + ends
        return points


def base_marker(model: HandModel, markers: Mapping[str, MarkerConfig]) -> str | None:
    """Return the name of the marker on the back of the hand: the one on the wrist or else on the palm joint."""
    for joint in ("wrist", "palm"):
        for name, marker in markers.items():
            if marker.hand == model.side and marker.joint == joint:
                return name
    return None


def marker_on_palm(model: HandModel, name: str, marker: MarkerConfig) -> FloatArray:
    """Return where the base marker's centre lies in the wrist frame, (3,), metres."""
    offset = model.marker_offset(name, marker)
    return offset + model.palm if JOINTS.index(marker.joint) == JOINTS.index("palm") else offset
