"""Which sensors a rig needs for its feet."""

from __future__ import annotations

from rhot.messages import Side
from rhot.plugins import load_simulated
from rhot.rig import Rig
from rhot.rig.feet_config import FeetConfig
from rhot_feet.imu.samples import ImuSource
from rhot_feet.sources.imu.factory import make_imu_source


def plan_sensors(rig: Rig, feet: FeetConfig) -> dict[Side, ImuSource]:
    """Return the inertial sensors of a rig by foot, not yet open; all simulated ones share one world.

    Raises:
        ConfigError: a sensor cannot be what the rig says.
    """
    configs = {side: foot.imu for side, foot in feet.feet.items() if foot.imu is not None}
    simulated: dict[Side, ImuSource] = {}
    if any(config.source == "simulated" for config in configs.values()):
        simulated = load_simulated("imu")(rig, list(configs))
    return {side: make_imu_source(config, rig.path, simulated.get(side)) for side, config in configs.items()}
