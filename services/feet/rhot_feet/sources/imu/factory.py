"""Make the source that the rig folder asks for."""

from __future__ import annotations

from pathlib import Path

from rhot.errors import ConfigError
from rhot.messages import Side
from rhot.plugins import load_simulated
from rhot.rig import Rig
from rhot.rig.feet_config import FeetConfig, ImuConfig
from rhot_feet.imu.samples import ImuSource
from rhot_feet.sources.imu.recorded import RecordedSource
from rhot_feet.sources.imu.serial import SerialSource


def make_imu_source(config: ImuConfig, folder: Path, simulated: ImuSource | None = None) -> ImuSource:
    """Return the source of one ankle's sensor, not yet open.

    Args:
        config: of the sensor.
        folder: of the rig; a recording's path counts from it.
        simulated: the sensor of the simulated world, where there is one.

    Raises:
        ConfigError: a simulated sensor is asked for outside of a simulation.
    """
    if config.source == "serial":
        return SerialSource(config)
    if config.source == "recorded":
        return RecordedSource(folder / (config.path or ""), loop=config.loop)
    if simulated is None:
        raise ConfigError(
            'imu source = "simulated" exists only in `rhot sim --feet`; name a serial port or a recording'
        )
    return simulated


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
