"""The world as convex parts between round outlines: what a camera has to draw, and in which order.

Every part is the convex hull of rings: a ball's silhouette, a disc's rim or a patch's edge. A finger bone is the hull
of two balls (a tapered capsule); a fingertip is cut in two by the plane where the paint ends. Of two convex bodies on
both sides of a plane the one on the camera's side hides the other, so a fingertip's painted and bare halves are drawn
in that order, exactly; everything else is drawn by distance. The hidden half reaches under the seam: no desk shines in.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Final

import numpy as np

from rhot.anatomy.hand import METACARPALS, MOVING, WRIST, HandJoints, HandModel
from rhot.anatomy.skeleton import CHAINS, FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot.rig.config import MarkerConfig
from rhot_sim.world.motion import OBJECT_SIZE_M
from rhot_sim.world.paint import FLAT_SHADES, PAINT_SHADES, SKIN_SHADES
from rhot_sim.world.parts import DISC, PATCH, Group, Part, Rings
from rhot_sim.world.world import World, WorldSample

SEAM_OVERLAP_M: Final = 0.0015
LAST_HINGE_OVERLAP_M: Final = 0.003
SEAM_TAPER: Final = 0.75
FOREARM_M: Final = 0.32
CORNER_RADIUS_M: Final = 0.006
_INDEX_KNUCKLE: Final = MOVING[1, 0]


FIXED_RINGS: Final = 40
"""Rings of every hand; those of patches and painted joints follow."""


class Body:
    """The parts of a world's hands and objects.

    Args:
        world: whose hands, markers and objects.
    """

    def __init__(self, world: World) -> None:
        self._objects = world.objects
        self._hands = {side: _HandBody(side, hand, world.markers) for side, hand in world.hands.items()}
        self.owner_rings: dict[str, slice] = {}
        """Hand's side or object's id to its rings."""
        sizes: dict[str, int] = {side: hand_body.ring_count for side, hand_body in self._hands.items()}
        sizes |= dict.fromkeys(self._objects, 8)
        count = 0
        for owner, size in sizes.items():
            self.owner_rings[owner] = slice(count, count + size)
            count += size
        self.ring_count = count
        self.marker_rings: dict[str, tuple[int, ...]] = {
            name: tuple(self.owner_rings[side].start + ring for ring in rings)
            for side, hand_body in self._hands.items()
            for name, rings in hand_body.marker_rings.items()
        }
        """Marker name to the rings whose hull is all of it, seen or hidden."""

    def rings(
        self, sample: WorldSample, camera_center: FloatArray, pictures: int = 1
    ) -> tuple[Rings, list[list[Group]]]:
        """Return all rings at the sample's moments, and the groups of each picture, as seen at its middle moment.

        Args:
            sample: K moments, as many for each picture, picture by picture.
            camera_center: (3,) metres, rig frame.
            pictures: of these moments.
        """
        k = len(sample.t_s)
        rings = Rings(
            np.zeros((k, self.ring_count, 3)),
            np.zeros((k, self.ring_count, 2, 3)),
            np.zeros((self.ring_count, 2)),
            np.zeros(self.ring_count, dtype=np.int8),
            np.zeros((k, self.ring_count, 3)),
        )
        groups: list[list[Group]] = [[] for _ in range(pictures)]
        for side, hand_body in self._hands.items():
            hand_body.place(sample.joints[side], camera_center, rings, self.owner_rings[side].start, groups)
        for name in self._objects:
            _place_box(name, sample.objects[name], camera_center, rings, self.owner_rings[name].start, groups)
        return rings, groups


class _HandBody:
    """One hand: 15 balls and 5 discs along the fingers, 15 discs in the last bones, wrist, forearm, web, patches."""

    def __init__(self, side: Side, hand: HandModel, markers: Mapping[str, MarkerConfig]) -> None:
        self._side = side
        self._hand = hand
        worn = {name: marker for name, marker in markers.items() if marker.hand == side}
        self._markers = worn
        tips = {marker.joint: name for name, marker in worn.items() if marker.kind == "cap"}
        self._caps = [tips.get(CHAINS[finger][-1], "skin") for finger in FINGERS]
        self._patches = [name for name, marker in worn.items() if marker.kind == "patch"]
        tip_joints = {CHAINS[finger][-1] for finger in FINGERS}
        self._bands = [name for name, marker in worn.items() if marker.kind == "cap" and marker.joint not in tip_joints]
        self.ring_count = FIXED_RINGS + len(self._patches) + len(self._bands)
        self.marker_rings: dict[str, tuple[int, ...]] = {
            **{cap: (4 * finger + 3, 20 + finger) for finger, cap in enumerate(self._caps) if cap != "skin"},
            **{name: (FIXED_RINGS + place,) for place, name in enumerate([*self._patches, *self._bands])},
        }
        radii = hand.radii[MOVING]
        self._radii = radii
        # The cut lies the cap's length behind the very tip; the radius there lies between those of tip and last hinge.
        behind = hand.cap_lengths - radii[:, 3]
        share = behind / hand.bones[:, 2]
        self._cut_m = behind
        self._cut_radius = radii[:, 3] + share * (radii[:, 2] - radii[:, 3])
        # A hand shows few of its sides, and for many frames the same: the parts of each are put together once.
        self._groups = lru_cache(maxsize=256)(self._groups_of)

    def place(
        self, joints: HandJoints, camera: FloatArray, rings: Rings, first: int, groups: list[list[Group]]
    ) -> None:
        """Set the hand's rings from `first` on, and add its groups to those of each picture."""
        hand = self._hand
        centers, axes = rings.centers[:, first:], rings.axes[:, first:]
        extents, kinds = rings.extents[first:], rings.kinds[first:]
        k = len(joints.positions)
        centers[:, :20] = joints.positions[:, MOVING].reshape(k, 20, 3)
        extents[:20] = self._radii.reshape(20, 1)
        tips = joints.positions[:, MOVING[:, 3]]
        frames = joints.rotations[:, MOVING[:, 3]]
        Z = frames[..., 2]
        cut = tips + self._cut_m[:, None] * Z
        middles = _middles(k, len(groups))
        skin_in_front = ((camera - cut[middles]) * Z[middles]).sum(-1) > 0.0
        sign = np.repeat(np.where(skin_in_front, 1.0, -1.0), k // len(groups), axis=0)[..., None]
        centers[:, 20:25] = cut
        centers[:, 25:30] = cut + SEAM_OVERLAP_M * sign * Z
        rings.shift_axes[:, first + 20 : first + 25] = sign * Z
        centers[:, 35:40] = joints.positions[:, MOVING[:, 2]] + LAST_HINGE_OVERLAP_M * Z
        for discs in (slice(20, 25), slice(25, 30), slice(35, 40)):
            axes[:, discs] = np.swapaxes(frames[..., :2], -1, -2)
            extents[discs] = self._cut_radius[:, None]
            kinds[discs] = DISC
        # Narrower under the other half: two blended edges in one place would let colour leak past the seam.
        extents[25:30] *= SEAM_TAPER
        extents[35:40] = self._radii[:, 2, None]
        # A ball about the last hinge would bulge over the paint, which begins within its radius.
        axes[:, 2:20:4] = np.swapaxes(joints.rotations[:, MOVING[:, 1], :, :2], -1, -2)
        kinds[2:20:4] = DISC
        self._place_arm(joints, centers, extents)
        for place, name in enumerate(self._patches):
            marker = self._markers[name]
            corners = hand.patch_corners(joints, marker, name)
            centers[:, FIXED_RINGS + place] = corners.mean(axis=1)
            R = joints.rotation(marker.joint)
            axes[:, FIXED_RINGS + place] = np.stack([R[..., 0], R[..., 2]], axis=1)
            extents[FIXED_RINGS + place] = np.array(marker.size_m or (0.0, 0.0)) / 2.0
            kinds[FIXED_RINGS + place] = PATCH
        for place, name in enumerate(self._bands, start=FIXED_RINGS + len(self._patches)):
            joint = JOINTS.index(self._markers[name].joint)
            centers[:, place] = joints.positions[:, joint]
            extents[place] = hand.radii[joint] * 1.03
        outwards = [joints.rotation(self._markers[name].joint)[middles, :, 1] for name in self._patches]
        facing = [
            (((camera - centers[middles, FIXED_RINGS + place]) * outward).sum(-1) > 0.0).tolist()
            for place, outward in enumerate(outwards)
        ]
        for picture, in_front in enumerate(skin_in_front.tolist()):
            patches = tuple(name for name, faces in zip(self._patches, facing, strict=True) if faces[picture])
            groups[picture] += self._groups(first, tuple(in_front), patches)

    def _place_arm(self, joints: HandJoints, centers: FloatArray, extents: FloatArray) -> None:
        """Set two balls at the wrist, two at the forearm's end and one in the web of the thumb."""
        radius = float(self._hand.radii[WRIST])
        frame = joints.rotations[:, WRIST]
        wrist = joints.positions[:, WRIST]
        across = frame[..., 0] * 0.62 * radius
        away = frame[..., 2] * FOREARM_M
        centers[:, 30], centers[:, 31] = wrist - across, wrist + across
        extents[30:32] = 0.80 * radius
        centers[:, 32], centers[:, 33] = wrist + away - 1.5 * across, wrist + away + 1.5 * across
        extents[32:34] = 1.15 * radius
        # The skin between thumb and index finger starts about two thirds along the index metacarpal.
        base, knuckle = joints.positions[:, METACARPALS[1]], joints.positions[:, _INDEX_KNUCKLE]
        centers[:, 34] = base + 0.68 * (knuckle - base)
        extents[34] = 0.75 * self._radii[1, 0]

    def _groups_of(self, first: int, skin_in_front: tuple[bool, ...], patches: tuple[str, ...]) -> tuple[Group, ...]:
        def part(rings: tuple[int, ...], paint: str) -> Part:
            shades = SKIN_SHADES if paint == "skin" else PAINT_SHADES
            return Part(tuple(first + ring for ring in rings), paint, shades)

        inner = 30 if self._side == "right" else 31
        palm = (part((30, 31, 32, 33), "skin"), part((30, 31, 4, 8, 12, 16), "skin"))
        patch_parts = tuple(
            Part((first + FIXED_RINGS + self._patches.index(name),), name, FLAT_SHADES) for name in patches
        )
        back = (first + 31, first + 8)
        groups = [
            Group.of(palm, back, self._side),
            # After the palm, whose distance it shares; equal distances keep their order.
            Group.of(patch_parts, back, self._side),
            Group.of((part((0, 1, 34, inner), "skin"), part((0, 1), "skin")), (first, first + 1), self._side),
        ]
        for finger in range(5):
            mcp, pip, dip, tip = (4 * finger + joint for joint in range(4))
            cut, under, hinge = 20 + finger, 25 + finger, 35 + finger
            bones = ((pip, dip),) if finger == 0 else ((mcp, pip), (pip, dip))
            skin = [part(bone, "skin") for bone in bones]
            groups.append(Group.of(skin, (first + pip, first + bones[0][0]), self._side))
            if skin_in_front[finger]:
                halves = (part((tip, cut, under), self._caps[finger]), part((hinge, cut), "skin"))
            else:
                halves = (part((hinge, cut, under), "skin"), part((tip, cut), self._caps[finger]))
            # One group each: a lit middle of the hidden half must not be drawn over the other half.
            groups += [Group.of((half,), (first + dip, first + tip), self._side) for half in halves]
        for place, name in enumerate(self._bands, start=FIXED_RINGS + len(self._patches)):
            groups.append(Group.of((part((place,), name),), (first + place,), self._side))
        return tuple(groups)


_CORNERS: Final[FloatArray] = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
_FACES: Final = tuple(
    (axis, sign, tuple(int(i) for i in np.flatnonzero(_CORNERS[:, axis] == sign)))
    for axis in range(3)
    for sign in (-1, 1)
)
_FACE_BRIGHTNESS: Final = {(0, -1): 0.7, (0, 1): 0.8, (1, -1): 0.5, (1, 1): 1.0, (2, -1): 0.75, (2, 1): 0.62}


def _middles(moments: int, pictures: int) -> slice:
    """Return the middle moment of each picture."""
    each = moments // pictures
    return slice(each // 2, None, each)


def _place_box(
    name: str, T: FloatArray, camera: FloatArray, rings: Rings, first: int, groups: list[list[Group]]
) -> None:
    """Set the eight balls of a rounded box with poses T (K, 4, 4), and add it to the groups of each picture."""
    eight = slice(first, first + 8)
    inner = _CORNERS * (OBJECT_SIZE_M / 2.0 - CORNER_RADIUS_M)
    rings.centers[:, eight] = inner @ np.swapaxes(T[:, :3, :3], -1, -2) + T[:, None, :3, 3]
    rings.extents[eight] = CORNER_RADIUS_M
    for drawn, middle in zip(groups, T[_middles(len(T), len(groups))], strict=True):
        to_camera = camera - middle[:3, 3]
        parts = [Part(tuple(range(first, first + 8)), "object", ((1.0, 0.5),))]
        for axis, sign, corners in _FACES:
            if sign * float(to_camera @ middle[:3, axis]) > OBJECT_SIZE_M[axis] / 2.0:
                shades = ((0.85, _FACE_BRIGHTNESS[axis, sign]),)
                parts.append(Part(tuple(first + corner for corner in corners), "object", shades))
        drawn += [Group.of((part,), tuple(range(first, first + 8)), name) for part in parts]
