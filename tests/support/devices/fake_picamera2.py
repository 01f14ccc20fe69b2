"""picamera2 with its queue of jobs and its stop that waits behind them.

Follows `picamera2/picamera2.py` of raspberrypi/picamera2 (0.3.31):

- `capture_request(wait=False)` appends a job to `_job_list` and returns it; the camera's event loop executes the first
  job only, again and again until it is done, and a capture is done only when a request has been completed
  (`process_requests`, `capture_request_`).
- `stop()` with a running event loop dispatches a job, too, and waits for it *without a limit*
  (`dispatch_functions([self.stop_], wait=True, immediate=True)`): behind a capture that never completes, because the
  sensor has gone silent, it waits for ever (issue 1264, "stop_recording() stuck").
- `cancel_all_and_flush()` (pull request 1069, "Timeout cancel") cancels all jobs and empties the queue; it exists "for
  tidying up after an operation has unexpectedly timed out (for example, the camera cable has become dislodged) so that
  the camera can be closed". `Job.get_result(timeout)` raises `concurrent.futures.TimeoutError` and `CancelledError`.
- Even then the kernel may keep `stop` (issue 1275: `vb2_wait_for_all_buffers` blocked for minutes): `stop_hangs`.
- With `SyncMode` set, metadata hold `SyncReady`; for a client that hears no server it stays false for ever
  (libcamera `control_ids_rpi.yaml`, SyncReady and SyncTimer).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import numpy as np

from rhot_capture.sources.libcamera import PicameraModules

MODES = [{"size": (640, 480), "bit_depth": 10, "fps": 103.33, "crop_limits": (1000, 752, 1280, 960)}]
CONTROLS = SimpleNamespace(
    draft=SimpleNamespace(NoiseReductionModeEnum=SimpleNamespace(Off="noise off")),
    AfModeEnum=SimpleNamespace(Manual="manual focus"),
    rpi=SimpleNamespace(SyncModeEnum=SimpleNamespace(Server="server", Client="client")),
)


PI_CONTROLS = (
    *("AeEnable", "AwbEnable", "ColourGains", "ExposureTime", "AnalogueGain", "FrameDurationLimits"),
    *("NoiseReductionMode", "SyncMode", "AfMode"),
)
"""What every camera of a Pi offers beside picture and focus (libcamera's Raspberry Pi pipeline)."""


class Job:
    """`picamera2.job.Job`."""

    def __init__(self, function: Callable[[], tuple[bool, Any]]) -> None:
        self._function = function
        self._future: Future[Any] = Future()
        self._future.set_running_or_notify_cancel()
        self.cancelled = False

    def execute(self) -> bool:
        done, result = self._function()
        if done and not self._future.done():
            self._future.set_result(result)
        return done

    def cancel(self) -> None:
        from concurrent.futures import CancelledError

        self.cancelled = True
        if not self._future.done():
            self._future.set_exception(CancelledError())

    def get_result(self, timeout: float | None = None) -> Any:
        return self._future.result(timeout)


class Request:
    """A completed request: metadata, and a buffer that goes back with `release`."""

    def __init__(self, t_ns: int, exposure_us: float, more: dict[str, Any]) -> None:
        self.pixels = np.zeros((480, 640, 3), np.uint8)
        self.released = 0
        self._metadata = {"SensorTimestamp": t_ns, "ExposureTime": exposure_us, **more}

    def get_metadata(self) -> dict[str, Any]:
        return dict(self._metadata)

    def release(self) -> None:
        self.released += 1


class MappedArray:
    """`picamera2.MappedArray` of the main stream."""

    def __init__(self, request: Request, stream: str, write: bool) -> None:
        self.array = request.pixels

    def __enter__(self) -> MappedArray:
        return self

    def __exit__(self, *_: object) -> None:
        return


class FakePicamera2:
    """One camera; the test shows it frames with `complete`."""

    present: list[dict[str, str]] = [{"Model": "imx219"}]

    def __init__(self, number: int = 0) -> None:
        self.number = number
        self.sensor_modes = MODES
        self.camera_controls: dict[str, Any] = {
            **dict.fromkeys(PI_CONTROLS),
            "Saturation": (0.0, 32.0, 1.0),
            "Contrast": (0.0, 32.0, 1.0),
            "Brightness": (-1.0, 1.0, 0.0),
        }
        self.calls: list[str] = []
        self.stop_hangs = False
        self.fails: dict[str, Exception] = {}
        self._lock = threading.RLock()
        self._jobs: list[Job] = []
        self._completed: list[Request] = []
        self._configuration: dict[str, Any] = {}
        self._woken = threading.Condition(self._lock)
        self._ended = False
        self._hung = threading.Event()
        # picamera2's NullPreview: an event loop on a daemon thread.
        threading.Thread(target=self._loop, name="fake picamera2", daemon=True).start()

    def global_camera_info(self) -> list[dict[str, str]]:
        return self.present

    def modules(self) -> PicameraModules:
        """What `import_picamera` would return, with this camera as the only one."""

        def make(number: int) -> FakePicamera2:
            self._raise("open")
            return self

        make.global_camera_info = self.global_camera_info  # type: ignore[attr-defined]
        return PicameraModules(SimpleNamespace(Picamera2=make, MappedArray=MappedArray), CONTROLS)

    def complete(self, t_ns: int, exposure_us: float = 4000.0, **more: Any) -> Request:
        """Let the sensor deliver a frame."""
        request = Request(t_ns, exposure_us, more)
        with self._lock:
            self._completed.append(request)
            self._woken.notify_all()
        return request

    def create_video_configuration(self, **values: Any) -> dict[str, Any]:
        return values

    def configure(self, configuration: dict[str, Any]) -> None:
        self._raise("configure")
        self._configuration = configuration

    def camera_configuration(self) -> dict[str, Any]:
        return self._configuration

    def set_controls(self, controls: dict[str, Any]) -> None:
        self._raise("set_controls")

    def start(self) -> None:
        self._raise("start")
        self.calls.append("start")

    def capture_request(self, wait: bool) -> Job:
        assert wait is False
        return self._dispatch(self._capture_request)

    def cancel_all_and_flush(self) -> None:
        self.calls.append("flush")
        with self._lock:
            for job in self._jobs:
                job.cancel()
            self._jobs.clear()

    def stop(self) -> None:
        self._dispatch(self._stop).get_result()

    def close(self) -> None:
        self.calls.append("close")
        self.end()

    def end(self) -> None:
        """End the event loop, and what hangs in the kernel."""
        self._hung.set()
        with self._lock:
            self._ended = True
            self._woken.notify_all()

    def _raise(self, call: str) -> None:
        if call in self.fails:
            raise self.fails[call]

    def _dispatch(self, function: Callable[[], tuple[bool, Any]]) -> Job:
        job = Job(function)
        with self._lock:
            if self._ended:
                # The test is over; real jobs would wait for ever.
                job.cancel()
            self._jobs.append(job)
            self._woken.notify_all()
        return job

    def _capture_request(self) -> tuple[bool, Any]:
        return (True, self._completed.pop(0)) if self._completed else (False, None)

    def _stop(self) -> tuple[bool, Any]:
        if self.stop_hangs:
            self._lock.release()
            self._hung.wait()
            self._lock.acquire()
        self.calls.append("stop")
        return True, None

    def _loop(self) -> None:
        with self._lock:
            while not self._ended:
                # Only the first job counts: as long as it is not done, nothing behind it is tried.
                while self._jobs and self._jobs[0].execute():
                    if self._jobs:
                        self._jobs.pop(0)
                self._woken.wait(0.5)
