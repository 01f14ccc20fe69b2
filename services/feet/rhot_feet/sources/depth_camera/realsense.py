"""Intel RealSense D400 cameras through pyrealsense2: colour, and depth brought onto the colour picture.

Times: in the `global_time` domain `get_timestamp` is the moment at which the camera began to send the picture, mapped
by the SDK to this machine's wall clock (librealsense issue 12779, pull request 3909). The metadata `frame_timestamp`
and `sensor_timestamp` are that moment and the middle of the exposure on the camera's own clock, so

    t_mid = get_timestamp − (frame_timestamp − sensor_timestamp).
"""

from __future__ import annotations

import importlib
import logging
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rhot.clock import difference_ns
from rhot.errors import DeviceError
from rhot.geometry.camera import CameraModel
from rhot.rig.feet_config import DepthCameraConfig
from rhot_feet.frames import DepthFrame, DepthImage, pinhole

# Finding a RealSense among those plugged in, setting up its sensors, and reading its lens.

_DEVICE_LOG = logging.getLogger(__name__)

Sdk = Any
"""The module `pyrealsense2`, or what stands in for it in tests."""

_BROWN_CONRADY: Final = ("brown_conrady", "modified_brown_conrady", "inverse_brown_conrady")
"""The SDK bends points by the same equation and order of coefficients as OpenCV for all of these, whatever their names
say (`rs2_project_point_to_pixel`; measured with 2.59, also for the inverse kind that D400 colour cameras report)."""


def devices_by_serial(sdk: Sdk, context: Any) -> dict[str, Any]:
    """Return serial number to device of the cameras that an SDK context sees."""
    serial = sdk.camera_info.serial_number
    # A camera whose firmware is being repaired has none.
    return {device.get_info(serial): device for device in context.query_devices() if device.supports(serial)}


def find_device(sdk: Sdk, context: Any, serial: str | None) -> Any:
    """Return the device of a serial number, or the only one.

    Raises:
        DeviceError: none, not this one, or several to choose from; names those that are there.
    """
    by_serial = devices_by_serial(sdk, context)
    names = [f"{number} ({device.get_info(sdk.camera_info.name)})" for number, device in by_serial.items()]
    if not by_serial:
        raise DeviceError(
            "no RealSense camera is plugged in; on Linux it also needs the SDK's udev rules, and a USB 3 port"
        )
    if serial is None:
        if len(by_serial) > 1:
            raise DeviceError(
                f"several RealSense cameras: {', '.join(names)}; set serial in [feet.camera] to one of them"
            )
        return next(iter(by_serial.values()))
    if serial in by_serial:
        return by_serial[serial]
    raise DeviceError(
        f"no RealSense with serial {serial}; there is {', '.join(names)}; correct serial in [feet.camera]"
    )


def is_usb2(sdk: Sdk, device: Any) -> bool:
    """Return whether a device hangs on USB 2."""
    descriptor = sdk.camera_info.usb_type_descriptor
    return bool(device.supports(descriptor)) and str(device.get_info(descriptor)).startswith("2")


def configure_sensors(sdk: Sdk, device: Any) -> None:
    """Let times come in the machine's clock and exposure not slow the pictures down; warn of old firmware and USB 2."""
    option, info = sdk.option, sdk.camera_info
    for sensor in device.query_sensors():
        # The colour camera would rather halve its rate in dim light than gain up.
        for name, value in ((option.global_time_enabled, 1.0), (option.auto_exposure_priority, 0.0)):
            if sensor.supports(name) and not sensor.is_option_read_only(name):
                try:
                    sensor.set_option(name, value)
                except RuntimeError as error:
                    _DEVICE_LOG.warning("RealSense: %s cannot be set: %s", name, error)
    if device.supports(info.firmware_version) and device.supports(info.recommended_firmware_version):
        has, wanted = device.get_info(info.firmware_version), device.get_info(info.recommended_firmware_version)
        if _version(has) < _version(wanted):
            _DEVICE_LOG.warning("RealSense: firmware %s is older than %s; update it with rs-fw-update", has, wanted)
    if is_usb2(sdk, device):
        _DEVICE_LOG.warning("RealSense is on USB 2: rates and sizes are limited; use a USB 3 port and cable")


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", text))


def camera_of(intrinsics: Any) -> CameraModel:
    """Return the camera of an SDK `intrinsics` (width, height, fx, fy, ppx, ppy, model, coeffs).

    Raises:
        DeviceError: a kind of lens that OpenCV's model cannot express.
    """
    K = np.array([[intrinsics.fx, 0.0, intrinsics.ppx], [0.0, intrinsics.fy, intrinsics.ppy], [0.0, 0.0, 1.0]])
    coefficients = np.array(intrinsics.coeffs, dtype=np.float64)
    # The enum's name, so that no SDK is needed here.
    model = str(intrinsics.model).rpartition(".")[2]
    if model == "none" or not coefficients.any():
        coefficients = np.empty(0)
    elif model not in _BROWN_CONRADY:
        raise DeviceError(
            f"RealSense: a colour lens of the kind {model} is not supported; use a camera of the D400 series"
        )
    return pinhole(int(intrinsics.width), int(intrinsics.height), K, coefficients)


