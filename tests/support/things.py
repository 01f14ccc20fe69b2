"""Everyday things as meshes, made here: no file of somebody else's is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

_rotation: Any = trimesh.transformations.rotation_matrix


def lathe(profile_mm: list[tuple[float, float]]) -> Any:
    """Return what a profile of (radius, height) makes when it is turned about y."""
    turned: Any = trimesh.creation.revolve(np.array(profile_mm) / 1000.0, sections=32)
    turned.apply_transform(_rotation(-np.pi / 2.0, (1.0, 0.0, 0.0)))
    return turned


def mug() -> Any:
    """Return a mug of 80 x 95 mm with a handle along +x, standing on y = 0."""
    body = lathe([(0, 0), (40, 0), (40, 95), (36, 95), (36, 4), (0, 4)])
    handle: Any = trimesh.creation.torus(0.025, 0.005, major_sections=24, minor_sections=10)
    handle.apply_translation((0.045, 0.048, 0.0))
    return trimesh.util.concatenate([body, handle])


def bottle() -> Any:
    """Return a bottle of 72 x 220 mm."""
    return lathe([(0, 0), (35, 0), (36, 140), (30, 170), (14, 190), (13, 220), (0, 220)])


def pear() -> Any:
    """Return a pear of 72 x 94 mm."""
    return lathe([(0, 0), (20, 3), (34, 20), (36, 35), (30, 55), (20, 70), (14, 85), (8, 92), (0, 94)])


def brick() -> Any:
    """Return a box of 100 x 60 x 65 mm."""
    return trimesh.creation.box((0.1, 0.06, 0.065))


def save(mesh: Any, file: Path, scale: float = 1.0) -> Path:
    """Write a mesh as binary glTF, `scale` units a metre, below a node of its own that moves and turns it."""
    T = _rotation(np.pi / 2.0, (0.0, 1.0, 0.0))
    T[:3, 3] = scale * np.array((0.3, 0.2, -0.1))
    scene: Any = trimesh.Scene()
    scaled = mesh.copy()
    scaled.apply_scale(scale)
    scene.add_geometry(scaled, transform=T)
    file.write_bytes(scene.export(file_type="glb"))
    return file
