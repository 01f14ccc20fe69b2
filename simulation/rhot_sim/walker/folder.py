"""Writing the rig of a simulated walker: a head-worn depth camera, two feet with marker and sensor, a headset."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

from rhot.rig import Rig, RigidTransform, StageFile, load_rig, write_json_model
from rhot.rig.calibration import today
from rhot.rig.feet_config import WalkProgram
from rhot.rig.folder import RIG_FILE, STAGE_FILE, write_text_atomic
from rhot_sim.rig.folder import DEFAULT_ENDPOINT

_TEMPLATE: Final = """\
# A simulated person whose feet are tracked from the head; the rig frame has y up and the floor at y = 0.
version = 1
name = "walker"

[bus]
connect = ["{endpoint}"]
listen = ["{endpoint}"]

[feet.camera]
source = "simulated"
rate_hz = {rate_hz:g}
pitch_deg = 20

[feet.left]
marker_id = 0
imu = {{ source = "simulated", rate_hz = {imu_rate_hz:g} }}

[feet.right]
marker_id = 1
imu = {{ source = "simulated", rate_hz = {imu_rate_hz:g} }}

[body]
height_m = {height_m:g}

# The headset, which is published on rhot/head.
[objects.head]
source = "simulated"
rate_hz = 90.0

[sim]
seed = {seed}
walk = "{program}"
motion = "{motion}"
"""


def write_walker_rig(
    path: Path,
    *,
    endpoint: str = DEFAULT_ENDPOINT,
    program: WalkProgram = "walk",
    seed: int = 1,
    height_m: float = 1.75,
    rate_hz: float = 60.0,
    imu_rate_hz: float = 100.0,
    motion: Literal["script", "headset"] = "script",
) -> Rig:
    """Write the folder of a simulated walker's rig and return it loaded.

    Args:
        path: the folder; made when it is not there.
        endpoint: of the router.
        program: what the person does.
        seed: of the world.
        height_m: of the person.
        rate_hz: of the camera.
        imu_rate_hz: of both ankle sensors.
        motion: `headset`: for finding where the camera sits, see `WalkerWorld`.
    """
    path.mkdir(parents=True, exist_ok=True)
    text = _TEMPLATE.format(
        endpoint=endpoint,
        program=program,
        seed=seed,
        height_m=height_m,
        rate_hz=rate_hz,
        imu_rate_hz=imu_rate_hz,
        motion=motion,
    )
    write_text_atomic(path / RIG_FILE, text)
    # The walker's rig frame is the stage.
    write_json_model(
        path / STAGE_FILE, StageFile(date=today(), T_rig_stage=RigidTransform.identity(), source="simulated")
    )
    return load_rig(path)
