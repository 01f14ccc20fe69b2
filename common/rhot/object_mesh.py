"""Surfaces of objects, from the glTF files that `rig.toml` names, and the shapes that follow from them."""

from __future__ import annotations

import io
import logging
import struct
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.geometry.distance_grid import DistanceGrid, distance_grid
from rhot.geometry.hull import hull_planes
from rhot.messages import MeshShape, ObjectShape
from rhot.messages.tracked import MOST_PLANES
from rhot.rig import Rig
from rhot.rig.kept_file import file_stamp
from rhot.rig.sections import MeshConfig
from rhot.text import SparingLog, parse_json

logger = logging.getLogger(__name__)

MOST_BYTES: Final = 20_000_000
"""A browser fetches it, perhaps over Wi-Fi."""
MOST_TRIANGLES: Final = 100_000
"""What a headset, or a processor in place of a graphics card, still draws beside a hand."""
_SIZES_M: Final = (0.005, 3.0)
"""Between a button and a ladder: a larger or smaller thing is in another unit."""
_MOST_NODES: Final = 10_000
_MOST_NUMBERS: Final = 10 * MOST_TRIANGLES
_KEPT: Final = 8
_said = SparingLog(60.0)


@dataclass(frozen=True)
class ObjectMesh:
    """A surface, object axes: the file's, about the middle of its bounding box.

    Attributes:
        content: the file.
        corners: (N, 3) metres.
        triangles: (M, 3) indices of corners, counter-clockwise from outside.
        middle: (3,) of the bounding box, units of the file.
        scale: metres per unit of the file.
        shape: what fingers meet.
    """

    content: bytes
    corners: FloatArray
    triangles: NDArray[np.int64]
    middle: FloatArray
    scale: float
    shape: MeshShape

    @cached_property
    def distances(self) -> DistanceGrid:
        """Signed distances from the surface, object axes; half a second's work the first time."""
        return distance_grid(self.corners, self.triangles)


def object_shape(rig: Rig, name: str) -> ObjectShape | None:
    """Return the shape of an object of `rig.toml`; None where it has none.

    Raises:
        ConfigError: its file cannot be used.
    """
    config = rig.config.objects[name].shape
    if not isinstance(config, MeshConfig):
        return config
    return configured_mesh(rig, config).shape


def known_shape(rig: Rig, name: str) -> ObjectShape | None:
    """Return the shape of an object; None where it has none, and, with a line in the log, where its file is no use."""
    config = rig.config.objects[name].shape
    if not isinstance(config, MeshConfig):
        return config
    mesh = known_mesh(rig, name)
    return None if mesh is None else mesh.shape


def known_mesh(rig: Rig, name: str) -> ObjectMesh | None:
    """Return the surface of an object; None, with a line in the log, where its file cannot be used here."""
    thing = rig.config.objects.get(name)
    if thing is None or not isinstance(thing.shape, MeshConfig):
        return None
    try:
        return configured_mesh(rig, thing.shape)
    except ConfigError as error:
        if _said.due(str(error)) is not None:
            logger.warning("the surface of %s is not used: %s", name, error)
        return None


def configured_mesh(rig: Rig, config: MeshConfig) -> ObjectMesh:
    """Return the surface that `rig.toml` names.

    Raises:
        ConfigError: its file cannot be used.
    """
    return mesh_file(rig.resolve(config.file), config.scale)


def mesh_file(file: Path, scale: float = 1.0) -> ObjectMesh:
    """Read a surface; a file that has not changed is read once.

    Args:
        file: binary glTF, `.glb`.
        scale: metres per unit of the file.

    Raises:
        ConfigError: it is missing, is no such file, is too big or flat; says what to do.
    """
    return _read(file, scale, file_stamp(file))


