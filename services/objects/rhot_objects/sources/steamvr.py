"""Vive trackers and the headset through SteamVR, by the `openvr` package (pyopenvr).

SteamVR's standing space: metres, right-handed, y up, −z forward; a device's pose is a row-major 3x4 matrix
(`HmdMatrix34_t`) that maps device coordinates to that space.
"""

from __future__ import annotations

import importlib
import logging
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rhot.errors import DeviceError
from rhot_objects.pose import Pose, angle_between
from rhot_objects.sources import HEAD, PoseSample, SpaceMovedError

# The pose of SteamVR's standing space, for which a registration is valid.
#
# `GetRawZeroPoseToStandingAbsoluteTrackingPose` is the transform from the base stations' raw space to the standing
# space. Resetting the standing position changes it (event `VREvent_StandingZeroPoseReset`, 808); other base stations
# or a new room setup create another raw space with another universe (`VREvent_ChaperoneUniverseHasChanged`, 801).
# Names and numbers are from openvr.h.

MOVED_EVENTS: Final = {801: "its universe has changed", 808: "its standing position was reset"}
_CURRENT_UNIVERSE: Final = 2004
"""`Prop_CurrentUniverseId_Uint64`."""
_SAME_M: Final = 1e-3
_SAME_RAD: Final = 1e-3
"""Tolerances for an unchanged space; far below the error of a registration (docs/tested.md: 1.4 mm)."""


@dataclass(frozen=True, slots=True)
class TrackingSpace:
    """A standing space.

    Attributes:
        universe: id of the base stations' setup.
        T_standing_raw: maps the base stations' space to the standing space.
    """

    universe: int
    T_standing_raw: Pose

    def moved_from(self, other: TrackingSpace) -> str:
        """Return a description of the difference from an earlier space; empty when there is none."""
        if self.universe != other.universe:
            return MOVED_EVENTS[801]
        first, second = self.T_standing_raw, other.T_standing_raw
        distance_m = float(np.linalg.norm(first.position - second.position))
        if distance_m > _SAME_M or angle_between(first, second) > _SAME_RAD:
            return f"{MOVED_EVENTS[808]}, by {distance_m:.2f} m"
        return ""


def read_space(openvr: Any, system: Any) -> TrackingSpace | None:
    """Return SteamVR's standing space; None if SteamVR does not report it."""
    try:
        # `k_unTrackedDeviceIndex_Hmd`.
        universe = int(system.getUint64TrackedDeviceProperty(0, _CURRENT_UNIVERSE))
        matrix = system.getRawZeroPoseToStandingAbsoluteTrackingPose()
        return TrackingSpace(universe, Pose.from_matrix([[matrix.m[row][k] for k in range(4)] for row in range(3)]))
    except (openvr.OpenVRError, KeyError, ValueError):
        # KeyError: error codes that pyopenvr does not know.
        return None


logger = logging.getLogger(__name__)

_SILENCE_NS: Final = 5_000_000_000
"""Time without any connected device after which to reconnect: a SteamVR that crashed sends no event."""


def import_openvr() -> Any:
    """Return the `openvr` module.

    Raises:
        DeviceError: the package is not installed or its library does not load here.
    """
    try:
        return importlib.import_module("openvr")
    except ImportError as error:
        raise DeviceError(
            "SteamVR trackers need the Python package `openvr`; install it with: pip install 'rhot[steamvr]'"
        ) from error
    except (OSError, ValueError) as error:
        raise DeviceError(
            f"the package `openvr` cannot load its library on this machine: {error}; run `rhot objects` on the machine "
            "where SteamVR runs (Windows or Linux on x86-64)"
        ) from error


