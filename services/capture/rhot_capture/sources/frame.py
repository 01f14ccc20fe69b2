"""The seam between cameras of every kind and the rest of capture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from rhot.arrays import ImageArray
from rhot_capture.settings import CameraSettings


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture.

    The image may lie in the camera's own memory, which is given back when the last reference to it goes; keep a
    frame no longer than its work takes.

    Attributes:
        image: (H, W, 3) uint8 BGR.
        index: the source's frame counter; a gap means frames that never arrived.
        t_first_row_ns: start of the first row's exposure, the node's own clock.
        exposure_s: exposure time of each row.
        readout_s: time between the read-out of the first and of the last row.
    """

    image: ImageArray
    index: int
    t_first_row_ns: int
    exposure_s: float
    readout_s: float


class Source(Protocol):
    """Something that delivers frames: a camera, a recording or a simulation."""

    def open(self, start_ns: int, start_t_ns: int | None = None) -> None:
        """Prepare to deliver frames from a moment on; frames before it are not delivered.

        Args:
            start_ns: the moment, the node's own clock. When it has passed already, recordings and simulations join
                at what would be due now.
            start_t_ns: the same moment on the rig clock, where it is known; the simulation counts its world's time
                from it.

        Raises:
            DeviceError: the camera is absent or refuses what the rig asks of it.
            ConfigError: the recording cannot be used.
        """
        ...

    def read(self) -> Frame | None:
        """Wait for the next frame and return it; None when there are no more.

        Called on one thread, other than the one that calls `close` and `apply`. After `close` it returns None soon.

        Raises:
            DeviceError: the camera stopped delivering.
        """
        ...

    def apply(self, settings: CameraSettings) -> None:
        """Change the camera while it runs.

        Raises:
            ConfigError: this source cannot.
            DeviceError: the camera refuses.
        """
        ...

    def close(self) -> None:
        """Stop and free the device; may be called repeatedly."""
        ...


@runtime_checkable
class ReportsProblem(Protocol):
    """A source that delivers frames and yet is not as the rig wants it."""

    @property
    def problem(self) -> str:
        """What is wrong, for the status; empty when nothing is. Read on another thread than `read`."""
        ...
