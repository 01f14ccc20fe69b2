"""Surfaces of objects from glTF files, and the planes that fingers meet in their place."""

from __future__ import annotations

import json
import struct
import tracemalloc
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import things
import trimesh

from rhot import object_mesh
from rhot.errors import ConfigError
from rhot.geometry.hull import hull_planes, hull_surface, plane_distance
from rhot.messages import MeshShape, ObjectPose, decode, encode
from rhot.object_mesh import mesh_file

FINGERTIP_M = 0.008
nearest: Any = trimesh.proximity.closest_point_naive


def test_a_file_is_read_in_metres_about_its_middle_with_all_that_its_nodes_do(tmp_path: Path) -> None:
    read = mesh_file(things.save(things.mug(), tmp_path / "mug.glb", scale=1000.0), scale=0.001)
    # The node's quarter turn about y brings the handle, which was at +x, to −z.
    assert read.shape.size == pytest.approx((0.08, 0.095, 0.115), abs=1e-4)
    assert np.abs(read.corners.min(axis=0) + read.corners.max(axis=0)).max() < 1e-9
    assert np.allclose(read.middle, (300.0, 247.5, -117.5), atol=0.1)
    assert read.corners[np.abs(read.corners[:, 1]) < 0.02][:, 2].min() == pytest.approx(-0.0575, abs=1e-4)
    assert (read.content, read.shape.file) == ((tmp_path / "mug.glb").read_bytes(), "mug.glb")


@pytest.mark.parametrize(
    ("make", "median_mm", "p95_mm"),
    [(things.bottle, 0.4, 5.2), (things.pear, 0.9, 3.0), (things.brick, 0.01, 0.01)],
)
def test_planes_stand_where_a_fingertip_meets_the_surface(
    make: Callable[[], Any], median_mm: float, p95_mm: float
) -> None:
    mesh = make()
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    planes = hull_planes(np.array(mesh.vertices), 64)
    assert 4 <= len(planes) <= 64
    assert plane_distance(planes, np.array(mesh.vertices))[0].max() < 1e-9, "nothing of the mesh stands out"
    surface, faces = trimesh.sample.sample_surface(mesh, 300, seed=1)
    at = surface + FINGERTIP_M * mesh.face_normals[faces]
    _, true_m, _ = nearest(mesh, at)
    fits = true_m > 0.95 * FINGERTIP_M
    off_mm = 1e3 * np.abs(plane_distance(planes, at)[0] - true_m)[fits]
    assert np.median(off_mm) < median_mm
    assert np.quantile(off_mm, 0.95) < p95_mm
    half = 0.5 * np.array(mesh.extents)
    box_mm = 1e3 * np.abs(np.linalg.norm(np.maximum(np.abs(at) - half, 0.0), axis=1) - true_m)[fits]
    assert np.median(off_mm) < 0.5 * np.median(box_mm) + 0.01, "and much nearer than those of the bounding box"


def test_distances_are_those_to_the_body_between_the_planes() -> None:
    pear = things.pear()
    planes = hull_planes(np.array(pear.vertices - pear.bounds.mean(axis=0)), 64)
    corners, triangles = hull_surface(planes)
    hull = trimesh.Trimesh(corners, triangles, process=False)
    assert hull.is_watertight
    assert hull.volume > 0.0, "triangles face outwards"
    points = np.random.default_rng(3).normal(0.0, 0.03, (300, 3))
    distance, out = plane_distance(planes, points)
    _, exact, _ = nearest(hull, points)
    outside, near = distance > 0.0, (distance > 0.0) & (distance < 0.02)
    assert near.sum() > 50
    assert (distance[outside] <= exact[outside] + 1e-9).all()
    assert (exact - distance)[near].max() < 3e-4, "corners are the only place where it is not exact"
    assert np.allclose(distance[~outside], -exact[~outside], atol=1e-9)
    assert np.allclose(np.linalg.norm(out, axis=1), 1.0)
    assert np.allclose(plane_distance(planes, points + 1e-6 * out)[0], distance + 1e-6, atol=1e-8)


