"""Nodes of the 3D scene in the browser that are filled with arrays of `rhot_viewer.scene`.

Everything that moves consists of copies of three unit meshes, so that a frame costs a few messages however many parts
move; a property that has not changed is not sent again (viser compares).
"""

from __future__ import annotations

from typing import Final, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from rhot_viewer.scene.hand import HandShape
from rhot_viewer.scene.instances import Instances, Mesh, unit_ball, unit_rod

GHOST_OPACITY: Final = 0.45

_LIGHT: Final = np.round(255.0 * (np.arange(256) / 255.0) ** 2.2).astype(np.uint8)
"""Colours without a screen's gamma: the browser takes those of copies as amounts of light, and adds the gamma."""

_Number = TypeVar("_Number", np.float32, np.uint8)


class InstanceLayer:
    """Copies of one mesh under one name; how many may change."""

    def __init__(self, scene: viser.SceneApi, name: str, mesh: Mesh, *, ghost: bool = False) -> None:
        """Prepare a layer.

        Args:
            scene: where.
            name: of the node.
            mesh: what is copied.
            ghost: translucent, and only its far side is drawn: around something solid it shows as a rim.
        """
        self._scene = scene
        self._name = name
        self._mesh = mesh
        self._ghost = ghost
        self._handle: viser.BatchedMeshHandle | None = None

    def show(self, copies: Instances | None) -> None:
        """Show these copies, or nothing."""
        handle = self._handle
        if copies is None or len(copies) == 0:
            if handle is not None:
                handle.visible = False
            return
        if handle is None or len(handle.batched_positions) < len(copies):
            self._handle = self._added(copies)
            return
        full = len(handle.batched_positions)
        handle.batched_positions = _filled(copies.positions, full)
        handle.batched_wxyzs = _filled(copies.wxyzs, full)
        scales = _filled(copies.scales, full)
        if full > len(copies):
            # Those that are too many have no size.
            scales = scales * (np.arange(full) < len(copies))[:, None]
        handle.batched_scales = scales
        handle.batched_colors = _LIGHT[_filled(copies.colors, full)]
        handle.visible = True

    def _added(self, copies: Instances) -> viser.BatchedMeshHandle:
        return self._scene.add_batched_meshes_simple(
            self._name,
            self._mesh.vertices,
            self._mesh.faces,
            copies.wxyzs,
            copies.positions,
            batched_scales=copies.scales,
            batched_colors=_LIGHT[copies.colors],
            opacity=GHOST_OPACITY if self._ghost else None,
            side="back" if self._ghost else "front",
            lod="off",
            # Shadows of moving things are redrawn in every frame by every browser.
            cast_shadow=False,
            receive_shadow=False,
        )


def _filled(rows: NDArray[_Number], full: int) -> NDArray[_Number]:
    """Return an array of `full` rows: those given, then the last one again and again."""
    if len(rows) == full:
        return rows
    filled: NDArray[_Number] = rows[np.minimum(np.arange(full), len(rows) - 1)]
    return filled


class HandLayer:
    """One hand: joints and bones."""

    def __init__(self, scene: viser.SceneApi, name: str, *, ghost: bool = False) -> None:
        self._joints = InstanceLayer(scene, f"{name}/joints", unit_ball(), ghost=ghost)
        self._bones = InstanceLayer(scene, f"{name}/bones", unit_rod(), ghost=ghost)

    def show(self, shape: HandShape | None) -> None:
        """Show a hand, or none."""
        self._joints.show(None if shape is None else shape.joints)
        self._bones.show(None if shape is None else shape.bones)
