"""The simulated world: what is where at any moment, from seed and time alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from rhot.anatomy.hand import MOVING, HandJoints, HandModel
from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.messages import BoxShape, Side, TruePose, Truth
from rhot.messages.base import wire_position
from rhot.rig.config import MarkerConfig, SimConfig
from rhot.rig.folder import Rig
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.walker.world import WalkerWorld
from rhot_sim.world.board import BoardMotion, ChessBoard, LyingBoard
from rhot_sim.world.motion import (
    OBJECT_SIZE_M,
    PALM_FORWARD_M,
    Motion,
    MotionSample,
    StillMotion,
    bump,
    evaluate_spline,
    home_x_m,
    true_pose,
    wrist_poses,
)
from rhot_sim.world.script import EASE_DEG, GESTURE_KNOTS, GESTURES, KNOT_S, ScriptedMotion, seeded
from rhot_sim.world.touching import TouchMotion

# Two hands that touch and cross, over and over: what tells a tracker's hands apart, or mixes them up.
#
# Time is cut into cycles. In each, the hands turn their fingertips towards each other and touch, tap a few times,
# part, cross one above the other, stay there while their fingers move, and go back. Where, how far, how fast and
# which hand is above follow from seed and cycle alone.

CYCLE_S: Final = 12.0
_CYCLE_KNOTS: Final = round(CYCLE_S / KNOT_S)
_STREAM: Final = 5
_SIDES: Final[tuple[Side, Side]] = ("right", "left")
_HEIGHT_M: Final = 0.13
"""Of the hands over the desk; the one that crosses above is 85 to 110 mm higher."""
_TOUCH_S: Final = (0.5, 4.6)
_CROSS_S: Final = (5.0, 11.4)
_LIFT_S: Final = (4.7, 11.7)
_LIFT_RAMP_S: Final = 0.6
_YAW_RAD: Final = np.radians(55.0)
"""How far hands turn towards each other to touch with the fingertips."""
_TAP_HZ: Final = (0.4, 0.9)
_TAP_M: Final = 0.02
_TOUCHING: Final = (1, 2)
"""Fingers that touch: the index fingers, or the middle fingers."""


class CrossingMotion:
    """Both hands as a function of (seed, time); before time 0 everything stands still.

    Args:
        seed: chooses everything.
        hands: right and left; their limits are kept.
        desk_z_m: distance of the desk from the reference camera.

    Raises:
        ConfigError: a hand is missing.
    """

    def __init__(self, seed: int, hands: Mapping[Side, HandModel], desk_z_m: float = 0.95) -> None:
        if set(hands) != set(_SIDES):
            raise ConfigError('motion = "crossing" needs both hands; give markers to the right and to the left one')
        self._seed = seed
        self._hands = dict(hands)
        self._desk_z_m = desk_z_m
        # Tables of pure functions: dropping or keeping an entry changes no result.
        self._tables: Callable[[int], dict[Side, FloatArray]] = lru_cache(maxsize=8)(self._table)

    def sample(self, t_s: FloatArray) -> MotionSample:
        """Return the motion at times (N,), seconds since the world's start."""
        t = np.maximum(np.asarray(t_s, dtype=np.float64), 0.0)
        wrists: dict[Side, FloatArray] = {}
        angles: dict[Side, FloatArray] = {}
        for side in _SIDES:

            def control(knot: int, side: Side = side) -> FloatArray:
                cycle, place = divmod(max(knot, 0), _CYCLE_KNOTS)
                row: FloatArray = self._tables(cycle)[side][place]
                return row

            curve = evaluate_spline(t, KNOT_S, control)
            wrists[side] = wrist_poses(curve[:, :6])
            angles[side] = curve[:, 6:].reshape(-1, 5, 4)
        return MotionSample(wrists, angles, {})

    def _table(self, cycle: int) -> dict[Side, FloatArray]:
        """Return the control values (K, 26) of both hands in one cycle: placement, see `wrist_poses`, and angles."""
        rng = seeded(self._seed, _STREAM, cycle)
        t: FloatArray = np.arange(_CYCLE_KNOTS, dtype=np.float64) * KNOT_S
        finger = int(rng.choice(_TOUCHING))
        above = _SIDES[int(rng.integers(2))]
        # A hand is 30 mm thick, and its bent fingers reach 50 mm below it.
        lift_m = rng.uniform(0.085, 0.11)
        share = rng.uniform(0.4, 1.1)
        meeting = np.array([rng.uniform(-0.05, 0.05), rng.uniform(-0.01, 0.05), self._desk_z_m - _HEIGHT_M])
        taps = 0.5 - 0.5 * np.cos(2.0 * np.pi * rng.uniform(*_TAP_HZ) * (t - _TOUCH_S[0]))
        touching, crossing = bump(t, *_TOUCH_S, rng.uniform(0.7, 1.2)), bump(t, *_CROSS_S, rng.uniform(0.8, 1.8))
        lifted = bump(t, *_LIFT_S, _LIFT_RAMP_S)
        tables: dict[Side, FloatArray] = {}
        for side in _SIDES:
            sign = -1.0 if side == "right" else 1.0
            home = np.array([home_x_m(side, _SIDES), -0.02, self._desk_z_m - _HEIGHT_M, 0.0, 0.0, 0.0])
            over = np.zeros(6)
            over[0] = -2.0 * share * home[0]
            over[1] = rng.uniform(-0.03, 0.03)
            over[3:] = np.radians(rng.uniform(-12.0, 12.0, 3))
            tap = np.zeros(6)
            tap[0] = sign * _TAP_M
            placement = home + touching[:, None] * (self._touch(side, finger, meeting) - home + taps[:, None] * tap)
            placement += crossing[:, None] * over
            placement[:, 2] -= lifted * lift_m * (side == above)
            placement += _tremor(t, rng)
            fingers = np.tile(EASE_DEG, (_CYCLE_KNOTS, 1, 1))
            for part in range(1, _CYCLE_KNOTS // GESTURE_KNOTS):
                rows = slice(part * GESTURE_KNOTS, (part + 1) * GESTURE_KNOTS)
                gesture = GESTURES[int(rng.integers(len(GESTURES)))]
                fingers[rows] = gesture(t[:GESTURE_KNOTS], rng)[0]
            tables[side] = np.hstack([placement, self._angles(side, fingers).reshape(-1, 20)])
        return tables

    def _angles(self, side: Side, fingers_deg: FloatArray) -> FloatArray:
        hand = self._hands[side]
        angles = np.empty((*fingers_deg.shape[:2], 4))
        angles[..., :3] = np.radians(fingers_deg)
        angles[..., 3] = hand.coupling * angles[..., 2]
        return hand.clamp(angles)

    def _touch(self, side: Side, finger: int, meeting: FloatArray) -> FloatArray:
        """Return the placement (6,) at which a fingertip's skin meets a point (3,) from its side, rig frame, metres."""
        hand = self._hands[side]
        tip = hand.forward_local(self._angles(side, EASE_DEG[None])[0]).positions[MOVING[finger, 3]]
        radius_m = float(hand.radii[MOVING[finger, 3]])
        placement = np.zeros(6)
        placement[3] = _YAW_RAD * (-1.0 if side == "right" else 1.0)
        R = wrist_poses(placement[None])[0, :3, :3]
        sign = -1.0 if side == "right" else 1.0
        beside = meeting + np.array([sign * radius_m, 0.0, 0.0])
        placement[:3] = beside - R @ tip - PALM_FORWARD_M * R[:, 2]
        return placement


def _tremor(t: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the small movement of a hand in the air, (K, 6), metres and radians; none at a cycle's ends."""
    reach = np.array([0.004, 0.004, 0.004, np.radians(2.0), np.radians(2.0), np.radians(2.0)])
    rate_hz, phase = rng.uniform(0.2, 0.6, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
    envelope = bump(t, 0.1, CYCLE_S - 0.2, 0.6)
    tremor: FloatArray = reach * np.sin(2.0 * np.pi * rate_hz * t[:, None] + phase) * envelope[:, None]
    return tremor


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
    return BoardMotion(rig.config.sim.seed, list(true_cameras(rig).values()), board)


def _joint_poses(joints: HandJoints) -> dict[str, TruePose]:
    positions, quaternions = joints.positions[0].tolist(), quaternion_from_rotation(joints.rotations[0]).tolist()
    return {
        name: TruePose(position=tuple(position), orientation=tuple(quaternion))
        for name, position, quaternion in zip(JOINTS, positions, quaternions, strict=True)
    }