def test_a_message_carries_it(tmp_path: Path) -> None:
    shape = mesh_file(things.save(things.mug(), tmp_path / "mug.glb")).shape
    pose = ObjectPose(t_ns=1, frame="rig", position=(0, 0, 1), orientation=(0, 0, 0, 1), state="measured", shape=shape)
    content = encode(pose)
    assert decode(content, ObjectPose).shape == shape
    assert len(content) < 3000
    with pytest.raises(ValueError, match="its normal must have length 1"):
        MeshShape(file="mug.glb", size=shape.size, planes=(*shape.planes, (0.0, 0.0, 0.0, 0.1)))


def glb_without_content() -> bytes:
    text = b'{"asset":{"version":"2.0"},"buffers":[{"byteLength":12,"uri":"file:///etc/hostname"}],"meshes":[]}  '
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, r"cup\.glb: cannot be read \(No such file.*relative to the rig folder"),
        (b"", r"is no glTF in its binary form .*export it as \.glb"),
        (b"solid cup\nendsolid", r"is no glTF in its binary form"),
        (glb_without_content(), r"cup\.glb: (is no glTF|has 0 triangles)"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path: Path, content: bytes | None, says: str) -> None:
    if content is not None:
        (tmp_path / "cup.glb").write_bytes(content)
    with pytest.raises(ConfigError, match=says):
        mesh_file(tmp_path / "cup.glb")


def test_what_is_too_big_or_flat_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = things.save(things.brick(), tmp_path / "cup.glb")
    with pytest.raises(ConfigError, match=r"would be 6.5e\+04 x 6e\+04 x 1e\+05 mm.*scale = 0.001  for millimetres"):
        mesh_file(file, scale=1000.0)
    monkeypatch.setattr(object_mesh, "MOST_TRIANGLES", 11)
    with pytest.raises(ConfigError, match=r"has 12 triangles, 1 to 11 are possible.*Decimate"):
        mesh_file(file, scale=1.01)
    monkeypatch.setattr(object_mesh, "MOST_BYTES", 100)
    with pytest.raises(ConfigError, match=r"has 0\.0 MB, at most 0\.0001 MB"):
        mesh_file(file, scale=1.02)
    monkeypatch.undo()
    flat = trimesh.Trimesh([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)], [(0, 1, 2)])
    with pytest.raises(ConfigError, match=r"its corners lie in one plane .*needs a thickness"):
        mesh_file(things.save(flat, tmp_path / "flat.glb"))


def glb(tables: Mapping[str, object], data: bytes = b"") -> bytes:
    text = json.dumps(tables).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    if data:
        chunks += struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.mark.parametrize("kind", ["accessor", "instances", "nodes"])
def test_a_small_file_that_unpacks_to_gigabytes_is_refused(tmp_path: Path, kind: str) -> None:
    count = 500_000_000 if kind == "accessor" else 9_000
    tables = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}] * {"accessor": 1, "instances": 1_000, "nodes": 100_000}[kind],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "count": count, "type": "VEC3"}],
    }
    file = tmp_path / "bomb.glb"
    file.write_bytes(glb(tables))
    tracemalloc.start()
    with pytest.raises(ConfigError, match=r"bomb\.glb: has .* possible.*Decimate"):
        mesh_file(file)
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()


def test_triangles_of_corners_that_are_not_there_are_refused(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], np.float32)
    triangles = np.array([[0, 1, 2], [0, 1, 3], [1, 2, 40]], np.uint16)
    data = corners.tobytes() + triangles.tobytes()
    tables = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 9, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 18},
        ],
        "buffers": [{"byteLength": len(data)}],
    }
    (tmp_path / "cup.glb").write_bytes(glb(tables, data))
    with pytest.raises(ConfigError, match=r"cup\.glb"):
        mesh_file(tmp_path / "cup.glb")
