"""The first message to the page: hand model, desk, colours, address of the viewer page."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rigid
from rhot.messages import Side
from rhot.object_mesh import ObjectMesh, known_mesh
from rhot.rig import Rig
from rhot.rig.folder import registration_path
from rhot_viewer.grasp.text import space_text
from rhot_viewer.scene.instances import Rgb
from rhot_viewer.scene.viewpoint import desk_middle, up_direction

_SPREAD_DEG: Final = {"thumb": 25.0, "index": 15.0, "middle": 2.0, "ring": -12.0, "little": -15.0}
"""Abduction of the rest pose in which the skin is created: fingers spread, so that their skin does not merge; close to
the limits of `ANGLE_LIMITS_DEG`."""


def hello_text(rig: Rig, colors: Mapping[str, Rgb], other_page: str, may_publish: bool, devices: list[str]) -> str:
    """Return the first message, JSON.

    Args:
        rig: loaded.
        colors: of the markers.
        other_page: address of the viewer page; empty without one.
        may_publish: whether this browser may publish its headset's poses.
        devices: objects of the headset that `rig.toml` defines.
    """
    sides: tuple[Side, ...] = ("left", "right")
    T_rig_stage, source = stage_of(rig)
    floor_m = float(np.linalg.inv(T_rig_stage)[1] @ np.append(desk_middle(rig), 1.0))
    return json.dumps(
        {
            "type": "hello",
            "rig": rig.config.name,
            "simulated": any(camera.source == "simulated" for camera in rig.config.cameras.values())
            or (rig.config.feet is not None and rig.config.feet.camera.source == "simulated"),
            "hands": {side: rest_hand(rig, side) for side in sides},
            "paint": {side: _paint(rig, colors, side) for side in sides},
            "stage": json.loads(space_text(T_rig_stage.tolist(), source)),
            "webxr": webxr_of(rig),
            "desk": {
                "middle": [round(float(number), 4) for number in desk_middle(rig)],
                "height_m": round(floor_m, 4),
                "shown": rig.config.feet is None,
            },
            "meshes": {
                name: {
                    "middle": [round(float(x), 6) for x in mesh.middle],
                    "scale": mesh.scale,
                    "size": mesh.shape.size,
                }
                for name, mesh in meshes_of(rig).items()
            },
            "other_page": other_page,
            "may_publish": may_publish,
            "devices": devices,
        },
        separators=(",", ":"),
    )


def meshes_of(rig: Rig) -> dict[str, ObjectMesh]:
    """Return the usable surfaces of the rig's objects by name."""
    found = {name: known_mesh(rig, name) for name in rig.config.objects}
    return {name: mesh for name, mesh in found.items() if mesh is not None}


def stage_of(rig: Rig) -> tuple[FloatArray, str]:
    """Return T_rig_stage (4, 4), metres, and its source.

    Without a `stage.json` the floor is assumed below the desk, and forward is the viewing direction of a person at the
    upper edge of the images.
    """
    if rig.stage is not None:
        return np.array(rig.stage.T_rig_stage.matrix), rig.stage.source
    up = up_direction(rig)
    forward = np.array([0.0, 1.0, 0.0]) if abs(up[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    back = -(forward - up * (forward @ up))
    back /= np.linalg.norm(back)
    R = np.column_stack([np.cross(up, back), up, back])
    # Height of a desk that was not measured (DIN EN 527-1: 740 mm for desks of fixed height).
    height_m = 0.74 if rig.config.feet is None else 0.0
    return rigid(R, desk_middle(rig) - height_m * up), "a guess: `rhot calibrate stage` finds the floor"


def webxr_of(rig: Rig) -> list[float] | None:
    """Return T_rig_webxr, 16 numbers row by row, metres; None while no headset is registered.

    `registration.json` is for another system's space, unless the headset is the only source of objects.
    """
    sources = {thing.source for thing in rig.config.objects.values()}
    own = "webxr" in rig.registrations
    if not own and (sources != {"webxr"} or registration_path(rig.path, "webxr") is None):
        return None
    matrix = rig.registration_of("webxr").T_rig_tracker.matrix
    return [round(float(number), 7) for number in matrix.ravel()]


def rest_hand(rig: Rig, side: Side) -> dict[str, Any]:
    """Return the rest pose of a hand, fingers straight and spread: joints (26 x 7), wrist frame, and radii, metres."""
    model = HandModel.from_file(rig.hand, side)
    angles = np.zeros((len(FINGERS), 4))
    angles[:, 1] = np.radians([_SPREAD_DEG[finger] for finger in FINGERS])
    joints = model.forward_local(model.clamp(angles))
    quaternions = quaternion_from_rotation(joints.rotations)
    numbers = np.hstack([joints.positions, quaternions]).ravel()
    return {
        "joints": [round(float(number), 6) for number in numbers],
        "radii": [round(float(radius), 5) for radius in model.radii],
    }


def _paint(rig: Rig, colors: Mapping[str, Rgb], side: Side) -> dict[str, Rgb]:
    """Return the colour of each painted fingertip of a hand."""
    tips = {f"{finger}_tip": finger for finger in FINGERS}
    return {
        tips[marker.joint]: colors[name]
        for name, marker in rig.config.markers.items()
        if marker.hand == side and marker.joint in tips and name in colors
    }
