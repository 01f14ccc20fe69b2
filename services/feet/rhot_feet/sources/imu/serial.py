"""A sensor on a serial port, by the `serial` package (pyserial)."""

from __future__ import annotations

import importlib
import logging
from typing import Any, Protocol

from rhot.errors import DeviceError
from rhot.rig.feet_config import ImuConfig
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.sources.imu.binary_protocol import BinaryDecoder
from rhot_feet.sources.imu.text_protocol import TextDecoder

_LOG = logging.getLogger(__name__)

_SILENCE_NS = 2_000_000_000
"""A sensor that sends nothing that can be read for so long is gone, or speaks otherwise than it should."""


class _Decoder(Protocol):
    @property
    def faults(self) -> int: ...

    def decode(self, data: bytes, arrival_ns: int) -> ImuSamples: ...


def _import_serial() -> Any:
    try:
        return importlib.import_module("serial")
    except ImportError as error:
        raise DeviceError(
            "sensors on a serial port need the Python package `pyserial`; install it with: pip install 'rhot[feet]'"
        ) from error


class SerialSource:
    """Reads what has arrived whenever it is asked, without waiting."""

    def __init__(self, config: ImuConfig) -> None:
        """Name the port and what is spoken on it."""
        self._config = config
        self._port: Any = None
        self._decoder: _Decoder = self._fresh_decoder()
        self._heard_ns: int | None = None

    @property
    def faults(self) -> int:
        """Lines or frames since the port was opened that could not be read."""
        return self._decoder.faults

    def open(self, start_ns: int) -> None:
        """Open the port.

        Raises:
            DeviceError: there is no such port, or it is in use.
        """
        serial = _import_serial()
        config = self._config
        self.close()
        try:
            self._port = serial.Serial(config.device, config.baud, timeout=0, exclusive=True)
        except Exception as error:
            # Not only OSError and ValueError: a device that goes during the opening ends in a termios.error.
            raise DeviceError(
                f"the inertial sensor at {config.device} ({config.baud} baud) cannot be opened: {error}; is it plugged "
                "in, is no other program using it, and may you read the port (group dialout)?"
            ) from error
        self._decoder = self._fresh_decoder()
        # From the first reading on: the session may have begun long before the sensor was plugged in.
        self._heard_ns = None

    def read(self, now_ns: int) -> ImuSamples:
        """Return the samples that arrived since the last call.

        Raises:
            DeviceError: the port is closed or gone, or nothing readable has come for two seconds.
        """
        config, port = self._config, self._port
        if port is None:
            raise DeviceError(f"the inertial sensor at {config.device} is not open")
        try:
            data = port.read(port.in_waiting or 1)
        except Exception as error:
            # OSError, termios.error; a port that another thread closes under the reader: a TypeError of pyserial.
            raise DeviceError(f"the inertial sensor at {config.device} went away: {error}; plug it in again") from error
        samples = self._decoder.decode(data, now_ns)
        if len(samples) or self._heard_ns is None or now_ns < self._heard_ns:
            self._heard_ns = now_ns
        elif now_ns - self._heard_ns > _SILENCE_NS:
            raise DeviceError(
                f"the inertial sensor at {config.device} has sent nothing readable for "
                f"{(now_ns - self._heard_ns) / 1e9:.1f} s ({self._decoder.faults} faulty lines): is it on, is its baud "
                f"rate {config.baud}, and does it send format = {config.format!r}?"
            )
        return samples

    def close(self) -> None:
        """Close the port."""
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except Exception as error:
                # What is pulled out cannot be closed.
                _LOG.debug("inertial sensor at %s: close: %s", self._config.device, error)

    def _fresh_decoder(self) -> _Decoder:
        return TextDecoder(self._config.rate_hz) if self._config.format == "text" else BinaryDecoder()
