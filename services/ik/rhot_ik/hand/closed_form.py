"""Fingers in closed form: from marker centres in the wrist frame to joint angles.

A finger whose only measurement is its marker has three free angles once its last hinge follows the middle one
(DIP = coupling · PIP). The finger bends in a plane that holds its abduction axis y: that plane through the marker
gives abduction; in it, the distance from knuckle to marker falls steadily as the finger curls, which fixes PIP by a
one-dimensional root (tabulated once per hand); what is left to the marker's direction is flexion. Where flexion would
leave its range it stays at the limit and the curl that comes nearest to the marker is taken.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import HandModel
from rhot.anatomy.markers import PaintedMarker
from rhot.anatomy.skeleton import CHAINS, FINGERS, JOINTS
from rhot.arrays import FloatArray

# Hand geometry for the finger solvers: where each finger is attached, and where its marker is painted.


@dataclass(frozen=True, slots=True)
class FingerGeometry:
    """The five fingers as chains that end in their markers.

    Attributes:
        model: the hand.
        ends: (5, 3) metres: from the last hinge to the painted centre, in the frame of the last bone. Fingers that
            wear no marker end in their tip.
        markers: finger to the name of its marker.
    """

    model: HandModel
    ends: FloatArray
    markers: Mapping[str, str]

    @classmethod
    def of(cls, model: HandModel, markers: Mapping[str, PaintedMarker]) -> FingerGeometry:
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
        return cls(model, ends, bound)

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


def base_marker(model: HandModel, markers: Mapping[str, PaintedMarker]) -> str | None:
    """Return the name of the marker on the back of the hand: the one on the wrist or else on the palm joint."""
    for joint in ("wrist", "palm"):
        for name, marker in markers.items():
            if marker.hand == model.side and marker.joint == joint:
                return name
    return None


def marker_on_palm(model: HandModel, name: str, marker: PaintedMarker) -> FloatArray:
    """Return where the base marker's centre lies in the wrist frame, (3,), metres."""
    offset = model.marker_offset(name, marker)
    return offset + model.palm if JOINTS.index(marker.joint) == JOINTS.index("palm") else offset


_TABLE: Final = 512
_CURVE: Final = 128
"""Entries of the table from shortening to curl, and points of the curve that a curling finger describes; chosen."""
_LATERAL_DAMPING_M: Final = 0.003
"""Abduction fades when the marker comes this near to the abduction axis, where it is not determined any more."""


@dataclass(frozen=True, slots=True)
class FingerPose:
    """Angles that bring the markers as near to their targets as the limits allow.

    Attributes:
        angles: (..., 5, 4) radians, inside the limits.
        miss: (..., 5, 3) metres: modelled minus wanted marker, in the plane of the finger: across, up, along.
    """

    angles: FloatArray
    miss: FloatArray


