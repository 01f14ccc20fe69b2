"""Grasps of worlds through the tracker, without pictures: `make grasps`.

Of each world only the hand, the object and the motion are used. What two random cameras would find of the paint is
computed (`rhot_bench.motion.painted`), fingers, palm and object hide what lies behind them, and the tracker gets a hand
measured by a ruler and the object's exact pose. Errors are those of the fingertips' joints while the object is held.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, Self

import numpy as np
import trimesh
from rich.console import Console
from rich.progress import track

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rigid, rotation_from_vector
from rhot.messages import BoxShape, CylinderShape, HandPose, ObjectPose, SphereShape
from rhot.messages.base import wire_position, wire_quaternion
from rhot.messages.tracked import ObjectShape
from rhot.object_mesh import known_shape
from rhot.offline import MessagesBeside, OfflineTracker
from rhot.rig import HandFile, load_rig
from rhot.rig.folder import RIG_FILE
from rhot_bench.motion.painted import MARKERS, START_NS, Capsules, Flesh, Surface, Truth, cap_surface, patch_surface
from rhot_bench.motion.recordings import HandMotion, HandShape
from rhot_bench.motion.rigs import Family, draw_rig, write_rig
from rhot_bench.motion.tracks import camera_sights, ruler_measures
from worlds.contact import Solid as Thing
from worlds.hand import Hand, joint_positions
from worlds.motion import States
from worlds.skin import with_patch
from worlds.world import KINDS, Grasp, is_possible, random_grasp, random_hand

_LASTING_S: Final = 2.4
_FAMILY: Final = Family(
    rate_hz=(28.0, 65.0), cameras=((2, 1.0),), lost=(0.0, 0.03), distance_m=(0.6, 0.9), noise_px=(0.05, 0.2)
)
_DOWN: Final = np.diag([1.0, -1.0, -1.0])
"""From the world's axes (z up from the desk) to a rig's whose cameras look down at it."""
_WRIST: Final = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
"""From the hand frame of `worlds.hand` to the wrist frame of `rhot.anatomy.hand`."""
_BONES: Final = (("metacarpal", "proximal", "distal"), *((("proximal", "intermediate", "distal"),) * 4))


class _Motion(HandMotion):
    """The hand of a grasp in the rig frame, in place of a recorded one."""

    def __init__(self, hand: Hand, grasp: Grasp, T_rig_world: FloatArray) -> None:
        self._hand, self._grasp, self._T = hand, grasp, T_rig_world
        self.seconds = _LASTING_S
        self.tip_radius_m = 1e-3 * np.array([hand.radii[finger][3] for finger in FINGERS])

    def states(self, t_s: FloatArray) -> States:
        """Return hand and object at times (N,), world frame, millimetres."""
        return self._grasp.states(self._hand, np.asarray(t_s, dtype=np.float64))

    def object_at(self, t_s: FloatArray) -> FloatArray:
        """Return the object's poses (N, 4, 4), rig frame, metres."""
        poses = self.states(t_s).T_world_object
        assert poses is not None
        placed = poses.copy()
        placed[:, :3, 3] *= 1e-3
        found: FloatArray = self._T @ placed
        return found

    def at(self, t_s: FloatArray) -> HandShape:
        """Return the hand at times (N,)."""
        states = self.states(t_s)
        joints = 1e-3 * joint_positions(self._hand, states.bones) @ self._T[:3, :3].T + self._T[:3, 3]
        R = self._T[:3, :3] @ states.T_world_hand[:, :3, :3] @ _WRIST.T
        chain = joints[:, 1:].reshape(-1, 5, 4, 3)
        named = np.full((len(joints), len(JOINTS), 3), np.nan)
        named[:, JOINTS.index("wrist")] = joints[:, 0]
        distal = chain[:, :, 3] - chain[:, :, 2]
        distal /= np.linalg.norm(distal, axis=-1, keepdims=True)
        tips = chain[:, :, 3] - self.tip_radius_m[:, None] * distal
        for number, finger in enumerate(FINGERS):
            for place, bone in enumerate(_BONES[number]):
                named[:, JOINTS.index(f"{finger}_{bone}")] = chain[:, number, place]
            named[:, JOINTS.index(f"{finger}_tip")] = tips[:, number]
        return _HeldShape(joints[:, 0], R, chain, named, self.object_at(t_s))


