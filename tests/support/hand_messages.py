"""A hand that moves through most of its range, as the messages a rig would publish."""

from __future__ import annotations

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from rhot.messages import FingerAngles, HandPose, Joint, Marker, MarkerFrame, ObjectPose, Point, PointSet
from rhot.rig import HandFile

MODEL = HandModel.from_file(HandFile(length_m=0.189), "right")
LEFT_MODEL = HandModel.from_file(HandFile(length_m=0.175), "left")


def hand_pose(t_s: float, t_ns: int, model: HandModel = MODEL) -> HandPose:
    """A right hand that tumbles through all directions while its fingers open and close."""
    share = 0.5 + 0.5 * np.sin(2.0 * t_s + np.arange(5)[:, None])
    angles = model.angle_min + share * (model.angle_max - model.angle_min)
    T = np.eye(4)
    T[:3, :3] = rotation_from_vector(np.array([t_s, 0.7 * np.sin(t_s), 1.9 * t_s]))
    T[:3, 3] = 0.1 * np.sin(t_s), 0.05, 0.6 + 0.1 * np.cos(t_s)
    joints = model.forward(T, angles)
    quaternions = quaternion_from_rotation(joints.rotations)
    return HandPose(
        t_ns=t_ns,
        side=model.side,
        frame="rig",
        joints={
            name: Joint(
                position=tuple(joints.positions[row].tolist()),
                orientation=tuple(quaternions[row].tolist()),
                radius=float(model.radii[row]),
            )
            for row, name in enumerate(JOINTS)
        },
        angles={
            finger: FingerAngles(
                mcp_flexion=float(flexion),
                mcp_abduction=float(abduction),
                pip_flexion=float(pip),
                dip_flexion=float(dip),
            )
            for finger, (flexion, abduction, pip, dip) in zip(FINGERS, angles, strict=True)
        },
        residual={"index": 0.0012},
        fingers=dict.fromkeys(FINGERS, "measured"),
        state="measured",
    )


def marker_frame(camera: str, t_ns: int) -> MarkerFrame:
    marker = Marker(u=320.25, v=240.5, area=120.0, score=0.9, t_ns=t_ns + 1_000_000)
    return MarkerFrame(t_ns=t_ns, camera=camera, width=640, height=480, markers={"index": marker, "thumb": marker})


def point_set(t_ns: int, *names: str) -> PointSet:
    point = Point(position=(0.01, -0.02, 0.6), sigma=0.0008, views=2, state="measured")
    return PointSet(t_ns=t_ns, frame="rig", points=dict.fromkeys(names or ("index", "thumb"), point))


def object_pose(t_ns: int, x: float) -> ObjectPose:
    return ObjectPose(
        t_ns=t_ns, frame="rig", position=(x, 0.0, 0.5), orientation=(0.0, 0.0, 0.0, 1.0), state="measured"
    )
