"""Raspberry Pi cameras through picamera2, with all automatic functions switched off.

Times: libcamera's `SensorTimestamp` (CLOCK_BOOTTIME) is taken when the first row arrives from the sensor, which is the
end of that row's exposure (raspberrypi/picamera2 issue 821), so

    t_first_row = SensorTimestamp − ExposureTime + (monotonic − boottime).
"""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from functools import partial
from typing import Any, Final

import cv2
import numpy as np

from rhot.clock import difference_ns
from rhot.errors import ConfigError, DeviceError, RhotError
from rhot.rig.config import CameraConfig
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.frame import Frame
from rhot_capture.sources.libcamera import (
    PicameraModules,
    differences,
    import_picamera,
    lacking_controls,
    locked_controls,
)

# Choice of a sensor mode.


def choose_mode(modes: Sequence[Mapping[str, Any]], camera: CameraConfig, name: str) -> Mapping[str, Any] | None:
    """Return the sensor mode to use: fast enough, widest view, then fewest pixels; None where there is no choice.

    Cameras without raw pictures (USB cameras, vimc) list formats instead of modes, without sizes and rates.

    Args:
        modes: picamera2's `sensor_modes`.
        camera: size and rate wanted.
        name: of the camera, for messages.

    Raises:
        DeviceError: no mode is fast enough at that size.
    """
    # A synchronised camera must be able to shorten frames, so it may not run at the mode's full rate.
    margin = 0.95 if camera.sync != "off" else 1.0
    modes = [mode for mode in modes if "size" in mode and "fps" in mode]
    if not modes:
        return None
    large = [mode for mode in modes if mode["size"][0] >= camera.width and mode["size"][1] >= camera.height]
    usable = [mode for mode in large if float(mode["fps"]) * margin >= camera.rate_hz]
    if not usable:
        choices = ", ".join(f"{mode['size'][0]}x{mode['size'][1]} at {float(mode['fps']):.1f} Hz" for mode in modes)
        raise DeviceError(
            f"camera {name}: no sensor mode gives {camera.width}x{camera.height} at {camera.rate_hz:g} Hz"
            f"{' with room to synchronise' if margin < 1.0 else ''}; it has {choices}; lower rate_hz or size"
        )

    def cost(mode: Mapping[str, Any]) -> tuple[float, float]:
        crop = mode.get("crop_limits", (0, 0, *mode["size"]))
        return -float(crop[2]) * float(crop[3]), float(mode["size"][0]) * float(mode["size"][1])

    return min(usable, key=cost)


logger = logging.getLogger(__name__)

_FORMATS: Final = ("RGB888", "BGR888")
"""picamera2 names formats by significance: RGB888 lies in memory as B, G, R, which is what OpenCV wants; the other one,
for cameras that have only that, costs a copy of every picture."""
_WAIT_S: Final = 0.5
_SILENCE_S: Final = 5.0
_SYNC_WAIT_S: Final = 10.0
"""Longest wait for synchronisation with the other cameras: chosen, enough for a rig that starts."""


class _Lease:
    """Owner of an array's memory, kept alive by every view of it."""

    def __init__(self, array: np.ndarray[Any, np.dtype[np.uint8]]) -> None:
        self.__array_interface__ = array.__array_interface__


def boottime_offset_ns() -> int:
    """Return monotonic minus boottime clock, nanoseconds; 0 unless the machine was suspended."""
    if sys.platform == "linux":
        return difference_ns(time.monotonic_ns, partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME))
    else:  # noqa: RET505  # for mypy, which reads what follows a platform's return as dead
        return 0


