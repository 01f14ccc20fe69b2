"""The interface between all kinds of cameras and the rest of capture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from rhot.arrays import ImageArray
from rhot_capture.settings import CameraSettings


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame.

    The image may be in the camera's memory, which is released with the last reference to it; do not keep frames.

    Attributes:
        image: (H, W, 3) uint8 BGR.
        index: the source's frame counter; a gap means lost frames.
        t_first_row_ns: start of the first row's exposure, node's clock.
        exposure_s: exposure time of each row.
        readout_s: time between the read-out of the first and of the last row.
    """

    image: ImageArray
    index: int
    t_first_row_ns: int
    exposure_s: float
    readout_s: float


class Source(Protocol):
    """A source of frames: a camera, a recording or a simulation."""

    def open(self, start_ns: int, start_t_ns: int | None = None) -> None:
        """Open the source; frames before the start time are discarded.

        Args:
            start_ns: start time, node's clock. If it has passed, recordings and simulations start at the frame that is
                due now.
            start_t_ns: the same time on the rig clock, if known; time 0 of a simulated world.

        Raises:
            DeviceError: the camera is absent, or refuses the configured settings.
            ConfigError: the recording cannot be used.
        """
        ...

    def read(self) -> Frame | None:
        """Wait for the next frame and return it; None when there are no more.

        Called on one thread, while another may call `close` and `apply`. Returns None soon after `close`.

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
        """Stop and release the device; may be called repeatedly."""
        ...


@runtime_checkable
class ReportsProblem(Protocol):
    """A source that can report a problem while it delivers frames."""

    @property
    def problem(self) -> str:
        """The problem, one sentence for the status; empty when none. Accessed on another thread than `read`."""
        ...
