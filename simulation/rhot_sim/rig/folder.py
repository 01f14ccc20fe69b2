"""Writing a simulated rig: set up and calibrated as a person would, with a calibration's own small errors."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import rigid, rotation_y
from rhot.messages import Side
from rhot.rig import HandFile, RegistrationFile, Rig, RigidTransform, StageFile, load_rig, write_json_model
from rhot.rig.calibration import today
from rhot.rig.config import SimConfig
from rhot.rig.folder import CAMERAS_FILE, HAND_FILE, REGISTRATION_FILE, RIG_FILE, STAGE_FILE, write_text_atomic
from rhot.rig.template import rig_template
from rhot.rig.toml_edit import change_rig_file
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import simulated_rig_calibration, true_cameras
from rhot_sim.world.motion import R_RIG_HAND
from rhot_sim.world.world import World

CAMERA_NAMES: Final = ("left", "right", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
_PICK_TIMES_S: Final = (0.4, 6.3)
_PICK_SHARE: Final = 0.4
"""A marker is picked only where at least this share of it can be seen."""

_T_STAGE_TRACKER: Final = rigid(rotation_y(np.radians(110.0)), np.array([0.9, 0.0, 0.3]))
"""The simulated tracking system's space: y up and its origin on the floor, as SteamVR's, elsewhere and turned."""


def write_simulated_rig(
    path: Path,
    *,
    cameras: int = 2,
    rate_hz: float = 60.0,
    seed: int = 1,
    sides: Sequence[Side] = ("right",),
    endpoint: str = DEFAULT_ENDPOINT,
    calibrated: bool = True,
    share_paints: bool = True,
) -> Rig:
    """Write the folder of a simulated rig and return it loaded.

    Args:
        path: the folder; made when it is not there.
        cameras: how many, 2 to 8.
        rate_hz: of all cameras.
        seed: of the world and of the calibration's errors.
        sides: hands in the world.
        endpoint: of the router.
        share_paints: the second hand's fingertips wear the paints of the first.
        calibrated: with all that calibration brings; else `rig.toml` alone, for trying the calibration.

    Raises:
        CalibrationError: the markers' colours could not be learnt from the rendered pictures.
    """
    path.mkdir(parents=True, exist_ok=True)
    names = CAMERA_NAMES[:cameras]
    text = rig_template(
        folder=str(path),
        name="simulated",
        connect=(endpoint,),
        listen=(endpoint,),
        cameras=names,
        camera_xs_m=[0.075 * index for index in range(cameras)],
        source="simulated",
        rate_hz=rate_hz,
        # A simulated exposure of 6 ms smears like a Pi camera indoors.
        exposure_s=min(0.006, 0.9 / rate_hz),
        readout_s=min(0.012, 0.9 / rate_hz),
        sides=sides,
        share_paints=share_paints,
        simulated_objects=("cube",),
        seed=seed,
    )
    write_text_atomic(path / RIG_FILE, text)
    if not calibrated:
        return load_rig(path)
    config = load_rig(path).config
    write_json_model(path / CAMERAS_FILE, simulated_rig_calibration(config.cameras, seed).found)
    write_json_model(path / HAND_FILE, HandFile(date=today(), quality={"source": "simulated"}))
    registration = RegistrationFile(
        date=today(),
        quality={"source": "simulated"},
        T_rig_tracker=RigidTransform.from_matrix(true_stage(config.sim) @ _T_STAGE_TRACKER),
    )
    write_json_model(path / REGISTRATION_FILE, registration)
    stage = StageFile(
        date=today(),
        quality={"source": "simulated"},
        T_rig_stage=RigidTransform.from_matrix(true_stage(config.sim)),
        source="simulated",
        residual_m=0.0,
        desk_height_m=config.sim.desk_height_m,
    )
    write_json_model(path / STAGE_FILE, stage)
    calibrate_colors(path)
    return load_rig(path)


def with_motion(rig: Rig, motion: str) -> Rig:
    """Write into the `rig.toml` of a simulated rig what moves there, and return the rig loaded again.

    Args:
        rig: simulated.
        motion: as in `SimConfig`.

    Raises:
        ConfigError: the file cannot be changed; it stays as it is.
    """
    if motion == rig.config.sim.motion:
        return rig
    change_rig_file(rig.path, {("sim",): {"motion": motion}})
    return load_rig(rig.path)


def true_stage(sim: SimConfig) -> FloatArray:
    """Return T_rig_stage (4, 4), metres, of the simulated desk: the reference camera looks straight down on it.

    The person sits where the picture's upper edge is and looks towards its lower edge, see `R_RIG_HAND`.
    """
    return rigid(R_RIG_HAND, np.array([0.0, 0.0, sim.desk_z_m + sim.desk_height_m]))


def calibrate_colors(path: Path) -> None:
    """Run `rhot calibrate colors` on rendered pictures of a rig folder, with picks where the markers are.

    Raises:
        ConfigError: the folder is not a rig, or cannot be written.
    """
    rig = load_rig(path)
    world = World.from_rig(rig)
    with tempfile.TemporaryDirectory() as folder:
        pictures, picks = [], []
        for index, (name, camera) in enumerate(true_cameras(rig).items()):
            renderer = Renderer(camera, world, rig.config.sim, rig.config.cameras[name], index)
            seen = MarkerCoverage(camera, world)
            for t_s in _PICK_TIMES_S:
                picture = Path(folder) / f"{name}-{t_s}.png"
                cv2.imwrite(str(picture), renderer.render(t_s))
                pictures.append(str(picture))
                for marker, view in seen.at(t_s).items():
                    if view.shows(_PICK_SHARE):
                        picks += ["--pick", f"{marker}={view.u:.0f},{view.v:.0f}@{len(pictures)}"]
        command = [sys.executable, "-m", "rhot", "-q", "calibrate", "colors", *pictures, *picks, "--rig", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    if done.returncode:
        raise CalibrationError(f"the simulated markers' colours could not be learnt: {done.stderr.strip()}")
