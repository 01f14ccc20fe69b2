"""SteamVR for the tests of objects."""

from __future__ import annotations

import pytest
from devices.fake_steamvr import FakeDevice, FakeSteamVr


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
