"""The files of a set of rendered pictures that hold its truth, in the form that its README describes."""

from __future__ import annotations

import csv
import gzip
import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation
from worlds.cameras import CAMERAS, SIZE, Camera, rig_json, shutter_projection
from worlds.hand import (
    ANGLES,
    BONES,
    JOINTS,
    MARKERS,
    bone_poses,
    joint_positions,
    marker_positions,
)
from worlds.skin import Skin
from worlds.world import BOARD, World, board_corners

_STEP_NS: Final = 2_000_000
_BEFORE_NS, _AFTER_NS = 50_000_000, 50_000_000
_SEEN_PX: Final = 0.05
"""Visible area below which a marker counts as not seen at all: one sample of one pixel."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What a picture shows of one marker's paint, in pixels of the distorted picture.

    Attributes:
        area: visible pixels, blurred ones by their share.
        centroid: (u, v) of the visible area; empty when hidden.
        box: x0, y0, x1, y1 edges, pixel i spans i..i+1; empty when hidden.
    """

    area: float
    centroid: tuple[float, ...] = ()
    box: tuple[float, ...] = ()

    @classmethod
    def of(cls, coverage: np.ndarray) -> Seen:
        """Return it of a (480, 640) share of each pixel that the paint covers."""
        area = float(coverage.sum())
        if area < _SEEN_PX:
            return cls(0.0)
        rows, columns = np.nonzero(coverage > min(0.4, 0.9 * float(coverage.max())))
        v, u = (float((coverage.sum(axis=1 - a) * np.arange(n)).sum() / area) for a, n in ((0, SIZE[1]), (1, SIZE[0])))
        box = float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1)
        return cls(area, (u, v), box)


class Facing:
    """Area that each marker's paint would cover with nothing in the way: its camera-facing faces, all convex."""

    def __init__(self, world: World, skin: Skin) -> None:
        """Take the painted faces of the mesh into their bones' frames."""
        rest = bone_poses(world.hand, np.zeros((1, 20)))[0]
        self._faces: list[tuple[int, FloatArray]] = []
        for place, name in enumerate(MARKERS[:5]):
            bone = BONES.index(f"{name}_distal")
            painted = (skin.finger == place) & (skin.beyond[skin.quads].mean(axis=1) > 0.0)
            corners = skin.vertices[skin.quads[painted]]
            self._faces.append((bone, (corners - rest[bone][:3, 3]) @ rest[bone][:3, :3]))
        across, along, thick = world.hand.patch
        plate = np.array([[-1, -1, -1], [-1, 1, -1], [1, 1, -1], [1, -1, -1]]) * np.array([across, along, thick]) / 2
        pose = world.hand.T_hand_patch
        self._faces.append((0, (plate @ pose[:3, :3].T + pose[:3, 3])[None]))

    def area(self, camera: Camera, bones: FloatArray, marker: int) -> float:
        """Return pixels of a marker, an index into `MARKERS`, for bones (16, 4, 4) in the world."""
        bone, faces = self._faces[marker]
        at = faces @ bones[bone, :3, :3].T + bones[bone, :3, 3]
        eye = np.linalg.inv(camera.T_camera_world)[:3, 3]
        normal = np.cross(at[:, 2] - at[:, 0], at[:, 3] - at[:, 1])
        facing = ((eye - at.mean(axis=1)) * normal).sum(axis=1) > 0.0
        p = camera.project(at)
        a, b = p[:, 2] - p[:, 0], p[:, 3] - p[:, 1]
        return float(0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])[facing].sum())


def write_fixed(world: World, skin: Skin, root: Path) -> None:
    """Write all that does not depend on the pictures: rig, hand, times, boards and continuous truth."""
    _write_json(root / "calib.json", rig_json(world.cameras, world.timings))
    _write_json(root / "hand.json", {**world.hand.to_json(), "object": world.grasp.solid.to_json()})
    look = world.look
    about = {
        "seed": world.seed,
        "hand_length_mm": round(world.hand.length_mm, 2),
        "hand_width_mm": round(skin.width_mm, 1),
        "paints": {marker: paint.name for marker, paint in look.paints.items()},
        "desk": look.desk[0],
        "lamps": len(look.lamps),
        "object": world.grasp.solid.kind,
    }
    _write_json(root / "world.json", about)
    for name, timing in world.timings.items():
        for camera in CAMERAS:
            folder = root / name / camera
            folder.mkdir(parents=True, exist_ok=True)
            rows = [f"{frame},{timing.t_ns(camera, frame)}" for frame in range(timing.count)]
            (folder / "timestamps.csv").write_text("\n".join(["frame,t_ns", *rows]) + "\n", encoding="utf-8")
        text = "version = 1\n" + "".join(
            f"[cameras.{camera}]\nexposure_s = {timing.exposure_s:g}\nreadout_s = {timing.readout_s:g}\n"
            for camera in CAMERAS
        )
        (root / name / "recording.toml").write_text(text, encoding="utf-8")
        if name != "C":
            _write_continuous(world, name, root / name / "truth_500hz.csv.gz")
    _write_json(root / "C" / "truth_boards.json", _boards(world))


