"""A model of recorded hands for OpenSim: its markers are those of the TRC file, its coordinates those of the MOT.

No model of a hand is standard in OpenSim, so this one is made from the last pose of each hand: its bones, and the axes
of `rhot.anatomy.hand`. OpenSim's inverse kinematics then runs on the TRC file as it is. A hand has 26 coordinates:

    wrist     three translations and R = Ry(yaw)·Rx(pitch)·Rz(roll) against the floor, as `wrist_angles` of `frames`
    knuckle   R = F·Ry(±abduction)·Rx(−flexion), F the finger's frame at rest, + for a right and − for a left hand
    hinge     R = Rx(−flexion)

Format: OpenSim's documentation, "OpenSim Models", file version 40000. Lengths are metres, angles radians. The bodies
have the mass of a hand's parts only because OpenSim refuses bodies without one: nothing here is for dynamics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final
from xml.etree import ElementTree

import numpy as np

from rhot.anatomy.hand import METACARPALS, MOVING, PALM, WRIST
from rhot.anatomy.skeleton import FINGER_ANGLES, FINGERS, JOINTS, angle_name
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.geometry.rotations import rotation_x, rotation_y
from rhot_tools.export.poses import ExportedMotion

_MASS_KG: Final = 0.05
_INERTIA: Final = "1e-05 1e-05 1e-05 0 0 0"
_HALF_CLOSED_RAD: Final = 0.6
"""Flexion from which OpenSim searches: from the flat hand it may find a thumb abducted by half a turn, whose markers
fit as well. Bounds would exclude that, but with them its solver stops millimetres away."""
_X, _Y, _Z = np.eye(3)


def osim_text(motions: Sequence[ExportedMotion]) -> str:
    """Return the OpenSim model of all hands among the motions.

    Raises:
        ConfigError: there is no hand with joint angles among them.
    """
    hands = [each for each in motions if each.is_hand and each.angles]
    if not hands:
        raise ConfigError("--osim: the recording holds no hand with joint angles")
    document = ElementTree.Element("OpenSimDocument", Version="40000")
    model = ElementTree.SubElement(document, "Model", name="_".join(hand.name for hand in hands))
    _value(model, "gravity", 0.0, -9.80665, 0.0)
    ElementTree.SubElement(model, "length_units").text = "meters"
    ElementTree.SubElement(model, "Ground", name="ground")
    bodies, joints, markers = (
        ElementTree.SubElement(ElementTree.SubElement(model, f"{kind}Set", name=f"{kind.lower()}set"), "objects")
        for kind in ("Body", "Joint", "Marker")
    )
    for hand in hands:
        _Hand(hand, bodies, joints, markers).write()
    ElementTree.indent(document)
    return ElementTree.tostring(document, "unicode", xml_declaration=True) + "\n"


class _Hand:
    """Writes one hand into the sets of a model."""

    def __init__(
        self,
        motion: ExportedMotion,
        bodies: ElementTree.Element,
        joints: ElementTree.Element,
        markers: ElementTree.Element,
    ) -> None:
        self._name = motion.name
        self._handedness = -1.0 if motion.name.endswith("left") else 1.0
        self._bodies, self._joints, self._markers = bodies, joints, markers
        known = np.flatnonzero(np.all(np.isfinite(list(motion.angles.values())), axis=0))
        if not len(known):
            raise ConfigError(f"--osim: no pose of {motion.name} has all joint angles")
        last = int(known[-1])
        self._angles = {name: float(values[last]) for name, values in motion.angles.items()}
        R_wrist = motion.rotations[last, WRIST]
        self._positions = (motion.positions[last] - motion.positions[last, WRIST]) @ R_wrist
        self._rotations = R_wrist.T @ motion.rotations[last]

    def write(self) -> None:
        """Write the bodies, joints and markers."""
        wrist = f"{self._name}_wrist"
        turns = [(f"{wrist}_{name}", axis) for name, axis in (("yaw", _Y), ("pitch", _X), ("roll", _Z))]
        self._joint(wrist, "/ground", np.zeros(3), np.eye(3), turns, moves=True)
        still = [WRIST, PALM, *METACARPALS[1:].tolist(), *MOVING[:, 0].tolist()]
        for joint in still:
            self._marker(wrist, joint, self._positions[joint])
        for finger, row in zip(FINGERS, MOVING.tolist(), strict=True):
            self._finger(finger, row, wrist)

    def _finger(self, finger: str, row: list[int], wrist: str) -> None:
        """Write one finger: `row` holds its knuckle, two hinges and tip."""
        bones = np.linalg.norm(np.diff(self._positions[row], axis=0), axis=-1)
        first, abduction, *hinges = (f"{self._name}_{angle_name(finger, angle)}" for angle in FINGER_ANGLES)
        knuckle = f"{self._name}_{JOINTS[row[0]]}"
        turns = [(abduction, self._handedness * _Y), (first, -_X)]
        self._joint(knuckle, f"/bodyset/{wrist}", self._positions[row[0]], self._rest(finger, row[0]), turns)
        parent = knuckle
        for joint, bone, flexion in zip(row[1:], bones, (*hinges, None), strict=True):
            end = np.array([0.0, 0.0, -bone])
            self._marker(parent, joint, end)
            if flexion is not None:
                body = f"{self._name}_{JOINTS[joint]}"
                self._joint(body, f"/bodyset/{parent}", end, np.eye(3), [(flexion, -_X)])
                parent = body

    def _rest(self, finger: str, knuckle: int) -> FloatArray:
        """Return F (3, 3), the finger's frame in the wrist's where all its angles are zero.

        R_wrist_1 = F·Ry(±abduction)·Rx(−flexion).
        """
        flexion = self._angles[angle_name(finger, "mcp_flexion")]
        abduction = self._handedness * self._angles[angle_name(finger, "mcp_abduction")]
        rest: FloatArray = self._rotations[knuckle] @ rotation_x(flexion) @ rotation_y(-abduction)
        return rest

    def _joint(
        self,
        body: str,
        parent: str,
        at: FloatArray,
        R: FloatArray,
        turns: Sequence[tuple[str, FloatArray]],
        *,
        moves: bool = False,
    ) -> None:
        """Write a body and the joint that holds it at `at`, R of its parent; it turns about axes, one after another."""
        made = ElementTree.SubElement(self._bodies, "Body", name=body)
        _value(made, "mass", _MASS_KG)
        _value(made, "mass_center", 0.0, 0.0, 0.0)
        ElementTree.SubElement(made, "inertia").text = _INERTIA
        joint = ElementTree.SubElement(self._joints, "CustomJoint", name=f"{body}_joint")
        ElementTree.SubElement(joint, "socket_parent_frame").text = f"{body}_parent"
        ElementTree.SubElement(joint, "socket_child_frame").text = f"{body}_child"
        coordinates = ElementTree.SubElement(joint, "coordinates")
        shifts = [(f"{body}_t{axis}", direction) for axis, direction in zip("xyz", np.eye(3), strict=True)]
        for name, _ in [*turns, *(shifts if moves else ())]:
            coordinate = ElementTree.SubElement(coordinates, "Coordinate", name=name)
            if name.endswith("flexion"):
                _value(coordinate, "default_value", _HALF_CLOSED_RAD)
        frames = ElementTree.SubElement(joint, "frames")
        for end, socket, place, axes in (
            ("parent", parent, at, R),
            ("child", f"/bodyset/{body}", np.zeros(3), np.eye(3)),
        ):
            frame = ElementTree.SubElement(frames, "PhysicalOffsetFrame", name=f"{body}_{end}")
            ElementTree.SubElement(frame, "socket_parent").text = socket
            _value(frame, "translation", *place)
            _value(frame, "orientation", *_body_fixed_xyz(axes))
        # A transform has three axes of rotation and three of translation; about those left over nothing turns or moves.
        transform = ElementTree.SubElement(joint, "SpatialTransform")
        axes_left = [axis for axis in np.eye(3) if not any(abs(axis @ used) > 0.5 for _, used in turns)]
        rotations = [*turns, *((None, axis) for axis in axes_left)]
        translations = shifts if moves else [(None, direction) for _, direction in shifts]
        for kind, rows in (("rotation", rotations), ("translation", translations)):
            for number, (name, axis) in enumerate(rows, start=1):
                turning = ElementTree.SubElement(transform, "TransformAxis", name=f"{kind}{number}")
                ElementTree.SubElement(turning, "coordinates").text = name or ""
                _value(turning, "axis", *axis)
                if name is None:
                    _value(ElementTree.SubElement(turning, "Constant", name="function"), "value", 0.0)
                else:
                    function = ElementTree.SubElement(turning, "LinearFunction", name="function")
                    _value(function, "coefficients", 1.0, 0.0)

    def _marker(self, body: str, joint: int, at: FloatArray) -> None:
        marker = ElementTree.SubElement(self._markers, "Marker", name=f"{self._name}_{JOINTS[joint]}")
        ElementTree.SubElement(marker, "socket_parent_frame").text = f"/bodyset/{body}"
        _value(marker, "location", *at)


def _body_fixed_xyz(R: FloatArray) -> FloatArray:
    """Return the angles (3,) of R = Rx·Ry·Rz, radians, OpenSim's for the orientation of a frame."""
    return np.array(
        [np.arctan2(-R[1, 2], R[2, 2]), np.arcsin(np.clip(R[0, 2], -1.0, 1.0)), np.arctan2(-R[0, 1], R[0, 0])]
    )


def _value(parent: ElementTree.Element, tag: str, *values: float) -> None:
    ElementTree.SubElement(parent, tag).text = " ".join(f"{value + 0.0:.9g}" for value in values)