@dataclass(frozen=True, slots=True)
class _HeldShape(HandShape):
    """N hands, and where the object is (N, 4, 4), metres."""

    T_rig_object: FloatArray


@dataclass(frozen=True, slots=True)
class _HeldFlesh(Flesh):
    """Flesh and the object beside it.

    Attributes:
        bars: capsules of the object, see `bars_of`.
    """

    bars: tuple[FloatArray, FloatArray, FloatArray]

    @classmethod
    def of(cls, hand: Hand, thing: Thing) -> Self:
        """Return it of a hand and an object."""
        radii = 1e-3 * np.array([hand.radii[finger] for finger in FINGERS])
        bones = 0.5 * (radii[:, :3] + radii[:, 1:])
        bones[:, 2] = radii[:, 3]
        return cls(bones, radii[1:, 0] + 0.002, np.zeros(3), np.zeros(3), 0.0, bars_of(thing))

    def capsules(self, hand: HandShape) -> Capsules:
        """Return all that can hide a marker."""
        flesh = Flesh.capsules(self, hand)
        assert isinstance(hand, _HeldShape)
        begin, end, radius = self.bars
        R, p = hand.T_rig_object[:, None, :3, :3], hand.T_rig_object[:, None, :3, 3]
        return Capsules(
            np.concatenate([flesh.begin, (R @ begin[..., None])[..., 0] + p], axis=1),
            np.concatenate([flesh.end, (R @ end[..., None])[..., 0] + p], axis=1),
            np.concatenate([flesh.radius, radius]),
            np.concatenate([flesh.finger, np.full(len(radius), -1.0)]),
        )


def bars_of(thing: Thing) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return begins (K, 3), ends (K, 3) and radii (K,) of capsules, metres, that fill an object for a camera's eye."""
    x, y, z = 1e-3 * thing.half
    rows: list[tuple[Sequence[float], Sequence[float], float]] = []
    if thing.kind == "ball":
        rows = [((0, 0, 0), (0, 0, 0), x)]
    elif thing.kind == "ring":
        around = np.linspace(0.0, 2.0 * np.pi, 17)
        at = (x - y) * np.stack([np.cos(around), 0.0 * around, np.sin(around)], axis=1)
        rows = [(a, b, y) for a, b in zip(at[:-1].tolist(), at[1:].tolist(), strict=True)]
    elif thing.kind == "handle":
        a, b = (y - x, 0.0, z - y), (x - y, 0.0, z - y)
        rows = [(a, b, y), ((y - x, 0.0, y - z), a, y), ((x - y, 0.0, y - z), b, y)]
    else:
        # A core of upright bars, and thin ones where it leaves the flat top and the edges.
        thin, core_m = 0.005, min(x, y)
        middles = [np.linspace(core_m - half, half - core_m, int(np.ceil(half / core_m))).tolist() for half in (x, y)]
        rows = [((s, t, core_m - z), (s, t, z - core_m), core_m) for s in middles[0] for t in middles[1]]
        across = np.arange(thin - x, x, 1.5 * thin)
        is_round = thing.kind == "cylinder"
        reach = np.sqrt(np.maximum((x - thin) ** 2 - across**2, 0.0)) if is_round else np.full(len(across), y - thin)
        rows += [((s, -t, z - thin), (s, t, z - thin), thin) for s, t in zip(across, reach, strict=True)]
        corners = [] if is_round else [(s * (x - thin), t * (y - thin)) for s in (-1, 1) for t in (-1, 1)]
        rows += [((s, t, thin - z), (s, t, z - thin), thin) for s, t in corners]
    begin, end, radius = zip(*rows, strict=True)
    return np.array(begin, dtype=np.float64), np.array(end, dtype=np.float64), np.array(radius, dtype=np.float64)


