"""Objects with a surface of their own in the working page."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import things

from rhot.messages import ObjectPose
from rhot.object_mesh import mesh_file
from rhot.rig import load_rig
from rhot.rig.folder import RIG_FILE
from rhot_viewer.browser.rig_scene import MeshLayer
from rhot_viewer.scene.drawn import PREDICTED_COLOR

QUARTER_ABOUT_Y = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))


def test_a_mesh_is_sent_once_and_then_moved(rig_folder: Path) -> None:
    """From the rig folder's file where that holds what the message says, else the planes around it."""
    with (rig_folder / RIG_FILE).open("a") as file:
        file.write('\n[objects.cup]\nserial = "A"\nshape = { kind = "mesh", file = "cup.glb" }\n')
    cup = mesh_file(things.save(things.mug(), rig_folder / "cup.glb"))
    pose = ObjectPose(
        t_ns=1, frame="rig", position=(0.1, 0.2, 0.8), orientation=QUARTER_ABOUT_Y, state="measured", shape=cup.shape
    )
    scene = MagicMock()
    layer, rig = MeshLayer(scene, "/meshes"), load_rig(rig_folder)
    for state in ("measured", "predicted"):
        layer.show(rig, {"cup": pose.model_copy(update={"state": state})})
    scene.add_mesh_simple.assert_called_once()
    (name, corners, triangles), _ = scene.add_mesh_simple.call_args
    assert (name, len(triangles)) == ("/meshes/cup", len(cup.triangles))
    assert np.abs(corners - cup.corners).max() < 1e-6
    handle = scene.add_mesh_simple.return_value
    assert (handle.position, handle.color, handle.visible) == ((0.1, 0.2, 0.8), PREDICTED_COLOR, True)
    assert handle.wxyz == pytest.approx((np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0))
    layer.show(rig, {})
    assert handle.visible is False
    other = cup.shape.model_copy(update={"file": "pot.glb"})
    layer.show(rig, {"cup": pose.model_copy(update={"shape": other})})
    assert len(scene.add_mesh_simple.call_args.args[2]) < 4 * len(other.planes), "only the planes are known of it"
