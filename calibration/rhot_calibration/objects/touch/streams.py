"""Messages of hand and object to the samples that a collector takes; live and from a recording alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.skeleton import CHAINS, FINGERS
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.messages import FacedShape, HandPose, Message, ObjectPose, Side
from rhot.object_mesh import configured_mesh
from rhot.rig import Rig
from rhot.rig.cameras import camera_model
from rhot.rig.sections import MeshConfig
from rhot_calibration.objects.touch.collector import TouchCollector
from rhot_calibration.objects.touch.faces import face_named, usual_faces
from rhot_calibration.objects.touch.fit import Touch
from rhot_objects.core import key_of
from rhot_objects.pose import Pose, Registration

# Touches on a running rig: the fingertip from `rhot/hand/<side>`, the device from `rhot/object/<id>`.


TOUCHES_A_FACE: Final = 4
"""One near each corner of a box's face; of a surface that goes all round, thrice as many."""
_ROUND: Final = 3
_LARGEST_RESIDUAL: Final = 0.5
"""Share of the fingertip's radius: where marker and modelled marker lie further apart, nobody knows what touches."""


@dataclass(frozen=True, slots=True)
class TouchTask:
    """Who touches what.

    Attributes:
        object_id: of the touched object.
        source: of its poses; each has a registration of its own.
        shape: of the object, metres.
        side: of the hand.
        finger: whose tip touches.
        plan: the faces, in order, each as often as it is to be touched.
        registration: that the published poses carry; its offset is undone.
        eye_rig: (3,) amid the cameras, metres, rig frame.
    """

    object_id: str
    source: str
    shape: FacedShape
    side: Side
    finger: str
    plan: tuple[str, ...]
    registration: Registration
    eye_rig: FloatArray

    @property
    def hand_key(self) -> str:
        """Where the hand is published."""
        return f"rhot/hand/{self.side}"

    @property
    def object_key(self) -> str:
        """Where the object is published."""
        return key_of(self.object_id)

    def new_collector(self) -> TouchCollector:
        """Return a collector that has nothing yet."""
        return TouchCollector(self.shape, self.plan, self.eye_rig)


def touch_task(
    rig: Rig, object_id: str, *, side: str = "", finger: str = "index", faces: str = "", per_face: int = TOUCHES_A_FACE
) -> TouchTask:
    """Return what is to be touched.

    Args:
        rig: its objects, hands and registration.
        object_id: of the object.
        side: of the hand; empty = the rig's first.
        finger: whose tip touches.
        faces: names with commas between them; empty = all but the one on which the object stands.
        per_face: how often each is touched, thrice that all round.

    Raises:
        ConfigError: no such object, hand, finger or face, or an object without a shape; says what to do.
    """
    toml = rig.path / "rig.toml"
    if object_id not in rig.config.objects:
        there = ", ".join(rig.config.objects) or "none"
        raise ConfigError(f"{toml}: no [objects.{object_id}]; there is {there}. Add it, or name another object")
    shape = rig.config.objects[object_id].shape
    if shape is None:
        raise ConfigError(
            f"{toml}: [objects.{object_id}] has no shape, so nothing is known of its faces; measure it and add for "
            'instance  shape = { kind = "cylinder", radius = 0.04, height = 0.1 }'
        )
    if isinstance(shape, MeshConfig):
        x, y, z = (round(edge, 4) for edge in configured_mesh(rig, shape).shape.size)
        raise ConfigError(
            f"{toml}: [objects.{object_id}] is a mesh, which has no faces to name. Touch it as the box around it, "
            f'which has the same frame (y up):  shape = {{ kind = "box", size = [{x}, {y}, {z}] }}  with --faces of '
            "those that are flat; then put the mesh back"
        )
    sides = rig.config.sides
    if not sides:
        raise ConfigError(f"{toml}: no marker is on a hand; a tracked fingertip is needed to touch with")
    chosen = next((each for each in sides if each == (side or sides[0])), None)
    if chosen is None:
        raise ConfigError(f"{toml}: no marker is on the {side} hand; the rig tracks {', '.join(sides)}")
    if finger not in FINGERS:
        raise ConfigError(f"no finger is called {finger[:20]!r}; choose one of {', '.join(FINGERS)}")
    worn = {marker.joint for marker in rig.config.markers.values() if marker.hand == chosen}
    if CHAINS[finger][-1] not in worn:
        raise ConfigError(f"{toml}: no marker is on the {chosen} {finger} finger's tip; touch with a painted finger")
    named = [face_named(shape, text) for text in faces.split(",") if text.strip()] or usual_faces(shape)
    plan = [face for face in named for _ in range(per_face * (_ROUND if face in ("side", "anywhere") else 1))]
    eye = np.mean([camera_model(camera).center for camera in rig.cameras.values()], axis=0)
    source = rig.config.objects[object_id].source
    registration = Registration.from_file(rig.registration_of(source))
    return TouchTask(object_id, source, shape, chosen, finger, tuple(plan), registration, eye)


def feed(task: TouchTask, collector: TouchCollector, key: str, message: Message) -> Touch | None:
    """Take a message, return the touch that it completed."""
    if key == task.hand_key and isinstance(message, HandPose):
        name = CHAINS[task.finger][-1]
        tip = message.joints.get(name)
        if message.state != "measured":
            collector.add_no_tip(message.t_ns, "the hand is only predicted: show it to the cameras")
        elif tip is None or message.fingers.get(task.finger, "predicted") != "measured":
            collector.add_no_tip(
                message.t_ns, f"the cameras do not see the {task.finger} fingertip: turn object or hand until they do"
            )
        else:
            if message.residual.get(task.finger, 0.0) > _LARGEST_RESIDUAL * tip.radius:
                collector.add_no_tip(message.t_ns, "the fingertip is measured badly: show it to both cameras")
                return None
            return collector.add_tip(message.t_ns, np.array(tip.position), tip.radius)
    elif key == task.object_key and isinstance(message, ObjectPose) and message.state == "measured":
        fixed = task.registration.T_device_object.get(task.object_id)
        T_rig_object = Pose.from_arrays(message.position, message.orientation)
        return collector.add_device(message.t_ns, T_rig_object if fixed is None else T_rig_object @ fixed.inverse())
    return None
