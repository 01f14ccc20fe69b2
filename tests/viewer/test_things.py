"""Markers, objects, head, feet and legs."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.messages import (
    BodyJoint,
    BodyPose,
    BoxShape,
    CylinderShape,
    FootPose,
    HeadPose,
    MeshShape,
    ObjectPose,
    ObjectShape,
    Point,
    PointSet,
    SphereShape,
)
from rhot_viewer.scene.drawn import (
    FOOT_MIDDLE_M,
    FOOT_SIZE_M,
    MARKER_RADIUS_M,
    OBJECT_SIZE_M,
    PREDICTED_COLOR,
    PREDICTED_SHARE,
    UNKNOWN_COLOR,
    body_rods,
    foot_boxes,
    marker_balls,
    object_copies,
)

LEVEL = (0.0, 0.0, 0.0, 1.0)
QUARTER_ABOUT_Y = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))


def test_markers_have_their_colours_and_predicted_ones_are_smaller() -> None:
    points = {
        "thumb": Point(position=(0.1, 0.2, 0.3), sigma=0.001, views=2, state="measured"),
        "new": Point(position=(0.4, 0.5, 0.6), sigma=0.001, views=0, state="predicted"),
    }
    copies = marker_balls(PointSet(t_ns=1, frame="rig", points=points), {"thumb": (9, 8, 7)})
    assert copies.colors.tolist() == [[9, 8, 7], list(UNKNOWN_COLOR)]
    assert copies.positions[1] == pytest.approx((0.4, 0.5, 0.6))
    assert copies.scales[:, 0] == pytest.approx([MARKER_RADIUS_M, MARKER_RADIUS_M * PREDICTED_SHARE], abs=1e-5)
    assert len(marker_balls(PointSet(t_ns=1, frame="rig", points={}), {})) == 0


def test_objects_and_head_stand_where_they_are() -> None:
    cube = ObjectPose(t_ns=1, frame="rig", position=(1.0, 2.0, 3.0), orientation=QUARTER_ABOUT_Y, state="predicted")
    head = HeadPose(t_ns=1, frame="rig", position=(0.0, 1.7, 0.0), orientation=LEVEL, state="measured")
    copies = object_copies({"cube": cube}, head).boxes
    assert copies.positions.tolist() == [[1.0, 2.0, 3.0], pytest.approx([0.0, 1.7, 0.0])]
    assert copies.wxyzs[0] == pytest.approx((np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0))
    assert tuple(copies.colors[0]) == PREDICTED_COLOR
    assert copies.scales[0] == pytest.approx(OBJECT_SIZE_M, abs=1e-5)
    assert len(object_copies({}, None).boxes) == 0


def test_objects_have_the_size_of_their_shapes() -> None:
    shapes: dict[str, ObjectShape] = {
        "book": BoxShape(size=(0.15, 0.2, 0.03)),
        "cup": CylinderShape(radius=0.04, height=0.1),
        "ball": SphereShape(radius=0.03),
        # Drawn by `MeshLayer`.
        "pot": MeshShape(file="pot.glb", size=(0.1, 0.1, 0.1), planes=((0, 0, 1, 0.05),) * 4),
    }
    middle = (0.1, 0.2, 0.8)
    objects = {
        name: ObjectPose(
            t_ns=1, frame="rig", position=middle, orientation=QUARTER_ABOUT_Y, state="measured", shape=shape
        )
        for name, shape in shapes.items()
    }
    copies = object_copies(objects, None)
    # A rod's mesh has radius 1 and length 1 along z, a ball's radius 1.
    sizes = ((0.15, 0.2, 0.03), (0.04, 0.04, 0.1), (0.03, 0.03, 0.03))
    for found, size in zip((copies.boxes, copies.rods, copies.balls), sizes, strict=True):
        assert len(found) == 1
        assert found.scales[0] == pytest.approx(size, abs=1e-5)
        assert found.positions[0] == pytest.approx(middle)
        assert found.wxyzs[0] == pytest.approx((np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0))


def test_a_foot_turns_about_its_marker() -> None:
    foot = FootPose(
        t_ns=1,
        side="left",
        frame="rig",
        position=(0.1, 0.1, 0.1),
        orientation=QUARTER_ABOUT_Y,
        velocity=(0.0, 0.0, 0.0),
        sigma=0.01,
        stage="marker",
        state="measured",
    )
    copies = foot_boxes({"left": foot})
    x, y, z = FOOT_MIDDLE_M
    # A quarter turn about y carries z to x.
    assert copies.positions[0] == pytest.approx((0.1 + z, 0.1 + y, 0.1 - x))
    assert copies.scales[0] == pytest.approx(FOOT_SIZE_M)


def test_legs_are_drawn_as_far_as_they_are_known() -> None:
    def joint(*position: float) -> BodyJoint:
        x, y, z = position
        return BodyJoint(position=(x, y, z), orientation=LEVEL)

    joints = {"hips": joint(0, 1, 0), "left_hip": joint(-0.1, 1, 0), "left_knee": joint(-0.1, 0.5, 0)}
    body = BodyPose(t_ns=1, frame="rig", joints=joints, angles={}, legs={"left": "predicted"}, state="measured")
    balls, rods = body_rods(body)
    assert len(balls) == len(rods) == 2
    assert rods.scales[:, 2] == pytest.approx([0.1, 0.5])
    assert tuple(rods.colors[0]) == PREDICTED_COLOR
    arms = {"chest": joint(0, 1.2, 0), "right_shoulder": joint(0.2, 1.4, 0), "right_elbow": joint(0.2, 1.1, 0)}
    upper = body.model_copy(update={"joints": arms, "legs": {}, "arms": {"right": "predicted"}})
    assert [tuple(color) for color in body_rods(upper)[1].colors] == [PREDICTED_COLOR] * 2
    empty = body_rods(body.model_copy(update={"joints": {}}))
    assert [len(part) for part in empty] == [0, 0]