def write_thing(folder: Path, thing: Thing) -> ObjectShape:
    """Return the shape that the tracker is told; rings and handles become a glTF file of the rig folder."""
    x, y, z = (1e-3 * thing.half).tolist()
    if thing.kind == "ball":
        return SphereShape(radius=x)
    if thing.kind == "cylinder":
        return CylinderShape(radius=x, height=2.0 * z)
    if thing.kind == "box":
        return BoxShape(size=(2.0 * x, 2.0 * y, 2.0 * z))
    corners, quads = thing.surface()
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    trimesh.Trimesh(1e-3 * corners, triangles).export(folder / "thing.glb")
    (folder / "still.csv").write_text("t_ns,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n", encoding="utf-8")
    with (folder / RIG_FILE).open("a", encoding="utf-8") as file:
        file.write(
            '\n[objects.thing]\nsource = "recorded"\npath = "still.csv"\n'
            'shape = { kind = "mesh", file = "thing.glb" }\n'
        )
    found = known_shape(load_rig(folder), "thing")
    assert found is not None
    return found


def draw_grasp(rng: np.random.Generator, kind: str) -> tuple[Hand, Grasp]:
    """Draw a hand that can grasp an object of a kind, and how it does."""
    while True:
        hand = with_patch(random_hand(rng), rng)
        for _ in range(12):
            grasp = random_grasp(rng, hand, _LASTING_S, kind)
            if grasp is not None and is_possible(hand, grasp, _LASTING_S):
                return hand, grasp


@dataclass(frozen=True, slots=True)
class Errors:
    """How far fingertips are off while an object is held, metres.

    Attributes:
        kind: of the object.
        hidden: (N,) of tips that no camera sees.
        sigma: (N,) as stated of them.
        one: (M,) of tips that one camera sees.
        joints: (K,) mean over 21 joints.
    """

    kind: str
    hidden: FloatArray
    sigma: FloatArray
    one: FloatArray
    joints: FloatArray


