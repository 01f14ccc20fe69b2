"""Objects with a surface of their own: each is sent to the browser once, and then only moved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import viser
from numpy.typing import NDArray

from rhot.geometry.hull import hull_surface
from rhot.messages import MeshShape, ObjectPose
from rhot.object_mesh import known_mesh
from rhot.rig import Rig
from rhot_viewer.scene.things import OBJECT_COLOR, PREDICTED_COLOR

_MOST_KEPT: Final = 64
"""Meshes that stay in the browser, hidden, once they have gone: a rig has about ten, but anybody may make up names."""


class MeshLayer:
    """Meshes by the object's name; from the rig folder's file, else the planes that the message carries."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        """Prepare a layer.

        Args:
            scene: where.
            name: of the node above them.
        """
        self._scene = scene
        self._name = name
        self._drawn: dict[str, tuple[MeshShape, viser.MeshHandle]] = {}

    def show(self, rig: Rig, objects: Mapping[str, ObjectPose]) -> None:
        """Show those objects whose shape is a mesh, and no others."""
        for name, (_, handle) in self._drawn.items():
            handle.visible = name in objects and isinstance(objects[name].shape, MeshShape)
        if len(self._drawn) > _MOST_KEPT:
            for name in [name for name, (_, handle) in self._drawn.items() if not handle.visible]:
                self._drawn.pop(name)[1].remove()
        for name, pose in objects.items():
            if isinstance(pose.shape, MeshShape):
                handle = self._handle(rig, name, pose.shape)
                x, y, z, w = pose.orientation
                handle.position, handle.wxyz = pose.position, (w, x, y, z)
                handle.color = OBJECT_COLOR if pose.state == "measured" else PREDICTED_COLOR

    def _handle(self, rig: Rig, name: str, shape: MeshShape) -> viser.MeshHandle:
        drawn = self._drawn.get(name)
        if drawn is not None and drawn[0] == shape:
            return drawn[1]
        corners, triangles = _surface(rig, name, shape)
        handle = self._scene.add_mesh_simple(
            f"{self._name}/{name}",
            corners.astype(np.float32),
            triangles.astype(np.uint32),
            color=OBJECT_COLOR,
            # A surface that somebody drew may be open.
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._drawn[name] = shape, handle
        return handle


def _surface(rig: Rig, name: str, shape: MeshShape) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    mesh = known_mesh(rig, name)
    # A recording may be of another rig: what it says counts, not what the file holds by now.
    if mesh is not None and mesh.shape == shape:
        return mesh.corners, mesh.triangles
    return hull_surface(np.array(shape.planes))
