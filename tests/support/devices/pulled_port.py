"""A serial port that disappears and returns late, as a USB adapter that is pulled out and plugged in again.

A pseudo terminal behind a link, as udev's `/dev/serial/by-id/…` links are: the link goes with the device and comes back
with it, to another `/dev/ttyUSB*`. What a reader sees follows pyserial's `serialposix.py` (3.5) and tty_ioctl(4):

- after the hang-up, `in_waiting` (TIOCINQ) and `read` fail with EIO, an OSError, or `read` finds the port ready and
  empty, which pyserial raises as SerialException ("device reports readiness to read but returned no data");
- while it is away, opening fails with ENOENT, a SerialException;
- a device that goes during the opening ends in `termios.error` from tcsetattr, which is no OSError and which pyserial
  does not turn into a SerialException (`_reconfigure_port` guards tcgetattr alone).
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


class PulledPort:
    """A port at a fixed path; plugged in at the beginning."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "usb-imu-left"
        self._master: int | None = None
        self._keeper: int | None = None
        self.plug_in()

    def plug_in(self) -> None:
        """Let the device come back, on another terminal."""
        self._master, self._keeper = os.openpty()
        os.set_blocking(self._master, False)
        self.path.symlink_to(os.ttyname(self._keeper))

    def pull_out(self) -> None:
        """Let the device vanish: who has it open finds it hung up."""
        for handle in (self._keeper, self._master):
            if handle is not None:
                with contextlib.suppress(OSError):
                    os.close(handle)
        self._master = self._keeper = None
        self.path.unlink(missing_ok=True)

    def send(self, data: bytes) -> None:
        """Send what the sensor would."""
        if self._master is None:
            raise RuntimeError("plug it in first")
        os.write(self._master, data)
