"""A stand-in for SteamVR with the names, constants and return values of pyopenvr 2.12.

Follows openvr.h and its issues:

- Poses are asked for in `TrackingUniverseStanding`, a space that people move while everything runs: "Reset standing
  position" sends `VREvent_StandingZeroPoseReset` (808) and changes `GetRawZeroPoseToStandingAbsoluteTrackingPose`; a
  new room setup sends `VREvent_ChaperoneUniverseHasChanged` (801) and changes `Prop_CurrentUniverseId_Uint64` of the
  headset. From then on the same device at the same place has another pose. Not every recentring sends its event (issues
  1807 and 1892: none with Steam Link), and nothing tells of what was changed while SteamVR was down.
- A background application that does not acknowledge `VREvent_Quit` is killed.
- Calls are answered by another process, vrserver: they hang when it does (`hang`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray


class OpenVRError(Exception):
    """The base of pyopenvr's errors."""


class FakeMatrix:
    """HmdMatrix34_t."""

    def __init__(self) -> None:
        self.m = np.hstack([np.eye(3), np.zeros((3, 1))]).tolist()


class FakePose:
    """TrackedDevicePose_t, also as a ctypes-like array type: `TrackedDevicePose_t * 64` makes 64 of them."""

    def __init__(self) -> None:
        self.mDeviceToAbsoluteTracking = FakeMatrix()
        self.eTrackingResult = 1
        self.bPoseIsValid = False
        self.bDeviceIsConnected = False


class _PoseType:
    def __mul__(self, count: int) -> Callable[[], list[FakePose]]:
        return lambda: [FakePose() for _ in range(count)]


@dataclass
class FakeDevice:
    """A device as the test wants it."""

    serial: str
    kind: int
    T: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    connected: bool = True
    valid: bool = True
    result: int = 200


class FakeSteamVr:
    """SteamVR as the tests drive it, and the `openvr` module in front of it."""

    OpenVRError = OpenVRError
    VRApplication_Background = 3
    TrackingUniverseStanding = 1
    k_unMaxTrackedDeviceCount = 64  # noqa: N815
    TrackedDeviceClass_HMD = 1
    TrackedDeviceClass_Controller = 2
    TrackedDeviceClass_GenericTracker = 3
    TrackedDeviceClass_TrackingReference = 4
    Prop_SerialNumber_String = 1002
    TrackingResult_Running_OK = 200
    TrackingResult_Running_OutOfRange = 201
    VREvent_Quit = 700
    VREvent_TrackedDeviceActivated = 100
    TrackedDevicePose_t = _PoseType()

    def __init__(self) -> None:
        self.running = True
        self.devices: dict[int, FakeDevice] = {}
        self.events: list[int] = []
        self.properties_ready = True
        self.initialised = 0
        self.shut_down = 0
        self.acknowledged = 0
        self.serials_asked = 0
        self.universe = 1
        self.T_standing_raw = np.eye(4)
        self.tells_space = True
        self.hang: threading.Event | None = None
        self.hanging = threading.Event()

    def reset_standing_position(self, x: float, *, tells: bool = True) -> None:
        """Move the standing space by x metres: all devices stand elsewhere in it."""
        moved = np.eye(4)
        moved[0, 3] = -x
        self.T_standing_raw = moved @ self.T_standing_raw
        for device in self.devices.values():
            device.T = moved @ device.T
        if tells:
            self.events.append(808)

    def set_up_room(self) -> None:
        """Run the room setup: another universe."""
        self.universe += 1
        self.events.append(801)

    def init(self, application: int) -> FakeSteamVr:
        assert application == self.VRApplication_Background
        if not self.running:
            raise OpenVRError
        self.initialised += 1
        return self

    def shutdown(self) -> None:
        self.shut_down += 1

    @staticmethod
    def VREvent_t() -> Any:
        return SimpleNamespace(eventType=0)

    def pollNextEvent(self, event: Any) -> bool:
        if not self.events:
            return False
        event.eventType = self.events.pop(0)
        return True

    def acknowledgeQuit_Exiting(self) -> None:
        self.acknowledged += 1

    def getTrackedDeviceClass(self, index: int) -> int:
        return self.devices[index].kind

    def getStringTrackedDeviceProperty(self, index: int, prop: int) -> str:
        assert prop == self.Prop_SerialNumber_String
        self.serials_asked += 1
        if not self.properties_ready:
            raise OpenVRError
        return self.devices[index].serial

    def getUint64TrackedDeviceProperty(self, index: int, prop: int) -> int:
        assert (index, prop) == (0, 2004)
        if not self.tells_space:
            raise OpenVRError
        return self.universe

    def getRawZeroPoseToStandingAbsoluteTrackingPose(self) -> FakeMatrix:
        matrix = FakeMatrix()
        matrix.m = self.T_standing_raw[:3].tolist()
        return matrix

    def getDeviceToAbsoluteTrackingPose(self, origin: int, seconds: float, poses: list[FakePose]) -> list[FakePose]:
        assert origin == self.TrackingUniverseStanding
        assert seconds == 0.0
        if self.hang is not None:
            self.hanging.set()
            self.hang.wait()
        for index, pose in enumerate(poses):
            device = self.devices.get(index)
            pose.bDeviceIsConnected = device is not None and device.connected
            pose.bPoseIsValid = device is not None and device.connected and device.valid
            if device is not None:
                pose.eTrackingResult = device.result
                pose.mDeviceToAbsoluteTracking.m = device.T[:3].tolist()
        return poses
