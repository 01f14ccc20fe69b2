"""Every error that RHOT raises on purpose.

A message names the value, the place (file and field, key, device) and the remedy; the command line prints it
alone, without a traceback.
"""

from typing import Final

from rhot.text import printable

EXIT_AGAIN: Final = 75
"""What a process ends with that should be restarted, as after `HungDeviceError`: EX_TEMPFAIL of sysexits.h."""


class RhotError(Exception):
    """Base of all errors a user may see; catch it at the edge of a program."""


class ConfigError(RhotError):
    """A rig folder, a recording folder or a command-line value cannot be used as it stands."""


class CalibrationError(RhotError):
    """Calibration input or a calibration file contradicts itself or what is physically possible."""


class WireError(RhotError):
    """A payload from the bus is not a valid message of its key; its text holds nothing of it unescaped."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(text))


class DeviceError(RhotError):
    """A camera, tracker or other device is absent or refuses what was asked of it."""


class HungDeviceError(RhotError):
    """A driver does not return and holds its device; only a new process gets it back, so this one ends.

    No DeviceError: those are tried again in the same process.
    """


class BusError(RhotError):
    """The Zenoh session could not be opened or a query found nobody to answer it."""