class SteamVrSource:
    """All trackers that SteamVR knows, by serial number, and the headset.

    A device with a listed serial number, of any kind, is published under its object id. A tracker that is not listed is
    published under its serial number, so that new ones can be found on the bus; the headset is `head`. Devices may
    appear and disappear at any time.
    """

    def __init__(self, ids_by_serial: Mapping[str, str], load: Callable[[], Any] = import_openvr) -> None:
        """Set the ids of the devices.

        Args:
            ids_by_serial: serial number to object id.
            load: returns the `openvr` module.
        """
        self._ids_by_serial = dict(ids_by_serial)
        self._load = load
        self._openvr: Any = None
        self._system: Any = None
        self._poses: Any = None
        self._event: Any = None
        self._ids_by_index: dict[int, str | None] = {}
        self._last_connected_ns: int | None = None
        # Kept when SteamVR restarts, to detect a new room setup in between.
        self._space: TrackingSpace | None = None
        self._has_tracked = False
        self._moved = ""
        self._asks_space = True
        # `close` unloads SteamVR's library, so it must not run during a `read` on another thread.
        self._lock = threading.RLock()

    def open(self, start_ns: int) -> None:
        """Connect to a running SteamVR.

        Raises:
            DeviceError: the package or SteamVR is absent; says what to install or start.
        """
        openvr = self._load()
        with self._lock:
            self._connect(openvr)
        logger.info("connected to SteamVR")

    def _connect(self, openvr: Any) -> None:
        try:
            # A background application neither starts SteamVR nor keeps it from quitting.
            self._system = openvr.init(openvr.VRApplication_Background)
        except (openvr.OpenVRError, KeyError) as error:
            # KeyError: pyopenvr's table of errors lacks those of newer versions of SteamVR.
            # Many of pyopenvr's errors have no text but their name, such as InitError_Init_NoServerForBackgroundApp.
            reason = f"{type(error).__name__} {error}".rstrip()
            raise DeviceError(
                f"SteamVR does not answer ({reason}); start SteamVR on this machine and switch the trackers on"
            ) from error
        self._openvr = openvr
        self._poses = (openvr.TrackedDevicePose_t * openvr.k_unMaxTrackedDeviceCount)()
        self._event = openvr.VREvent_t()
        self._ids_by_index = {}
        self._last_connected_ns = None
        self._asks_space = True

    def read(self, now_ns: int) -> Mapping[str, PoseSample]:
        """Return the current poses of all tracked devices.

        Raises:
            DeviceError: SteamVR is quitting, or has no connected device any more.
            SpaceMovedError: the standing space has moved since the first pose.
        """
        with self._lock:
            if self._system is None:
                raise DeviceError("not connected to SteamVR; open the source first")
            self._take_events()
            samples = self._read_devices(now_ns)
            if samples and self._asks_space:
                self._check_space()
            return samples

    def _read_devices(self, now_ns: int) -> dict[str, PoseSample]:
        openvr = self._openvr
        # 0 seconds of prediction: the pose at the moment of the call.
        poses = self._system.getDeviceToAbsoluteTrackingPose(openvr.TrackingUniverseStanding, 0.0, self._poses)
        samples: dict[str, PoseSample] = {}
        connected = False
        for index in range(openvr.k_unMaxTrackedDeviceCount):
            device = poses[index]
            if not device.bDeviceIsConnected:
                self._ids_by_index.pop(index, None)
                continue
            connected = True
            if not device.bPoseIsValid or device.eTrackingResult != openvr.TrackingResult_Running_OK:
                continue
            object_id = self._id_of(index)
            pose = _pose_of(device.mDeviceToAbsoluteTracking) if object_id is not None else None
            if object_id is not None and pose is not None:
                samples[object_id] = PoseSample(now_ns, pose)
        self._check_silence(now_ns, connected)
        return samples

    def close(self) -> None:
        """Disconnect from SteamVR."""
        with self._lock:
            if self._system is not None:
                self._system = None
                self._openvr.shutdown()

    def _take_events(self) -> None:
        while self._system.pollNextEvent(self._event):
            if self._event.eventType == self._openvr.VREvent_Quit:
                # Without the acknowledgement SteamVR would kill this process.
                self._system.acknowledgeQuit_Exiting()
                self.close()
                raise DeviceError("SteamVR is quitting; start it again and tracking goes on by itself")
            if self._event.eventType in MOVED_EVENTS and self._has_tracked:
                self._moved, self._asks_space = MOVED_EVENTS[self._event.eventType], True

    def _check_space(self) -> None:
        """Compare the standing space with the former one, because SteamVR also sends events without a change."""
        space, before = read_space(self._openvr, self._system), self._space
        moved = self._moved
        if space is not None and before is not None:
            moved = space.moved_from(before)
        # If SteamVR does not report its space, the known one is kept and compared at the next report.
        keeps = space is None and before is not None and not moved
        self._space, self._asks_space = (before, True) if keeps else (space, False)
        self._has_tracked, self._moved = True, ""
        if moved:
            raise SpaceMovedError(
                f"SteamVR's standing space has moved ({moved}): its registration no longer says where it is, so that "
                "neither objects nor headset are published. Run `rhot stop` and `rhot start`, then register it again: "
                "`rhot calibrate objects --live` (a few places are enough with --realign)"
            )

    def _check_silence(self, now_ns: int, connected: bool) -> None:
        if connected or self._last_connected_ns is None or now_ns < self._last_connected_ns:
            self._last_connected_ns = now_ns
        elif now_ns - self._last_connected_ns > _SILENCE_NS:
            self.close()
            raise DeviceError(
                f"SteamVR has had no device for {_SILENCE_NS / 1e9:.0f} s; is it still running, and are the headset, "
                "the base stations and the trackers switched on?"
            )

    def _id_of(self, index: int) -> str | None:
        """Return the id of a connected device; None if it is not published."""
        if index not in self._ids_by_index:
            openvr = self._openvr
            try:
                serial = self._system.getStringTrackedDeviceProperty(index, openvr.Prop_SerialNumber_String)
            except (openvr.OpenVRError, KeyError):
                # A device that was just connected has no properties yet; the next read tries again.
                return None
            if not serial:
                return None
            kind = self._system.getTrackedDeviceClass(index)
            self._ids_by_index[index] = self._choose_id(serial, kind)
            logger.info("SteamVR device %s is %s", serial, self._ids_by_index[index] or "not used")
        return self._ids_by_index[index]

    def _choose_id(self, serial: str, kind: int) -> str | None:
        if serial in self._ids_by_serial:
            return self._ids_by_serial[serial]
        if kind == self._openvr.TrackedDeviceClass_HMD and HEAD not in self._ids_by_serial.values():
            return HEAD
        if kind == self._openvr.TrackedDeviceClass_GenericTracker:
            return re.sub(r"[^A-Za-z0-9_.-]", "_", serial)[:64]
        return None


def _pose_of(matrix: Any) -> Pose | None:
    """Return the pose in a `HmdMatrix34_t`; None if it is not a rigid transform."""
    rows = [[float(matrix.m[row][column]) for column in range(4)] for row in range(3)]
    try:
        return Pose.from_matrix(np.array(rows))
    except ValueError:
        return None
