"""The core of the objects service: converts samples of one source to messages in the rig frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from rhot.core import Output
from rhot.messages import HeadPose, ObjectPose, ObjectShape, State
from rhot.messages.base import wire_position, wire_quaternion
from rhot_objects.pose import Pose, Registration
from rhot_objects.sources import HEAD, PoseSample

RIG_FRAME: Final = "rig"
HOLD_S: Final = 0.2
"""How long a lost object is published at its last measured pose, in state `predicted`, seconds."""


class ObjectCore:
    """Transforms the poses of one source to the rig frame, and holds poses during short losses.

    One instance per source: an object that is absent from a reading counts as lost.
    """

    def __init__(
        self,
        registration: Registration,
        hold_s: float = HOLD_S,
        shapes: Mapping[str, ObjectShape] | None = None,
    ) -> None:
        """Start with nothing tracked.

        Args:
            registration: tracker space to rig.
            hold_s: how long a lost object is held, seconds.
            shapes: known shapes by object id.
        """
        self._shapes = dict(shapes or {})
        self._registration = registration
        self._hold_ns = round(hold_s * 1e9)
        self._last: dict[str, tuple[int, Pose]] = {}
        self.unusable = 0
        """Number of samples since the start that were beyond the limits of a message."""

    def registered(self, registration: Registration) -> ObjectCore:
        """Return a new core for the same objects with another registration."""
        return ObjectCore(registration, self._hold_ns / 1e9, self._shapes)

    def feed(self, samples: Mapping[str, PoseSample], now_ns: int) -> list[Output]:
        """Process one reading and return the messages to publish.

        Args:
            samples: tracked poses by object id, tracker space; lost objects are absent.
            now_ns: rig time of the reading.

        Returns:
            Keys and messages: `measured` with the sample's time for each tracked object, `predicted` with the last pose
            and `now_ns` for each object that was lost less than `hold_s` ago.
        """
        outputs = []
        for object_id, sample in samples.items():
            T_rig_object = self._registration.to_rig(object_id, sample.pose)
            # Limit of the message; a larger distance is an error of the tracking system.
            if np.abs(T_rig_object.position).max() > 1e3:
                self.unusable += 1
                continue
            self._last[object_id] = (sample.t_ns, T_rig_object)
            outputs.append(self._output(object_id, T_rig_object, sample.t_ns, "measured"))
        fresh = {key for key, _ in outputs}
        for object_id, (t_ns, T_rig_object) in list(self._last.items()):
            if key_of(object_id) in fresh:
                continue
            if 0 <= now_ns - t_ns <= self._hold_ns:
                outputs.append(self._output(object_id, T_rig_object, now_ns, "predicted"))
            else:
                del self._last[object_id]
        return outputs

    def _output(self, object_id: str, pose: Pose, t_ns: int, state: State) -> Output:
        model = HeadPose if object_id == HEAD else ObjectPose
        position, orientation = wire_position(pose.position), wire_quaternion(pose.orientation_xyzw)
        shape = self._shapes.get(object_id)
        message = model(
            t_ns=t_ns, frame=RIG_FRAME, position=position, orientation=orientation, state=state, shape=shape
        )
        return key_of(object_id), message


def key_of(object_id: str) -> str:
    """Return the key of an object; the headset has its own."""
    return "rhot/head" if object_id == HEAD else f"rhot/object/{object_id}"
