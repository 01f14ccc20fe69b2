"""A simulated rig whose cameras see a board on the desk, and what they see."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from rhot.rig import Rig, load_rig
from rhot.rig.folder import STAGE_FILE
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig import folder
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.rig.folder import with_motion
from rhot_sim.world.world import World


@pytest.fixture(scope="session")
def desk_pictures(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, Path]:
    """Return the rig, without a floor, and a folder of pictures of its desk."""
    path, pictures = tmp_path_factory.mktemp("rig"), tmp_path_factory.mktemp("pictures")
    with pytest.MonkeyPatch.context() as patch:
        # A board on a desk needs no colours, and learning them takes four seconds.
        patch.setattr(folder, "calibrate_colors", lambda _: None)
        rig = with_motion(folder.write_simulated_rig(path, seed=4), "desk_board")
    (path / STAGE_FILE).unlink()
    world = World.from_rig(rig)
    for index, (name, camera) in enumerate(true_cameras(rig).items()):
        renderer = Renderer(camera, world, rig.config.sim, rig.config.cameras[name], index)
        (pictures / name).mkdir()
        for number in (1, 2):
            cv2.imwrite(str(pictures / name / f"{number:06d}.png"), renderer.render(0.1 * number))
    return load_rig(path), pictures
