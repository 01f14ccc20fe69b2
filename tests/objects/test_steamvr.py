from __future__ import annotations

import importlib
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from rhot.errors import DeviceError
from rhot_objects.sources.steamvr import SteamVrSource, import_openvr

SECOND = 1_000_000_000


def opened(steamvr: Any, ids: dict[str, str] | None = None) -> SteamVrSource:
    source = SteamVrSource({"LHR-CUP": "cup"} if ids is None else ids, load=lambda: steamvr)
    source.open(0)
    return source


def test_trackers_come_by_serial_number_and_the_headset_as_head(steamvr: Any) -> None:
    # A listed tracker has its id, an unlisted one its serial as far as a key can hold it; controllers and base
    # stations stay out.
    assert set(opened(steamvr).read(5)) == {"head", "cup", "LHR_ODD_1"}


def test_any_listed_device_is_an_object(steamvr: Any) -> None:
    assert set(opened(steamvr, {"LHR-CONTROL": "wand"}).read(5)) == {"head", "wand", "LHR-CUP", "LHR_ODD_1"}


def test_a_tracker_can_stand_for_the_head(steamvr: Any) -> None:
    steamvr.devices[3].T[0, 3] = 2.0
    samples = opened(steamvr, {"LHR-CUP": "head"}).read(5)
    assert set(samples) == {"head", "LHR_ODD_1"}
    assert samples["head"].pose.position[0] == 2.0


def test_the_matrix_becomes_position_and_quaternion(steamvr: Any) -> None:
    # x to y, y to z, z to x: a third of a turn about (1, 1, 1).
    steamvr.devices[3].T = np.array([[0, 0, 1, 0.1], [1, 0, 0, 1.2], [0, 1, 0, -0.3], [0, 0, 0, 1.0]])
    sample = opened(steamvr).read(42)["cup"]
    assert sample.t_ns == 42
    np.testing.assert_allclose(sample.pose.position, (0.1, 1.2, -0.3))
    np.testing.assert_allclose(sample.pose.orientation_xyzw, (0.5, 0.5, 0.5, 0.5), atol=1e-12)


@pytest.mark.parametrize("change", [{"valid": False}, {"result": 201}, {"result": 101}, {"connected": False}])
def test_only_what_is_really_tracked_is_reported(steamvr: Any, change: dict[str, Any]) -> None:
    source = opened(steamvr)
    for name, value in change.items():
        setattr(steamvr.devices[3], name, value)
    assert "cup" not in source.read(5)


def test_a_matrix_that_is_no_rotation_counts_as_not_tracked(steamvr: Any) -> None:
    steamvr.devices[3].T = np.zeros((4, 4))
    steamvr.devices[4].T = np.full((4, 4), np.nan)
    assert set(opened(steamvr).read(5)) == {"head"}


def test_devices_may_be_plugged_in_and_swapped(steamvr: Any) -> None:
    cup = steamvr.devices.pop(3)
    source = opened(steamvr)
    assert "cup" not in source.read(1)
    steamvr.devices[3] = cup
    assert "cup" in source.read(2)
    # The slot is taken over by another device.
    cup.connected = False
    source.read(3)
    steamvr.devices[3] = type(cup)("LHR-NEW", 3)
    assert set(source.read(4)) == {"head", "LHR-NEW", "LHR_ODD_1"}


def test_a_device_without_properties_is_asked_again(steamvr: Any) -> None:
    steamvr.properties_ready = False
    source = opened(steamvr)
    assert source.read(1) == {}
    steamvr.properties_ready = True
    assert "cup" in source.read(2)


def test_serial_numbers_are_asked_once(steamvr: Any) -> None:
    source = opened(steamvr)
    for now_ns in range(10):
        source.read(now_ns)
    assert steamvr.serials_asked == len(steamvr.devices)


def test_other_events_do_not_disturb(steamvr: Any) -> None:
    source = opened(steamvr)
    steamvr.events = [steamvr.VREvent_TrackedDeviceActivated] * 3
    assert "cup" in source.read(1)
    assert steamvr.events == []


def test_when_steamvr_quits_it_is_let_go_and_found_again(steamvr: Any) -> None:
    source = opened(steamvr)
    steamvr.events = [steamvr.VREvent_Quit]
    with pytest.raises(DeviceError, match="SteamVR is quitting"):
        source.read(1)
    assert (steamvr.acknowledged, steamvr.shut_down) == (1, 1)
    source.close()
    assert steamvr.shut_down == 1
    steamvr.running = False
    with pytest.raises(DeviceError, match="start SteamVR"):
        source.open(2)
    steamvr.running = True
    source.open(3)
    assert "cup" in source.read(4)


def test_closing_waits_for_a_read_on_another_thread(steamvr: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    source = opened(steamvr)
    reading, go_on, order = threading.Event(), threading.Event(), []
    real = steamvr.getDeviceToAbsoluteTrackingPose

    def slow(*arguments: Any) -> Any:
        reading.set()
        assert go_on.wait(10)
        order.append("read")
        return real(*arguments)

    monkeypatch.setattr(steamvr, "getDeviceToAbsoluteTrackingPose", slow)
    monkeypatch.setattr(steamvr, "shutdown", lambda: order.append("shutdown"))
    with ThreadPoolExecutor(2) as threads:
        read = threads.submit(source.read, 1)
        assert reading.wait(10)
        close = threads.submit(source.close)
        with pytest.raises(TimeoutError):
            close.result(timeout=0.05)
        go_on.set()
        assert "cup" in read.result(10)
        close.result(10)
    assert order == ["read", "shutdown"]
    with pytest.raises(DeviceError, match="open the source first"):
        source.read(2)


def test_a_steamvr_that_crashed_is_noticed(steamvr: Any) -> None:
    source = opened(steamvr)
    assert source.read(0)
    steamvr.devices.clear()
    assert source.read(5 * SECOND) == {}
    with pytest.raises(DeviceError, match="no device for 5 s"):
        source.read(5 * SECOND + 1)
    assert steamvr.shut_down == 1


def test_unknown_error_codes_of_newer_versions_are_device_errors(steamvr: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    # pyopenvr's `check_error_value` looks codes up in a dictionary.
    def init(_: int) -> None:
        raise KeyError(4711)

    monkeypatch.setattr(steamvr, "init", init)
    with pytest.raises(DeviceError, match="start SteamVR"):
        opened(steamvr)


def test_a_missing_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openvr", None)
    with pytest.raises(DeviceError, match=r"pip install 'rhot\[steamvr\]'"):
        SteamVrSource({}).open(0)


def test_a_library_that_does_not_load_is_a_device_error(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.import_module

    def refuse(name: str, package: str | None = None) -> Any:
        if name == "openvr":
            raise OSError("libopenvr_api_64.so: wrong ELF class")
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(DeviceError, match=r"wrong ELF class.*where SteamVR runs"):
        import_openvr()


def test_reading_before_opening_is_a_device_error() -> None:
    with pytest.raises(DeviceError, match="open the source first"):
        SteamVrSource({}).read(0)
