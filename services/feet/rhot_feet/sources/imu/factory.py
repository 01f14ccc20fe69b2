"""Make the source that the rig folder asks for."""

from __future__ import annotations

from pathlib import Path

from rhot.errors import ConfigError
from rhot.rig.feet_config import ImuConfig
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