_LOG = logging.getLogger(__name__)

_STALLED_AFTER_S: Final = 5.0
_MAX_SEND_DELAY_MS: Final = 200.0
"""Between the middle of an exposure and the sending of its picture; more is no such pair of timestamps."""


@dataclass(frozen=True, slots=True)
class DepthFiltering:
    """The SDK's own filters, in the order in which they are applied.

    Attributes:
        decimation: depth is halved, thirded, … by the median of so many pixels squared; 1 = off.
        spatial: edge-preserving smoothing within a picture.
        temporal_alpha: weight of the newest picture in the smoothing over time, 1 = off. It lags behind a moving foot
            by about 1/alpha − 1 pictures, so it is light; nothing is filled in from older pictures.
    """

    decimation: int = 2
    spatial: bool = True
    temporal_alpha: float = 0.7


def import_pyrealsense2() -> Sdk:
    """Return the `pyrealsense2` module.

    Raises:
        DeviceError: not installed here; says how to.
    """
    try:
        return importlib.import_module("pyrealsense2")
    except (ImportError, OSError) as error:
        install = "sudo apt install libusb-1.0-0" if "libusb" in str(error) else "pip install 'rhot[realsense]'"
        raise DeviceError(
            f"pyrealsense2 cannot be imported ({error}); install what is missing with: {install}, or set "
            'source = "recorded" or "simulated" in [feet.camera]'
        ) from error


class DepthPipeline:
    """Filters depth and brings it onto the colour picture; it keeps state from picture to picture."""

    def __init__(self, sdk: Sdk, filtering: DepthFiltering) -> None:
        self._stages: list[Any] = []
        option = sdk.option
        if filtering.decimation > 1:
            decimation = sdk.decimation_filter()
            decimation.set_option(option.filter_magnitude, float(filtering.decimation))
            self._stages.append(decimation)
        smoothing: list[Any] = []
        if filtering.spatial:
            smoothing.append(sdk.spatial_filter())
        if filtering.temporal_alpha < 1.0:
            temporal = sdk.temporal_filter()
            temporal.set_option(option.filter_smooth_alpha, filtering.temporal_alpha)
            temporal.set_option(option.holes_fill, 0.0)
            smoothing.append(temporal)
        if smoothing:
            # Noise is even in disparity, not in depth.
            self._stages += [sdk.disparity_transform(True), *smoothing, sdk.disparity_transform(False)]
        self._stages.append(sdk.align(sdk.stream.color))

    def process(self, frames: Any) -> Any:
        """Return the set of frames with depth filtered and aligned to colour."""
        for stage in self._stages:
            frames = stage.process(frames).as_frameset()
        return frames