@lru_cache(maxsize=_KEPT)
def _read(file: Path, scale: float, _stamp: Any) -> ObjectMesh:
    try:
        size = file.stat().st_size
        content = b"" if size > MOST_BYTES else file.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"{file}: cannot be read ({error.strerror or error}); `file` of a shape is relative to the rig folder"
        ) from error
    if size > MOST_BYTES:
        raise ConfigError(
            f"{file}: has {size / 1e6:.1f} MB, at most {MOST_BYTES / 1e6:g} MB are possible; export it with smaller "
            "pictures"
        )
    corners, triangles = _triangles(file, content)
    if not len(triangles):
        raise ConfigError(f"{file}: draws no triangles; export a surface")
    _require_drawable(file, len(triangles))
    low, high = corners.min(axis=0), corners.max(axis=0)
    size_m = scale * (high - low)
    told = " x ".join(f"{1e3 * edge:.4g}" for edge in size_m)
    if not _SIZES_M[0] <= size_m.max() <= _SIZES_M[1]:
        raise ConfigError(
            f"{file}: would be {told} mm, its longest edge {1e3 * _SIZES_M[0]:g} to {1e3 * _SIZES_M[1]:g} mm is "
            "possible; say how long the file's unit is, for instance  scale = 0.001  for millimetres"
        )
    middle = 0.5 * (low + high)
    corners = scale * (corners - middle)
    try:
        planes = np.round(hull_planes(corners, MOST_PLANES), 7)
    except ValueError as error:
        raise ConfigError(f"{file}: {error} ({told} mm); a thing that is held needs a thickness") from error
    x, y, z = size_m.tolist()
    shape = MeshShape(
        file=file.name[:64], size=(x, y, z), planes=tuple((p[0], p[1], p[2], p[3]) for p in planes.tolist())
    )
    for array in (corners, triangles, middle):
        array.setflags(write=False)
    return ObjectMesh(content, corners, triangles, middle, scale, shape)


def _refuse_bombs(file: Path, content: bytes) -> None:
    """Refuse a file whose own tables say that it unpacks to more than may be drawn, before it is unpacked.

    A few hundred bytes can say so: an accessor without data is all zeros, and a surface may be drawn a thousand times.

    Raises:
        ConfigError: it does.
    """
    try:
        magic, _, _, length, kind = struct.unpack_from("<4sIIII", content)
        if (magic, kind) != (b"glTF", 0x4E4F534A):
            return
        tables = parse_json(content[20 : 20 + length].decode())
        counts = [int(accessor["count"]) for accessor in tables.get("accessors", [])]
        surfaces = [
            sum(counts[part.get("indices", part["attributes"]["POSITION"])] // 3 for part in mesh["primitives"])
            for mesh in tables.get("meshes", [])
        ]
        nodes = tables.get("nodes", [])
        drawn = sum(surfaces[node["mesh"]] for node in nodes if "mesh" in node)
    except (struct.error, ValueError, TypeError, KeyError, IndexError, AttributeError):
        return  # the reader says what is wrong with it
    if max(counts, default=0) > _MOST_NUMBERS or len(nodes) > _MOST_NODES:
        raise ConfigError(
            f"{file}: has {max(counts, default=0)} numbers in one table and {len(nodes)} places, at most "
            f"{_MOST_NUMBERS} and {_MOST_NODES} are possible; in Blender, *Decimate* and *Join* make them fewer"
        )
    _require_drawable(file, drawn)


def _require_drawable(file: Path, triangles: int) -> None:
    if triangles > MOST_TRIANGLES:
        raise ConfigError(
            f"{file}: has {triangles} triangles, 1 to {MOST_TRIANGLES} are possible; in Blender, *Decimate* makes them "
            "fewer"
        )


def _triangles(file: Path, content: bytes) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return corners (N, 3), units of the file, and triangles (M, 3) of all that a file draws, where it draws it."""
    try:
        import trimesh  # noqa: PLC0415  # its extra may be absent
    except ImportError as error:
        raise ConfigError(f"{file}: reading it needs trimesh: pip install 'rhot[mesh]'") from error
    # From bytes nothing else is opened: a file that names further files is not complete.
    _refuse_bombs(file, content)
    try:
        mesh = trimesh.load_scene(io.BytesIO(content), file_type="glb", skip_materials=True).to_mesh()
        corners = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
        triangles = np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)
        if not np.isfinite(corners).all():
            raise ValueError("it has corners that are no numbers")
        if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(corners):
            raise ValueError(f"triangles name corners up to {triangles.max()}, there are {len(corners)}")
    except Exception as error:  # a reader of any bytes raises anything
        raise ConfigError(
            f"{file}: is no glTF in its binary form ({type(error).__name__}: {str(error)[:120]}); export it as .glb, "
            "all in one file and without compression"
        ) from error
    return corners, triangles