def write_seen(world: World, skin: Skin, sequence: str, seen: dict[tuple[str, int], list[Seen]], root: Path) -> None:
    """Write `truth_frames.csv` of a sequence, and the boxes of `K`.

    Args:
        world: that the pictures show.
        skin: of its hand.
        sequence: `G1`, `G2` or `K`.
        seen: by camera and frame, markers in the order of `MARKERS`.
        root: of the set.
    """
    timing, to_left = world.timings[sequence], world.cameras["left"].T_camera_world
    facing = Facing(world, skin)
    boxes: dict[str, dict[str, Any]] = {camera: {} for camera in CAMERAS}
    head = "cam,frame,marker,t_ns,u,v,x,y,z,visible_frac,visible_px,vis_u,vis_v,box_x0,box_y0,box_x1,box_y1"
    lines = [head]
    for camera in CAMERAS:
        for frame in range(timing.count):
            for place, marker in enumerate(MARKERS):
                where = partial(_marker_at, world, sequence, place)
                start_ns = timing.t_ns(camera, frame)
                t_ns, (u, v), at = shutter_projection(world.cameras[camera], timing, start_ns, where)
                bones = world.states(sequence, np.array([t_ns])).bones[0]
                whole = facing.area(world.cameras[camera], bones, place)
                part = seen[camera, frame][place]
                x, y, z = to_left[:3, :3] @ at + to_left[:3, 3]
                share = min(part.area / max(whole, 1e-6), 1.0)
                found = [f"{c:.2f}" for c in part.centroid] or [""] * 2
                box = [f"{c:.1f}" for c in part.box] or [""] * 4
                numbers = [f"{c:.3f}" for c in (u, v, x, y, z, share)]
                fields = [camera, frame, marker, round(t_ns), *numbers, f"{part.area:.2f}", *found, *box]
                lines.append(",".join(map(str, fields)))
                if sequence == "K":
                    boxes[camera][marker] = {
                        "box": list(part.box),
                        "centre": [round(float(u), 3), round(float(v), 3)],
                        "visible_centroid": [round(c, 2) for c in part.centroid],
                    }
    (root / sequence / "truth_frames.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    if sequence == "K":
        note = "axis-aligned boxes of the visible painted pixels, x0,y0,x1,y1 in pixels (edges, pixel i spans i..i+1)"
        _write_json(root / "K" / "boxes.json", {"note": note, "cameras": boxes})


def _marker_at(world: World, sequence: str, marker: int, t_ns: float) -> FloatArray:
    return np.asarray(marker_positions(world.hand, world.states(sequence, np.array([t_ns])).bones)[0, marker])


def _write_continuous(world: World, sequence: str, path: Path) -> None:
    timing, to_left = world.timings[sequence], world.cameras["left"].T_camera_world
    t_ns = np.arange(timing.first_ns - _BEFORE_NS, timing.end_ns + _AFTER_NS, _STEP_NS)
    motion = world.states(sequence, t_ns.astype(float))
    bones = to_left @ motion.bones
    points = np.concatenate([marker_positions(world.hand, bones), joint_positions(world.hand, bones)], axis=1)
    head = ["t_ns"] + [f"{name}_{axis}" for name in (*MARKERS, *JOINTS) for axis in "xyz"]
    head += (
        [f"hand_q{c}" for c in "wxyz"] + [f"obj_{c}" for c in ("x", "y", "z", "qw", "qx", "qy", "qz")] + list(ANGLES)
    )
    hand_q = _quaternions((to_left @ motion.T_world_hand)[:, :3, :3])
    things = np.full((len(t_ns), 7), np.nan)
    if motion.T_world_object is not None:
        poses = to_left @ motion.T_world_object
        things = np.concatenate([poses[:, :3, 3], _quaternions(poses[:, :3, :3])], axis=1)
    with gzip.open(path, "wt", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(head)
        for row, t in enumerate(t_ns):
            cells = [f"{c:.3f}" for c in points[row].ravel()] + [f"{c:.6f}" for c in hand_q[row]]
            cells += [f"{c:.3f}" for c in things[row, :3]] + [f"{c:.6f}" for c in things[row, 3:]]
            out.writerow([int(t), *cells, *(f"{c:.2f}" for c in motion.angles[row])])


def _boards(world: World) -> dict[str, Any]:
    columns, rows, square = BOARD
    boards = []
    for frame, pose in enumerate(world.boards):
        corners = board_corners() @ pose[:3, :3].T + pose[:3, 3]
        to_left = world.cameras["left"].T_camera_world @ pose
        pixels = {f"corners_{name}_px": np.round(c.project(corners), 3).tolist() for name, c in world.cameras.items()}
        boards.append(
            {
                "frame": frame,
                "R_board_to_left": to_left[:3, :3].tolist(),
                "t_board_to_left": to_left[:3, 3].tolist(),
                "board_origin": "centre of the corner grid",
                **pixels,
            }
        )
    return {
        "pattern": f"{columns}x{rows} inner corners, {square:.1f} mm",
        "corner_order": f"row-major, {columns} along board x, {rows} along board y",
        "boards": boards,
    }


def _quaternions(rotations: FloatArray) -> FloatArray:
    """Return (N, 4) w, x, y, z of (N, 3, 3), continuous over N, w positive at first."""
    found = np.roll(quaternion_from_rotation(rotations), 1, axis=-1)
    flips = np.where((found[1:] * found[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    first = -1.0 if found[0, 0] < 0.0 else 1.0
    return np.asarray(found * np.cumprod([first, *flips])[:, None])


def _write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1), encoding="utf-8")