class RealSenseSource:
    """A RealSense by serial number, or the only one that is plugged in."""

    def __init__(
        self,
        config: DepthCameraConfig,
        now_ns: Callable[[], int],
        *,
        filtering: DepthFiltering | None = None,
        load: Callable[[], Sdk] = import_pyrealsense2,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Prepare; `open` touches the device.

        Args:
            config: serial number, size and rate.
            now_ns: rig time.
            filtering: of the depth.
            load: imports the SDK; replaced in tests.
            wall_ns: this machine's wall clock, in which the SDK speaks.
        """
        self._config = config
        self._now_ns = now_ns
        self._wall_ns = wall_ns
        self._filtering = filtering or DepthFiltering()
        self._load = load
        self._sdk: Sdk = None
        # One for all calls: each context watches the USB bus by itself.
        self._context: Any = None
        self._pipeline: Any = None
        self._depth: DepthPipeline | None = None
        self._camera: CameraModel | None = None
        self._serial = ""
        self._last_ns = 0
        self._start_ns = 0
        self._warned = False
        # `close` tears the pipeline down: never below the feet of a `read` on another thread.
        self._lock = threading.RLock()

    @property
    def finished(self) -> bool:
        """Never: a camera has no end."""
        return False

    def open(self, start_ns: int) -> None:
        """Start streaming; frames before `start_ns` are thrown away.

        Raises:
            DeviceError: the SDK or the camera is absent, the camera is in use, or has no such mode.
        """
        with self._lock:
            self._sdk = self._load()
            if self._context is None:
                self._context = self._sdk.context()
            device = find_device(self._sdk, self._context, self._config.serial)
            self._serial = device.get_info(self._sdk.camera_info.serial_number)
            configure_sensors(self._sdk, device)
            self._start(device)
            self._start_ns, self._last_ns = start_ns, self._now_ns()
            self._warned = False

    def _start(self, device: Any) -> None:
        sdk, config = self._sdk, self._config
        request = sdk.config()
        request.enable_device(self._serial)
        rate = round(config.rate_hz)
        request.enable_stream(sdk.stream.depth, config.width, config.height, sdk.format.z16, rate)
        request.enable_stream(sdk.stream.color, config.width, config.height, sdk.format.bgr8, rate)
        pipeline = sdk.pipeline(self._context)
        try:
            profile = pipeline.start(request)
        except RuntimeError as error:
            hint = (
                "it is on USB 2, which has no room for this: use a USB 3 port and the cable that came with it"
                if is_usb2(sdk, device)
                else "set width, height and rate_hz in [feet.camera] to a mode it has (`rs-enumerate-devices`), and "
                "close other programs that use it"
            )
            raise DeviceError(
                f"RealSense {self._serial} refuses {config.width}x{config.height} at {rate} Hz ({error}); {hint}"
            ) from error
        self._pipeline = pipeline
        self._depth = DepthPipeline(sdk, self._filtering)
        self._camera = camera_of(profile.get_stream(sdk.stream.color).as_video_stream_profile().get_intrinsics())
        _LOG.info("RealSense %s: %dx%d at %d Hz", self._serial, config.width, config.height, rate)

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Wait for the next set of frames; the SDK keeps only the newest.

        Raises:
            DeviceError: unplugged, or silent.
        """
        with self._lock:
            if self._pipeline is None or self._depth is None or self._camera is None:
                return None
            try:
                arrived, frames = self._pipeline.try_wait_for_frames(max(1, round(1e3 * timeout_s)))
                frame = self._frame(self._depth.process(frames), self._camera) if arrived else None
            except RuntimeError as error:
                raise DeviceError(f"RealSense {self._serial}: {error}; it is looked for again") from error
            if arrived:
                self._last_ns = self._now_ns()
            else:
                self._check_silence()
            return None if frame is None or frame.t_ns < self._start_ns else frame

    def close(self) -> None:
        """Stop streaming."""
        with self._lock:
            pipeline, self._pipeline = self._pipeline, None
            if pipeline is not None:
                try:
                    pipeline.stop()
                except RuntimeError as error:
                    # A camera that was pulled out cannot be stopped.
                    _LOG.debug("RealSense %s: stop: %s", self._serial, error)

    def _check_silence(self) -> None:
        silent_s = 1e-9 * (self._now_ns() - self._last_ns)
        # Silence after which the SDK is asked whether the camera is still there.
        if silent_s < 1.0:
            return
        if self._serial not in devices_by_serial(self._sdk, self._context):
            raise DeviceError(
                f"RealSense {self._serial} was unplugged; plug it in again and tracking goes on by itself"
            )
        if silent_s >= _STALLED_AFTER_S:
            raise DeviceError(
                f"RealSense {self._serial} is there but sent no picture for {silent_s:.0f} s; try another USB 3 port "
                "or cable"
            )

    def _frame(self, frames: Any, camera: CameraModel) -> DepthFrame | None:
        color, depth = frames.get_color_frame(), frames.get_depth_frame()
        if not color:
            return None
        # Copied: the SDK fills its buffers again.
        picture = np.array(np.asanyarray(color.get_data()), dtype=np.uint8)
        return DepthFrame(
            self._t_ns(color), picture, _millimetres(depth) if depth else None, camera, int(color.get_frame_number())
        )

    def _t_ns(self, color: Any) -> int:
        """Return the middle of the exposure, rig clock."""
        sdk, metadata = self._sdk, self._sdk.frame_metadata_value
        wall_ms = float(color.get_timestamp())
        domain = color.get_frame_timestamp_domain()
        if domain == sdk.timestamp_domain.hardware_clock:
            wall_ms = 1e-6 * self._wall_ns()
        has_times = all(map(color.supports_frame_metadata, (metadata.frame_timestamp, metadata.sensor_timestamp)))
        if domain == sdk.timestamp_domain.global_time and has_times:
            sent_us, middle_us = map(color.get_frame_metadata, (metadata.frame_timestamp, metadata.sensor_timestamp))
            delay_ms = 1e-3 * (sent_us - middle_us)
            if 0.0 <= delay_ms <= _MAX_SEND_DELAY_MS:
                wall_ms -= delay_ms
        elif not self._warned:
            self._warned = True
            _LOG.warning(
                "RealSense %s gives no times of exposure; pictures are timed when they arrive, some milliseconds late "
                "(its frame metadata is off: on Windows run the SDK's realsense2_metadata script, on Linux apply its "
                "kernel patch)",
                self._serial,
            )
        return round(1e6 * wall_ms) + difference_ns(self._now_ns, self._wall_ns)


def _millimetres(depth: Any) -> DepthImage:
    raw: DepthImage = np.asanyarray(depth.get_data())
    unit_mm = 1e3 * float(depth.get_units())
    if abs(unit_mm - 1.0) < 1e-6:
        return np.array(raw, dtype=np.uint16)
    scaled: DepthImage = np.clip(np.rint(raw * unit_mm), 0, 65535).astype(np.uint16)
    return scaled
