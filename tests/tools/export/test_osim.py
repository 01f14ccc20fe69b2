"""The model for OpenSim: the coordinates of the MOT file move its markers to where the TRC file has them."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner
from hand_messages import object_pose

from rhot.geometry.rotations import rigid, rotation_from_vector, rotation_x, rotation_y, rotation_z
from rhot.recording.messages import RecordedMessages
from rhot_tools.export.frames import coordinates_deg, frames_of
from rhot_tools.export.osim import osim_text
from rhot_tools.export.poses import motions
from rhot_tools.recordings.export import export


def numbers(element: ElementTree.Element, tag: str) -> np.ndarray:
    return np.array((element.findtext(tag) or "").split(), np.float64)


def placed(model: ElementTree.Element, values: dict[str, float]) -> dict[str, np.ndarray]:
    """Return the markers (3,) of a model whose coordinates have these values, metres and radians; 0 where none is."""
    T = {"/ground": np.eye(4)}
    for joint in model.iter("CustomJoint"):
        parent, child = joint.iter("PhysicalOffsetFrame")
        x, y, z = numbers(parent, "orientation")
        offset = rigid(rotation_x(x) @ rotation_y(y) @ rotation_z(z), numbers(parent, "translation"))
        R, t = np.eye(3), np.zeros(3)
        for axis in joint.iter("TransformAxis"):
            moved = values.get(axis.findtext("coordinates") or "", 0.0) * numbers(axis, "axis")
            if axis.get("name", "").startswith("rotation"):
                R = R @ rotation_from_vector(moved)
            else:
                t = t + moved
        T[child.findtext("socket_parent") or ""] = T[parent.findtext("socket_parent") or ""] @ offset @ rigid(R, t)
    markers = {}
    for marker in model.iter("Marker"):
        T_marker = T[marker.findtext("socket_parent_frame") or ""]
        markers[marker.get("name", "")] = T_marker[:3, :3] @ numbers(marker, "location") + T_marker[:3, 3]
    return markers


def test_its_coordinates_place_its_markers(poses_recording: Path) -> None:
    found = list(motions(RecordedMessages(poses_recording)).values())
    model = ElementTree.fromstring(osim_text(found))
    frames, columns = frames_of(found), coordinates_deg(frames_of(found))
    for row in range(5, len(frames.t_s) - 5, 10):
        values = {name: float(np.radians(column[row])) for name, column in columns.items()}
        wanted = dict(zip(frames.markers, frames.positions[row], strict=True))
        for side in ("left", "right"):
            wrist = wanted[f"hand_{side}_wrist"]
            values |= {f"hand_{side}_wrist_t{axis}": float(at) for axis, at in zip("xyz", wrist, strict=True)}
        markers = placed(model, values)
        assert len(markers) == 52
        for name, at in markers.items():
            np.testing.assert_allclose(at, wanted[name], atol=1e-5, err_msg=name)


def test_a_recording_without_hands_is_one_clear_error(tmp_path: Path) -> None:
    file = tmp_path / "x.jsonl"
    file.write_text(f'{{"key": "rhot/object/cup", "value": {object_pose(1, 0.0).model_dump_json()}}}\n')
    done = CliRunner().invoke(export, [str(file), "--osim", str(tmp_path / "x.osim")])
    assert done.exit_code == 1
    assert "no hand with joint angles" in str(done.exception)


@pytest.mark.parametrize("side", ["left", "right"])
def test_one_hand_alone_is_a_model_too(poses_recording: Path, side: str) -> None:
    found = motions(RecordedMessages(poses_recording))
    model = ElementTree.fromstring(osim_text([found[f"hand_{side}"]]))
    assert len(placed(model, {})) == 26
