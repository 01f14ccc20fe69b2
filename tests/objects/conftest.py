"""A stand-in for SteamVR with the names, constants and return values of pyopenvr 2.12."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
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

    def getDeviceToAbsoluteTrackingPose(self, origin: int, seconds: float, poses: list[FakePose]) -> list[FakePose]:
        assert origin == self.TrackingUniverseStanding
        assert seconds == 0.0
        for index, pose in enumerate(poses):
            device = self.devices.get(index)
            pose.bDeviceIsConnected = device is not None and device.connected
            pose.bPoseIsValid = device is not None and device.connected and device.valid
            if device is not None:
                pose.eTrackingResult = device.result
                pose.mDeviceToAbsoluteTracking.m = device.T[:3].tolist()
        return poses


@pytest.fixture
def steamvr() -> FakeSteamVr:
    """SteamVR with a headset, a base station, a controller and two trackers."""
    fake = FakeSteamVr()
    fake.devices = {
        0: FakeDevice("LHR-HEAD", 1),
        1: FakeDevice("LHB-BASE", 4),
        2: FakeDevice("LHR-CONTROL", 2),
        3: FakeDevice("LHR-CUP", 3),
        4: FakeDevice("LHR/ODD 1", 3),
    }
    return fake