def run(seed: int, *, known: bool, smooth: bool) -> Errors:
    """Track one grasp; seeds in turn grasp each of `KINDS`, two by two, so that either half has all."""
    rng = np.random.default_rng([77, seed])
    kind = KINDS[seed // 2 % len(KINDS)]
    hand, grasp = draw_grasp(rng, kind)
    draw = draw_rig(seed, _FAMILY)
    lenses = np.mean([camera.center for camera in draw.true.values()], axis=0)
    tilt = rotation_from_vector(np.radians(rng.uniform(-12.0, 12.0, 3)))
    motion = _Motion(hand, grasp, rigid(tilt @ _DOWN, np.array([lenses[0], lenses[1], draw.distance_m + 0.06])))
    with tempfile.TemporaryDirectory(prefix="rhot-grasp-") as name:
        folder = Path(name)
        surfaces, patch_m = painted(hand)
        write_rig(draw, folder, by_ruler(rng, hand), patch_m)
        shape = write_thing(folder, grasp.solid) if known else None
        rig = load_rig(folder)
        gates = [rig.config.markers[marker].min_area_px for marker in MARKERS]
        flesh = _HeldFlesh.of(hand, grasp.solid)
        sights = [
            camera_sights(stream, number, camera, draw, motion, surfaces, flesh, gates, "caps")
            for number, (camera, stream) in enumerate(zip(draw.true, rng.spawn(len(draw.true)), strict=True))
        ]
        frames = sorted((frame for each in sights for frame in each.frames), key=lambda frame: frame.t_ns)
        objects = MessagesBeside([] if shape is None else object_poses(motion, shape))
        messages = OfflineTracker(rig, objects=objects, smooth=smooth).run(iter(frames))
        poses = [message for _, message in messages if isinstance(message, HandPose)]
    truth = Truth(motion, surfaces, *zip(*((each.t_ns, each.visible, each.whole) for each in sights), strict=True))
    return _errors(kind, poses, truth, grasp.held_s)


def painted(hand: Hand) -> tuple[list[Surface], tuple[float, float]]:
    """Return the paint of a hand in the order of `MARKERS`, and the patch's size, metres."""
    caps = [
        cap_surface(1e-3 * hand.painted[finger], 1e-3 * hand.radii[finger][3], 1.08e-3 * hand.radii[finger][3])
        for finger in FINGERS
    ]
    patch_m = 1e-3 * hand.patch[0], 1e-3 * hand.patch[1]
    flat, T = patch_surface(patch_m), hand.T_hand_patch
    R, middle = _WRIST @ T[:3, :3] @ _WRIST.T, 1e-3 * _WRIST @ T[:3, 3]
    return [*caps, Surface(flat.points @ R.T + middle, flat.normals @ R.T, flat.areas, middle)], patch_m


def by_ruler(rng: np.random.Generator, hand: Hand) -> HandFile:
    """Return what two measures by a ruler tell of a hand."""
    across = float(np.linalg.norm(hand.mcp["index"] - hand.mcp["little"]))
    width_m = 1e-3 * (across + hand.radii["index"][0] + hand.radii["little"][0])
    return ruler_measures(1e-3 * hand.length_mm + float(rng.normal(0.0, 0.0015)), width_m)


def object_poses(motion: _Motion, shape: ObjectShape) -> Iterable[tuple[str, ObjectPose]]:
    """Yield the true poses of the object, 100 a second, as a tracker on it would tell them."""
    t_s = np.arange(0.0, _LASTING_S, 0.01)
    for at, T in zip(t_s.tolist(), motion.object_at(t_s), strict=True):
        yield (
            "rhot/object/thing",
            ObjectPose(
                t_ns=START_NS + round(1e9 * at),
                frame="rig",
                position=wire_position(T[:3, 3]),
                orientation=wire_quaternion(quaternion_from_rotation(T[:3, :3])),
                state="measured",
                shape=shape,
            ),
        )


def _errors(kind: str, poses: list[HandPose], truth: Truth, held_s: tuple[float, float]) -> Errors:
    t_ns = np.array([pose.t_ns for pose in poses], dtype=np.int64)
    t_s = truth.seconds(t_ns)
    held = ((t_s > held_s[0]) & (t_s < held_s[1]))[:, None]
    found = np.array([[pose.joints[joint].position for joint in JOINTS] for pose in poses])
    apart = np.linalg.norm(found - truth.joints(t_ns), axis=2)
    sigma = np.array([[pose.sigma.get(joint, np.nan) for joint in JOINTS] for pose in poses])
    tips = [JOINTS.index(f"{finger}_tip") for finger in FINGERS]
    hidden = held & (truth.hidden_s(t_ns)[:, :5] > 0.0)
    one = held & (truth.views(t_ns)[:, :5] == 1)
    return Errors(
        kind, apart[:, tips][hidden], sigma[:, tips][hidden], apart[:, tips][one], np.nanmean(apart[held[:, 0]], axis=1)
    )


def main() -> None:
    """Track grasps of several kinds and print how far fingers are off: hidden, in one view, and all joints."""
    parser = argparse.ArgumentParser(prog="python -m worlds.grasps", description=main.__doc__)
    parser.add_argument("--grasps", type=int, default=36, metavar="N", help="of one half; default 36")
    parser.add_argument(
        "--half", choices=("develop", "held-back"), default="develop", help="nothing is tuned to the held-back half"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="grasps at the same time; default 1")
    chosen = parser.parse_args()
    seeds = range(chosen.half == "held-back", 2 * chosen.grasps, 2)
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"{chosen.grasps} grasps, {chosen.half}: median / 95 % of the fingertips' joint, mm")
    with ProcessPoolExecutor(chosen.jobs) as workers:
        for known, smooth in ((True, False), (True, True), (False, False)):
            title = f"object {'known' if known else 'unknown'}, {'smoothed' if smooth else 'live'}"
            rows = list(track(workers.map(partial(run, known=known, smooth=smooth), seeds), title, len(seeds)))
            console.print(f"\n{title:24} hidden            one view          21 joints   within 1, 2 sigma, %")
            for kind in (*KINDS, "all"):
                console.print(_line(kind, [row for row in rows if kind in (row.kind, "all")]))


def _line(kind: str, rows: list[Errors]) -> str:
    if not rows:
        return f"{kind:24} -"
    hidden, sigma, one, joints = (np.concatenate([getattr(row, name) for row in rows]) for name in _COLUMNS)
    parts = [
        f"{1e3 * np.median(each):5.1f} / {1e3 * np.percentile(each, 95):5.1f}     " if len(each) else " " * 18
        for each in (hidden, one)
    ]
    within = (
        f"{100 * np.mean(hidden < sigma):3.0f}, {100 * np.mean(hidden < 2.0 * sigma):3.0f} %" if len(hidden) else ""
    )
    return f"{kind:24} {''.join(parts)}{1e3 * joints.mean():5.1f}       {within}"


_COLUMNS: Final = ("hidden", "sigma", "one", "joints")


if __name__ == "__main__":
    main()
