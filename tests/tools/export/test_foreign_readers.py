"""Files judged by programs that are not ours: Khronos's glTF validator."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from exported.foreign_programs import npm_packages
from hand_messages import object_pose
from things import mug, save

from rhot.messages import BoxShape, CylinderShape, SphereShape
from rhot.object_mesh import mesh_file
from rhot_tools.export.gltf import gltf_document
from rhot_tools.export.poses import motions
from rhot_tools.recordings.export import export

_VALIDATE = """
const validator = require("gltf-validator"), fs = require("fs");
Promise.all(process.argv.slice(1).map(f => validator.validateBytes(new Uint8Array(fs.readFileSync(f)))))
  .then(reports => console.log(JSON.stringify(reports)));
"""


@pytest.fixture(scope="module")
def validated(poses_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return the validator's reports on the scene as GLB and glTF, on one pose, and on objects of all shapes."""
    modules = npm_packages()
    folder = tmp_path_factory.mktemp("gltf")
    one = folder / "one.jsonl"
    one.write_text("".join(poses_recording.read_text().splitlines(keepends=True)[:2]))
    for source, name in ((poses_recording, "x.glb"), (poses_recording, "x.gltf"), (one, "one.glb")):
        written = CliRunner().invoke(export, [str(source), "--gltf", str(folder / name)])
        assert written.exit_code == 0, written.output
    mesh = mesh_file(save(mug(), folder / "mug.glb")).shape
    shapes = (
        BoxShape(size=(0.1, 0.2, 0.3)),
        CylinderShape(radius=0.04, height=0.12),
        SphereShape(radius=0.05),
        mesh,
        None,
    )
    pose = object_pose(1, 0.0)
    things = [(f"rhot/object/{n}", pose.model_copy(update={"shape": shape})) for n, shape in enumerate(shapes)]
    (folder / "shapes.glb").write_bytes(gltf_document(list(motions(things).values()), "rig").binary())
    files = [str(folder / name) for name in ("x.glb", "x.gltf", "one.glb", "shapes.glb")]
    done = subprocess.run(
        ["node", "-e", _VALIDATE, *files], cwd=modules, capture_output=True, text=True, timeout=60, check=True
    )
    return json.loads(done.stdout)


def test_gltf_validator_finds_no_error_and_no_warning(validated: list[dict[str, Any]]) -> None:
    for report in validated:
        assert report["issues"]["numErrors"] == 0, report["issues"]["messages"]
        assert report["issues"]["numWarnings"] == 0, report["issues"]["messages"]
    assert validated[0]["info"]["animationCount"] == 1
    assert validated[0]["info"]["hasSkins"]
