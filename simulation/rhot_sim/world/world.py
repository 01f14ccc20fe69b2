"""The simulated world: what is where at any moment, from seed and time alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandJoints, HandModel
from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.messages import BoxShape, Side, TruePose, Truth
from rhot.messages.base import wire_position
from rhot.rig.config import MarkerConfig, SimConfig
from rhot.rig.folder import Rig
from rhot_sim.rig.calibration import simulated_rig_calibration
from rhot_sim.walker.world import WalkerWorld
from rhot_sim.world.board import BoardMotion, ChessBoard, LyingBoard
from rhot_sim.world.crossing import CrossingMotion
from rhot_sim.world.motion import OBJECT_SIZE_M, Motion, StillMotion, true_pose
from rhot_sim.world.script import ScriptedMotion
from rhot_sim.world.touching import TouchMotion

HEAD: Final = "head"
"""The object that is the headset."""


@dataclass(frozen=True, slots=True)
class WorldSample:
    """The world at N moments, rig frame.

    Attributes:
        t_s: (N,) seconds since the world's start.
        joints: side to its joints; positions (N, 26, 3) metres, rotations (N, 26, 3, 3).
        angles: side to joint angles (N, 5, 4), radians, as in `rhot.anatomy.hand`.
        markers: marker name to the centre of its painted volume, (N, 3) metres.
        objects: object id to the pose of its centre, (N, 4, 4), metres; `board` to that of its first inner corner,
            `head` to that of the headset.
    """

    t_s: FloatArray
    joints: Mapping[Side, HandJoints]
    angles: Mapping[Side, FloatArray]
    markers: Mapping[str, FloatArray]
    objects: Mapping[str, FloatArray]


class World:
    """Hands with their markers, and objects on a desk.

    Args:
        seed: with the time it determines everything.
        hands: the hands in the world by side.
        markers: what is painted on them.
        objects: ids of the objects.
        motion: what moves; the scripted motion of the seed when not given.
        desk_z_m: distance of the desk from the reference camera.
        board: a chessboard that `motion` moves as object `board`.
        walker: the person whose feet are tracked; the headset is its object `head`.
    """

    def __init__(
        self,
        seed: int,
        hands: Mapping[Side, HandModel],
        markers: Mapping[str, MarkerConfig],
        objects: Sequence[str] = (),
        *,
        motion: Motion | None = None,
        desk_z_m: float = 0.95,
        board: ChessBoard | None = None,
        walker: WalkerWorld | None = None,
    ) -> None:
        self.seed = seed
        self.hands = dict(hands)
        self.markers = {name: marker for name, marker in markers.items() if marker.hand in hands}
        self.objects = tuple(objects)
        self.desk_z_m = desk_z_m
        self.board = board
        self.walker = walker
        self.motion: Motion = motion or ScriptedMotion(seed, self.hands, self.objects, desk_z_m)

    @classmethod
    def from_rig(cls, rig: Rig) -> World:
        """Build the world that a rig folder describes: hands, markers and simulated objects, or a board; a walker.

        Raises:
            ConfigError: an object is said to have a shape that this world does not draw.
        """
        config = rig.config
        if config.sim.motion in ("board", "desk_board"):
            board = ChessBoard(config.sim.board_columns, config.sim.board_rows, config.sim.board_square_m)
            return cls(config.sim.seed, {}, {}, motion=_board_motion(rig, board), board=board)
        hands: dict[Side, HandModel] = {side: HandModel.from_file(rig.hand, side) for side in config.sides}
        walker = None if config.feet is None else WalkerWorld.from_rig(rig)
        worn = () if walker is None else (HEAD,)
        objects = [name for name, item in config.objects.items() if item.source == "simulated" and name not in worn]
        if config.sim.motion == "crossing":
            objects = []  # hands that touch and cross leave no room for them
        for name in objects:
            shape = config.objects[name].shape
            if shape is not None and not (isinstance(shape, BoxShape) and np.allclose(shape.size, OBJECT_SIZE_M)):
                edges = " x ".join(f"{1e3 * edge:g}" for edge in OBJECT_SIZE_M)
                raise ConfigError(
                    f"{rig.path / 'rig.toml'}: objects.{name}: the simulated world has boxes of {edges} mm only; "
                    "correct `shape` or leave it out"
                )
        if config.sim.motion == "touch" and not (hands and objects):
            raise ConfigError(
                f'{rig.path / "rig.toml"}: [sim] motion = "touch" needs a hand and an object; add [objects.NAME] with '
                'source = "simulated"'
            )
        motion = _motion(config.sim, hands, objects)
        return cls(
            config.sim.seed,
            hands,
            config.markers,
            objects,
            motion=motion,
            desk_z_m=config.sim.desk_z_m,
            walker=walker,
        )

    def sample(self, t_s: FloatArray) -> WorldSample:
        """Return the world at times (N,), seconds since its start; any times, in any order."""
        t = np.asarray(t_s, dtype=np.float64).reshape(-1)
        motion = self.motion.sample(t)
        joints: dict[Side, HandJoints] = {}
        markers: dict[str, FloatArray] = {}
        for side, hand in self.hands.items():
            joints[side] = hand.forward(motion.wrists[side], motion.angles[side])
            markers |= hand.marker_positions(joints[side], self.markers)
        worn = {} if self.walker is None else {HEAD: self.walker.head(t)}
        return WorldSample(t, joints, motion.angles, markers, {**motion.objects, **worn})

    def truth(self, t_s: float, t_ns: int, seq: int = 0) -> Truth:
        """Return what is true at `t_s`, seconds since the world's start, as the message with time stamp `t_ns`."""
        sample = self.sample(np.array([t_s]))
        walking = None if self.walker is None else self.walker.truth(t_s, t_ns)
        return Truth(
            t_ns=t_ns,
            seq=seq,
            frame="rig",
            points={name: wire_position(points[0]) for name, points in sample.markers.items()},
            hands={side: _joint_poses(joints) for side, joints in sample.joints.items()},
            objects={name: true_pose(T[0]) for name, T in sample.objects.items()},
            head=None if walking is None else walking.head,
            feet={} if walking is None else walking.feet,
            body={} if walking is None else walking.body,
        )


def _motion(config: SimConfig, hands: Mapping[Side, HandModel], objects: Sequence[str]) -> Motion:
    if config.motion == "still":
        return StillMotion(tuple(hands), objects, config.desk_z_m)
    if config.motion == "crossing":
        return CrossingMotion(config.seed, hands, config.desk_z_m)
    if config.motion == "touch":
        return TouchMotion(hands, objects, config.desk_z_m)
    return ScriptedMotion(config.seed, hands, objects, config.desk_z_m)


def _board_motion(rig: Rig, board: ChessBoard) -> Motion:
    if rig.config.sim.motion == "desk_board":
        return LyingBoard(board, rig.config.sim.desk_z_m)
    truth = simulated_rig_calibration(rig.config.cameras, rig.config.sim.seed).truth.cameras
    cameras = [CameraModel.from_calibration(camera) for camera in truth.values()]
    return BoardMotion(rig.config.sim.seed, cameras, board)


def _joint_poses(joints: HandJoints) -> dict[str, TruePose]:
    positions, quaternions = joints.positions[0].tolist(), quaternion_from_rotation(joints.rotations[0]).tolist()
    return {
        name: TruePose(position=tuple(position), orientation=tuple(quaternion))
        for name, position, quaternion in zip(JOINTS, positions, quaternions, strict=True)
    }
