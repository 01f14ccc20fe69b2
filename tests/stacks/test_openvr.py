"""The driver of Vive trackers through OpenVR's own client library and its structures.

In place of SteamVR the library loads a small runtime of this test (`openvr_runtime/vrclient.c`). With
`RHOT_DEVICE=openvr` one test asks the SteamVR that runs here.
"""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from machine.stacks import DEVICE, needs_emulated
from numpy.typing import NDArray

from rhot.errors import DeviceError
from rhot_objects.sources import SpaceMovedError
from rhot_objects.sources.steamvr import SteamVrSource

pytest.importorskip("openvr", reason="OpenVR's client library needs: pip install 'rhot[steamvr]'", exc_type=ImportError)

SOURCE = Path(__file__).parent / "openvr_runtime" / "vrclient.c"
HMD, TRACKER, BASE_STATION = 1, 3, 4
QUIT, UNIVERSE_CHANGED, STANDING_RESET = 700, 801, 808


class Runtime:
    """The runtime that the client library loads, and the devices that it has."""

    def __init__(self, library: Path) -> None:
        # The same file as the client's: one library, one state.
        self._library = ctypes.CDLL(str(library))
        self._library.test_device.argtypes = (
            *(ctypes.c_uint32, ctypes.c_bool, ctypes.c_bool, ctypes.c_int32, ctypes.c_char_p),
            ctypes.POINTER(ctypes.c_float),
        )
        self._library.test_space.argtypes = (ctypes.c_uint64, ctypes.POINTER(ctypes.c_float))

    def device(
        self,
        index: int,
        kind: int,
        serial: str,
        T: NDArray[np.float64] | None = None,
        *,
        connected: bool = True,
        valid: bool = True,
    ) -> None:
        self._library.test_device(index, connected, valid, kind, serial.encode(), matrix(T))

    def space(self, universe: int, T: NDArray[np.float64] | None = None) -> None:
        self._library.test_space(universe, matrix(T))

    def event(self, kind: int) -> None:
        self._library.test_event(kind)

    def runs(self, runs: bool) -> None:
        self._library.test_server(runs)

    @property
    def quits_acknowledged(self) -> int:
        return int(self._library.test_quits_acknowledged())


def matrix(T: NDArray[np.float64] | None) -> ctypes.Array[ctypes.c_float]:
    rows = np.eye(4)[:3] if T is None else T[:3]
    return (ctypes.c_float * 12)(*rows.ravel().tolist())