class AnalyticFingers:
    """The closed-form solver of one hand; stateless after construction."""

    def __init__(self, geometry: FingerGeometry) -> None:
        model = geometry.model
        self._geometry = geometry
        self._end = geometry.mirrored_ends
        self._first, self._second = model.bones[:, 0], model.bones[:, 1]
        self._coupling = model.coupling
        self._low, self._high = model.angle_min, model.angle_max
        self._curl = np.linspace(self._low[:, 2], self._high[:, 2], _CURVE, axis=-1)
        y, z = self._curled(self._curl.T)
        self._curve = np.stack([y.T, z.T], axis=-1)
        squared = np.minimum.accumulate((self._curve**2).sum(-1), axis=1)
        # A straight finger is longest, with zero slope: √(longest² − d²) is nearly linear in the curl, d² is not.
        self._longest = squared[:, :1]
        shortening = np.sqrt(np.maximum(self._longest - squared, 0.0))
        self._step = np.maximum(shortening[:, -1], 1e-9) / (_TABLE - 1)
        self._inverse = np.stack(
            [
                np.interp(np.arange(_TABLE) * step, row, curl)
                for step, row, curl in zip(self._step, shortening, self._curl, strict=True)
            ]
        )
        self._rows = np.arange(len(self._step))

    def solve(self, targets: FloatArray) -> FingerPose:
        """Return the pose for marker centres (..., 5, 3), metres, wrist frame; they must be finite."""
        local = self._geometry.in_finger_frames(targets)
        x, y, z = local[..., 0], local[..., 1], local[..., 2]
        across = x - self._end[:, 0]
        damping = _LATERAL_DAMPING_M**2
        low, high = self._low[:, 1], self._high[:, 1]
        abduction = np.minimum(np.maximum(np.arctan(across * z / (z * z + damping)), low), high)
        for _ in range(2):
            cos, sin = np.cos(abduction), np.sin(abduction)
            off, along = cos * x - sin * z - self._end[:, 0], sin * x + cos * z
            abduction = np.minimum(np.maximum(abduction + off * along / (along * along + damping), low), high)
        cos, sin = np.cos(abduction), np.sin(abduction)
        off, along = cos * x - sin * z - self._end[:, 0], sin * x + cos * z

        curl = self._curl_at(y * y + along * along)
        curled_y, curled_z = self._curled(curl)
        flexion = np.arctan2(-y, -along) - np.arctan2(-curled_y, -curled_z)
        middle = 0.5 * (self._low[:, 0] + self._high[:, 0])
        flexion = middle + (flexion - middle + np.pi) % (2.0 * np.pi) - np.pi
        clamped = np.minimum(np.maximum(flexion, self._low[:, 0]), self._high[:, 0])
        at_limit = clamped != flexion
        if at_limit.any():
            clamped, curl = self._at_limits(at_limit, clamped, curl, y, along)
            curled_y, curled_z = self._curled(curl)
        cos, sin = np.cos(clamped), np.sin(clamped)
        angles = np.stack([clamped, abduction, curl, self._last_hinge(curl)], axis=-1)
        miss = np.stack([-off, cos * curled_y + sin * curled_z - y, -sin * curled_y + cos * curled_z - along], axis=-1)
        return FingerPose(angles, miss)

    def _last_hinge(self, curl: FloatArray) -> FloatArray:
        return np.minimum(np.maximum(self._coupling * curl, self._low[:, 3]), self._high[:, 3])

    def _curled(self, curl: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return y and z (..., 5), metres, of the marker with unbent knuckle and middle hinge `curl` (..., 5)."""
        total = curl + self._last_hinge(curl)
        cos, sin = np.cos(total), np.sin(total)
        end_y, end_z = self._end[:, 1], self._end[:, 2]
        y = -self._second * np.sin(curl) + cos * end_y + sin * end_z
        z = -self._first - self._second * np.cos(curl) - sin * end_y + cos * end_z
        return y, z

    def _curl_at(self, squared_distance: FloatArray) -> FloatArray:
        """Return the curl (..., 5) at which the marker has this squared distance from the knuckle."""
        shortening = np.sqrt(np.maximum(self._longest[:, 0] - squared_distance, 0.0))
        place = np.minimum(shortening / self._step, _TABLE - 1.001)
        index = place.astype(np.intp)
        below = self._inverse[self._rows, index]
        curl: FloatArray = below + (place - index) * (self._inverse[self._rows, index + 1] - below)
        return curl

    def _at_limits(
        self, at_limit: NDArray[np.bool_], flexion: FloatArray, curl: FloatArray, y: FloatArray, along: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return flexion and curl (..., 5) with the fingers that are `at_limit` at the better end of their range."""
        least: FloatArray = np.full(flexion.shape, np.inf)
        flexion, curl = flexion.copy(), curl.copy()
        for limit in (self._low[:, 0], self._high[:, 0]):
            # The wanted point as the curling curve of a finger with unbent knuckle sees it.
            cos, sin = np.cos(limit), np.sin(limit)
            nearest, gap = self._nearest_curl(cos * y - sin * along, sin * y + cos * along)
            better = at_limit & (gap < least)
            flexion = np.where(better, limit, flexion)
            curl = np.where(better, nearest, curl)
            least = np.where(better, gap, least)
        return flexion, curl

    def _nearest_curl(self, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the curl (..., 5) nearest to a point of the plane of an unbent knuckle, and about the gap squared."""
        gap = (self._curve[..., 0] - y[..., None]) ** 2 + (self._curve[..., 1] - z[..., None]) ** 2
        index = np.clip(np.argmin(gap, axis=-1), 1, _CURVE - 2)[..., None]
        before, at, after = (np.take_along_axis(gap, index + shift, axis=-1)[..., 0] for shift in (-1, 0, 1))
        # Vertex of the parabola through the three squared distances around the least one.
        bend = before - 2.0 * at + after
        shift = np.clip(np.where(bend > 1e-15, 0.5 * (before - after) / np.maximum(bend, 1e-15), 0.0), -1.0, 1.0)
        step = self._curl[:, 1] - self._curl[:, 0]
        nearest: FloatArray = self._curl[:, 0] + (index[..., 0] + shift) * step
        return nearest, at
