from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hands.legal_angles import legal_angles

from rhot.anatomy.hand import HandJoints, HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_vector
from rhot.messages import Point, PointSet, Position, Side
from rhot.rig import CameraConfig, HandFile, MarkerConfig, Rig, RigConfig
from rhot.rig.folder import NO_REGISTRATION

START_NS = 1_700_000_000_000_000_000

MakePoints = Callable[..., PointSet]


def markers_of(side: Side, prefix: str = "") -> dict[str, MarkerConfig]:
    markers = {f"{prefix}{finger}": MarkerConfig(hand=side, joint=f"{finger}_tip") for finger in FINGERS}
    markers[f"{prefix}base"] = MarkerConfig(hand=side, joint="wrist", kind="patch", size_m=(0.04, 0.03))
    return markers


def triple(values: FloatArray) -> Position:
    x, y, z = values.tolist()
    return (x, y, z)


def rig_with(markers: dict[str, MarkerConfig]) -> Rig:
    config = RigConfig(cameras={"left": CameraConfig()}, markers=markers)
    return Rig(Path(), config, {}, True, HandFile(), NO_REGISTRATION)


def lying_wrist(turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> FloatArray:
    """A hand 0.8 m in front of the camera, its back to it, fingers up in the picture."""
    T = np.eye(4)
    T[:3, :3] = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]) @ rotation_from_vector(np.array(turn_rad))
    T[:3, 3] = 0.02, 0.05, 0.8
    return T


@pytest.fixture
def right_rig() -> Rig:
    return rig_with(markers_of("right"))


@pytest.fixture
def two_hands_rig() -> Rig:
    return rig_with(markers_of("right", "r_") | markers_of("left", "l_"))


@pytest.fixture
def wrist() -> Callable[..., FloatArray]:
    return lying_wrist


@pytest.fixture
def random_angles() -> Callable[[HandModel, int, int], FloatArray]:
    return legal_angles


@pytest.fixture
def right_hand() -> HandModel:
    return HandModel.from_file(HandFile(), "right")


@pytest.fixture
def make_points() -> MakePoints:
    def make(
        model: HandModel,
        joints: HandJoints,
        markers: dict[str, MarkerConfig],
        t_s: float,
        *,
        hide: tuple[str, ...] = (),
        corners: bool = True,
        noise: FloatArray | None = None,
    ) -> PointSet:
        points = {}
        for index, (name, centre) in enumerate(model.marker_positions(joints, markers).items()):
            if name in hide:
                continue
            patch: tuple[Position, Position, Position, Position] | None = None
            if corners and markers[name].kind == "patch":
                # From another corner on and the other way round than the model's own order.
                turned = np.roll(model.patch_corners(joints, markers[name])[::-1], 1, axis=0)
                patch = (triple(turned[0]), triple(turned[1]), triple(turned[2]), triple(turned[3]))
            moved = centre if noise is None else centre + noise[index]
            points[name] = Point(position=triple(moved), sigma=0.001, views=2, state="measured", corners=patch)
        return PointSet(t_ns=START_NS + round(t_s * 1e9), frame="rig", points=points)

    return make