def at(x: float, y: float, z: float, turn_rad: float = 0.0) -> NDArray[np.float64]:
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return np.array([[c, 0.0, s, x], [0.0, 1.0, 0.0, y], [-s, 0.0, c, z], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runtime, compiled."""
    needs_emulated("it is SteamVR's own")
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler is installed, to make the runtime that OpenVR's client loads")
    folder = tmp_path_factory.mktemp("openvr") / "bin" / "linux64"
    folder.mkdir(parents=True)
    made = folder / "vrclient.so"
    warnings = ["-Wall", "-Wextra", "-Werror"]
    subprocess.run([compiler, "-std=c11", *warnings, "-O1", "-shared", "-fPIC", SOURCE, "-o", made], check=True)
    return made


def register(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the client find a runtime in a folder, by a registry like the one that SteamVR writes."""
    registry = folder / "openvrpaths.vrpath"
    paths = {name: [str(folder)] for name in ("runtime", "config", "log")}
    registry.write_text(json.dumps({"jsonid": "vrpathreg", "version": 1, "external_drivers": None, **paths}))
    monkeypatch.setenv("VR_PATHREG_OVERRIDE", str(registry))


@pytest.fixture
def runtime(library: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Runtime]:
    """A room: a headset, a tracker, a base station."""
    register(library.parents[2], monkeypatch)
    made = Runtime(library)
    made.runs(True)
    made.space(1)
    for index in range(8):
        made.device(index, 0, "", connected=False)
    made.device(0, HMD, "LHR-HEAD", at(0.0, 1.7, 0.0))
    made.device(1, BASE_STATION, "LHB-1", at(2.0, 2.0, 2.0))
    made.device(2, TRACKER, "LHR-AAAA", at(0.1, 0.9, -0.3, 0.5))
    yield made


@pytest.fixture
def source(runtime: Runtime) -> Iterator[SteamVrSource]:
    made = SteamVrSource({"LHR-AAAA": "cube"})
    made.open(0)
    yield made
    made.close()


def test_trackers_by_serial_number_and_the_headset_with_their_poses(source: SteamVrSource) -> None:
    samples = source.read(5)
    assert set(samples) == {"head", "cube"}
    np.testing.assert_allclose(samples["cube"].pose.position, [0.1, 0.9, -0.3], atol=1e-6)
    np.testing.assert_allclose(samples["cube"].pose.orientation_xyzw, [0.0, np.sin(0.25), 0.0, np.cos(0.25)], atol=1e-6)
    np.testing.assert_allclose(samples["head"].pose.position, [0.0, 1.7, 0.0], atol=1e-6)
    assert samples["cube"].t_ns == 5


def test_devices_come_go_and_change_places(runtime: Runtime, source: SteamVrSource) -> None:
    assert set(source.read(0)) == {"head", "cube"}
    runtime.device(2, TRACKER, "LHR-AAAA", connected=False)
    assert set(source.read(1)) == {"head"}
    runtime.device(2, TRACKER, "LHR-BBBB")
    runtime.device(5, TRACKER, "LHR-AAAA", at(1.0, 1.0, 1.0))
    samples = source.read(2)
    assert set(samples) == {"head", "cube", "LHR-BBBB"}
    np.testing.assert_allclose(samples["cube"].pose.position, [1.0, 1.0, 1.0], atol=1e-6)
    runtime.device(5, TRACKER, "LHR-AAAA", valid=False)
    assert set(source.read(3)) == {"head", "LHR-BBBB"}


def test_a_tracker_without_properties_yet_is_asked_again(runtime: Runtime, source: SteamVrSource) -> None:
    runtime.device(3, TRACKER, "")
    assert set(source.read(0)) == {"head", "cube"}
    runtime.device(3, TRACKER, "LHR-NEW")
    assert set(source.read(1)) == {"head", "cube", "LHR-NEW"}


@pytest.mark.parametrize(
    ("universe", "T", "event", "reason"),
    [
        (2, None, UNIVERSE_CHANGED, "its universe has changed"),
        (1, at(0.2, 0.0, 0.0), STANDING_RESET, r"its standing position was reset, by 0\.20 m"),
    ],
)
def test_a_space_that_moves_is_an_error(
    runtime: Runtime,
    source: SteamVrSource,
    universe: int,
    T: NDArray[np.float64] | None,
    event: int,
    reason: str,
) -> None:
    source.read(0)
    runtime.space(universe, T)
    runtime.event(event)
    with pytest.raises(SpaceMovedError, match=reason):
        source.read(1)


def test_events_that_say_nothing_disturb_nothing(runtime: Runtime, source: SteamVrSource) -> None:
    source.read(0)
    for kind in (100, 101, 200, 1700):
        runtime.event(kind)
    assert set(source.read(1)) == {"head", "cube"}


def test_a_runtime_that_quits_is_let_go_and_found_again(runtime: Runtime, source: SteamVrSource) -> None:
    source.read(0)
    before = runtime.quits_acknowledged
    runtime.event(QUIT)
    with pytest.raises(DeviceError, match="SteamVR is quitting; start it again"):
        source.read(1)
    assert runtime.quits_acknowledged == before + 1
    runtime.runs(False)
    with pytest.raises(DeviceError, match="NoServerForBackgroundApp"):
        source.open(2)
    runtime.runs(True)
    source.open(3)
    assert set(source.read(4)) == {"head", "cube"}


def test_a_runtime_that_vanishes_is_noticed(runtime: Runtime, source: SteamVrSource) -> None:
    source.read(0)
    runtime.runs(False)
    assert source.read(1_000_000_000) == {}
    with pytest.raises(DeviceError, match=r"SteamVR has had no device for 5 s"):
        source.read(6_000_000_000)
    runtime.runs(True)
    source.open(7_000_000_000)
    assert set(source.read(7_000_000_001)) == {"head", "cube"}


def test_no_runtime_at_all_says_what_to_start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    needs_emulated("one is installed")
    monkeypatch.setenv("VR_PATHREG_OVERRIDE", str(tmp_path / "none"))
    with pytest.raises(DeviceError, match=r"\(InitError_Init_PathRegistryNotFound\); start SteamVR on this machine"):
        SteamVrSource({}).open(0)
    register(tmp_path, monkeypatch)
    with pytest.raises(DeviceError, match=r"start SteamVR on this machine"):
        SteamVrSource({}).open(0)


def test_the_steamvr_that_runs_here() -> None:
    if DEVICE != "openvr":
        pytest.skip("RHOT_DEVICE is not openvr")
    source = SteamVrSource({})
    source.open(0)
    seen = source.read(time.monotonic_ns())
    source.close()
    assert seen, "SteamVR runs, and tracks neither a headset nor a tracker"