class Picamera2Source:
    """A camera on a Raspberry Pi's camera connector."""

    def __init__(
        self,
        name: str,
        camera: CameraConfig,
        modules: Callable[[], PicameraModules] = import_picamera,
        offset_ns: Callable[[], int] = boottime_offset_ns,
    ) -> None:
        """Prepare; `open` touches the device.

        Args:
            name: of the camera.
            camera: its configuration.
            modules: imports what only a Pi has.
            offset_ns: monotonic minus boottime clock.
        """
        self._name = name
        self._camera = camera
        self._import = modules
        self._offset_ns = offset_ns
        self._modules: PicameraModules | None = None
        self._device: Any = None
        self._format = _FORMATS[0]
        self._start_ns = 0
        self._readout_s = camera.readout_s
        self._exposure_s = camera.exposure_s
        self._frame_ns = round(1e9 / camera.rate_hz)
        self._origin_ns: int | None = None
        self._index = -1
        self._settling = 0
        self._expected: Mapping[str, float] = {}
        self._unsynchronised_since_ns: int | None = None
        self._problem = ""
        self._lacking, self._offered = "", frozenset[str]()
        self._closing = threading.Event()
        # No request may enter picamera2's queue between emptying the queue and stopping the camera.
        self._queueing = threading.Lock()

    @property
    def problem(self) -> str:
        """Problem while frames arrive, for the status; empty when none."""
        return self._problem or self._lacking

    def open(self, start_ns: int, start_t_ns: int | None = None) -> None:
        """Open the camera, choose a sensor mode that is fast enough and lock all settings.

        Raises:
            DeviceError: picamera2 is missing, there is no such camera, it is in use, or it has no mode for what
                `rig.toml` asks.
        """
        self._modules = self._import()
        self._closing.clear()
        self._start_ns = start_ns
        self._origin_ns = None
        self._index = -1
        self._unsynchronised_since_ns, self._problem = None, ""
        number = self._number()
        with self._driver_errors("cannot list the cameras"):
            present = self._modules.picamera2.Picamera2.global_camera_info()
        if number >= len(present):
            found = ", ".join(f"{index}: {info.get('Model', '?')}" for index, info in enumerate(present)) or "none"
            raise DeviceError(
                f"camera {self._name}: no libcamera camera {number}; present: {found}; check that no other program "
                "uses it, the ribbon cable, and `rpicam-hello --list-cameras`"
            )
        with self._driver_errors("cannot be opened; another program uses it?"):
            self._device = self._modules.picamera2.Picamera2(number)
        try:
            with self._driver_errors("cannot be started"):
                self._start()
        except BaseException:
            self.close()
            raise

    def read(self) -> Frame | None:
        """Wait for the next frame, in the camera's own memory.

        Raises:
            DeviceError: the camera delivers no more.
        """
        while not self._closing.is_set() and self._device is not None:
            request = self._next_request(self._device)
            if request is None:
                return None
            frame = self._frame(request)
            if frame is not None:
                return frame
        return None

    def _next_request(self, device: Any) -> Any:
        """Wait for one completed request; None after `close`."""
        # The wait is split, so that `close` from another thread takes effect. An abandoned job would still obtain a
        # request later, which would never be released.
        with self._queueing:
            if self._closing.is_set():
                return None
            job = device.capture_request(wait=False)
        silent_s = 0.0
        while not self._closing.is_set():
            try:
                return job.get_result(timeout=_WAIT_S)
            except TimeoutError:
                silent_s += _WAIT_S
            except (RuntimeError, CancelledError) as error:
                if self._closing.is_set():
                    return None
                raise DeviceError(f"camera {self._name}: {error or type(error).__name__}") from error
            if silent_s >= _SILENCE_S:
                raise DeviceError(
                    f"camera {self._name}: no frame for {silent_s:.0f} s; check the ribbon cable and `dmesg`"
                )
        return None

    def apply(self, settings: CameraSettings) -> None:
        """Set exposure, gain, white balance, focus and picture while running.

        Raises:
            ConfigError: the camera has no such picture setting.
            DeviceError: the camera is not open.
        """
        if self._device is None:
            raise DeviceError(f"camera {self._name}: not open; start it first")
        lacking = lacking_controls(settings, self._offered, self._name)
        if lacking not in ("", self._lacking):
            raise ConfigError(lacking)
        with self._driver_errors("refuses its settings"):
            self._device.set_controls(self._controls(settings))
        self._lacking = lacking

    def close(self) -> None:
        """Stop and release the camera; may block without limit, like the driver's stop."""
        with self._queueing:
            self._closing.set()
        device, self._device = self._device, None
        if device is not None:
            # `stop` would wait without limit for an abandoned capture in picamera2's queue.
            device.cancel_all_and_flush()
            try:
                device.stop()
            finally:
                device.close()

    @contextlib.contextmanager
    def _driver_errors(self, what: str) -> Iterator[None]:
        """Turn whatever the camera stack raises (RuntimeError, KeyError, ValueError, …) into a DeviceError."""
        try:
            yield
        except RhotError:
            raise
        except Exception as error:
            raise DeviceError(f"camera {self._name}: {what} ({type(error).__name__}: {error})") from error

    def _number(self) -> int:
        try:
            return int(self._camera.device)
        except ValueError as error:
            raise DeviceError(
                f'camera {self._name}: device = "{self._camera.device}" is no libcamera index; use 0 or 1'
            ) from error

    def _start(self) -> None:
        camera = self._camera
        mode = choose_mode(self._device.sensor_modes, camera, self._name)
        if mode is not None and camera.readout_s == 0.0:
            # At its highest rate a sensor reads out rows almost without pause: read-out takes the whole frame period.
            self._readout_s = 1.0 / float(mode["fps"])
        self._offered = frozenset(getattr(self._device, "camera_controls", {}))
        self._lacking = lacking_controls(camera, self._offered, self._name)
        if self._lacking:
            logger.warning("%s", self._lacking)
        for wanted in _FORMATS:
            self._configure(mode, wanted)
            try:
                self._device.start()
                break
            except RuntimeError:
                # A camera may accept a format whose link it then cannot set up (vimc).
                if wanted == _FORMATS[-1]:
                    raise
        logger.info(
            "camera %s: sensor mode %s, running at %.1f Hz",
            self._name,
            "of its own"
            if mode is None
            else f"{mode['size'][0]}x{mode['size'][1]} at up to {float(mode['fps']):.1f} Hz",
            camera.rate_hz,
        )

    def _configure(self, mode: Mapping[str, Any] | None, wanted: str) -> None:
        camera = self._camera
        sensor = {} if mode is None else {"sensor": {"output_size": mode["size"], "bit_depth": mode["bit_depth"]}}
        # One being exposed, one in the pipeline, one waiting, one in work.
        configuration = self._device.create_video_configuration(
            main={"size": (camera.width, camera.height), "format": wanted},
            **sensor,
            buffer_count=4,
            queue=False,
            controls=self._controls(camera),
        )
        self._device.configure(configuration)
        given = self._device.camera_configuration()["main"]
        size, self._format = tuple(given["size"]), given["format"]
        if size != (camera.width, camera.height):
            raise DeviceError(
                f"camera {self._name}: delivers {size[0]}x{size[1]} instead of {camera.width}x{camera.height}; "
                "set width and height in rig.toml to a size that it has"
            )
        if self._format not in _FORMATS:
            raise DeviceError(
                f"camera {self._name}: delivers pixels as {self._format}; RHOT needs one of {', '.join(_FORMATS)}"
            )

    def _controls(self, settings: CameraConfig | CameraSettings) -> dict[str, Any]:
        if self._modules is None:
            raise DeviceError(f"camera {self._name}: not open; start it first")
        controls = locked_controls(self._modules.controls, self._camera, self._name, settings, self._offered)
        self._exposure_s = settings.exposure_s
        # Frames until new exposure and gain have passed through the sensor's pipeline.
        self._settling = 8
        frame_us, exposure_us = 1e6 / self._camera.rate_hz, 1e6 * settings.exposure_s
        self._expected = {"ExposureTime": exposure_us, "AnalogueGain": settings.gain, "FrameDuration": frame_us}
        return controls

    def _frame(self, request: Any) -> Frame | None:
        """Return the frame of a request; None, with the request released, for a frame that is not used."""
        metadata = request.get_metadata()
        exposure_s = 1e-6 * float(metadata.get("ExposureTime", 1e6 * self._exposure_s))
        t_first_row_ns = int(metadata["SensorTimestamp"]) + self._offset_ns() - round(1e9 * exposure_s)
        self._check(metadata)
        if t_first_row_ns < self._start_ns or self._awaits_server(metadata, t_first_row_ns):
            request.release()
            return None
        if self._origin_ns is None:
            self._origin_ns = t_first_row_ns
        # The index follows from the time, so that frames lost in the camera stack leave a gap.
        number = round((t_first_row_ns - self._origin_ns) / self._frame_ns)
        self._index = max(self._index + 1, number)
        return Frame(self._image(request), self._index, t_first_row_ns, exposure_s, self._readout_s)

    def _awaits_server(self, metadata: Mapping[str, Any], t_ns: int) -> bool:
        """Return whether to discard a frame until the camera is synchronised; after `_SYNC_WAIT_S` set `problem`."""
        if self._camera.sync == "off" or metadata.get("SyncReady", True):
            if self._problem:
                logger.info("camera %s: is synchronised", self._name)
            self._unsynchronised_since_ns, self._problem = None, ""
            return False
        if self._unsynchronised_since_ns is None:
            self._unsynchronised_since_ns = t_ns
        if not self._problem and t_ns - self._unsynchronised_since_ns > _SYNC_WAIT_S * 1e9:
            self._problem = (
                f'camera {self._name}: sync = "{self._camera.sync}" in rig.toml, but nothing was heard of the other '
                f"cameras for {_SYNC_WAIT_S:.0f} s; its pictures are used unsynchronised. Start the camera with sync = "
                '"server" in the same network (it speaks by UDP multicast), or set sync = "off"'
            )
            logger.warning("%s", self._problem)
        return not self._problem

    def _image(self, request: Any) -> np.ndarray[Any, np.dtype[np.uint8]]:
        if self._modules is None:
            raise DeviceError(f"camera {self._name}: not open; start it first")
        mapped = self._modules.picamera2.MappedArray(request, "main", write=False)
        mapped.__enter__()

        def give_back() -> None:
            mapped.__exit__(None, None, None)
            request.release()

        if self._format != _FORMATS[0]:
            swapped: np.ndarray[Any, np.dtype[np.uint8]] = cv2.cvtColor(mapped.array, cv2.COLOR_RGB2BGR)
            give_back()
            return swapped
        # The buffer is returned when the last view of the image is released; nothing is copied. The lease is needed,
        # because numpy views may refer directly to the owner of the memory, which is then the lease.
        lease = _Lease(mapped.array)
        weakref.finalize(lease, give_back)
        return np.asarray(lease)

    def _check(self, metadata: Mapping[str, Any]) -> None:
        """Compare the reported with the requested settings, once, when new settings have taken effect."""
        if self._settling == 0:
            return
        self._settling -= 1
        if self._settling:
            return
        if refused := differences(metadata, self._expected):
            logger.warning("camera %s: the camera runs with %s", self._name, ", ".join(refused))
