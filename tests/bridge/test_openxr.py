"""OpenXR's shared memory, and the layer's registration; the layer itself runs in `make stacks`."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bridged import poses as bridge_poses
from click.testing import CliRunner
from numpy.typing import NDArray

from rhot.anatomy.skeleton import JOINTS
from rhot.errors import ConfigError, DeviceError
from rhot.rig import BridgeConfig
from rhot_bridge import openxr_layer
from rhot_bridge.openxr_layer import DISABLE, EXTENSIONS, LAYER, chain, manifest_path, openxr, sources
from rhot_bridge.scene import BridgedHand
from rhot_bridge.targets.openxr import (
    ABSENT,
    HAND,
    HANDS,
    JOINT,
    MAGIC,
    MEASURED,
    PREDICTED,
    VERSION,
    HandsMemory,
    Motion,
    OpenXrOutput,
    memory_path,
)


@pytest.fixture
def memory_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "hands"
    monkeypatch.setenv("RHOT_HANDS", str(path))
    return path


@pytest.fixture
def user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user whom nobody knows yet."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv("XR_RUNTIME_JSON", raising=False)
    return tmp_path


def read(path: Path) -> np.void:
    found: np.void = np.frombuffer(path.read_bytes(), HANDS, 1)[0]
    return found


def joints(x: float) -> NDArray[np.void]:
    made = np.zeros(26, JOINT)
    made["position"] = x, 1.0, 2.0
    made["orientation"] = 0.0, 0.0, 0.0, 1.0
    return made


class ReadyClock:
    """A rig clock that is the machine's."""

    ready = True
    offset_ns = 0
    uncertainty_ns = 0

    def now_ns(self) -> int:
        return time.time_ns()

    def to_rig_ns(self, node_ns: int) -> int:
        return node_ns


def test_the_header_says_what_python_writes(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler on this machine (Debian: apt install gcc libc6-dev)")
    fields = {
        "RhotHands": ("magic", "version", "hands"),
        "RhotHand": ("sequence", "state", "t_ns", "joints"),
        "RhotJoint": JOINT.names or (),
    }
    lines = [f'"%zu {kind}\\n", sizeof({kind})' for kind in fields]
    lines += [f'"%zu {kind}.{name}\\n", offsetof({kind}, {name})' for kind, names in fields.items() for name in names]
    lines += ['"%u magic\\n", RHOT_HANDS_MAGIC', '"%u version\\n", RHOT_HANDS_VERSION']
    source = tmp_path / "layout.c"
    printed = "".join(f"printf({line});" for line in lines)
    source.write_text(
        f"#include <stdio.h>\n#include <stddef.h>\n#include <rhot_hands.h>\nint main(void) {{ {printed} return 0; }}\n"
    )
    command = [compiler, "-std=c11", "-Wall", "-Werror", f"-I{sources()}", str(source), "-o", str(tmp_path / "layout")]
    subprocess.run(command, check=True)
    said = subprocess.run([tmp_path / "layout"], capture_output=True, text=True, check=True).stdout
    wanted = {"RhotHands": HANDS.itemsize, "RhotHand": HAND.itemsize, "RhotJoint": JOINT.itemsize}
    for kind, dtype in (("RhotHands", HANDS), ("RhotHand", HAND), ("RhotJoint", JOINT)):
        wanted |= {f"{kind}.{name}": field[1] for name, field in (dtype.fields or {}).items()}
    wanted |= {"magic": MAGIC, "version": VERSION}
    assert {name: int(value) for value, name in map(str.split, said.splitlines())} == wanted


def test_a_reader_is_told_of_every_write(memory_file: Path) -> None:
    memory = HandsMemory()
    assert memory_file.stat().st_mode & 0o777 == 0o600, "hands are their owner's business"
    first = read(memory_file)
    assert (first["magic"], first["version"]) == (MAGIC, VERSION)
    assert first["hands"]["state"].tolist() == [ABSENT, ABSENT]
    memory.write("right", MEASURED, 5, joints(0.5))
    left, right = read(memory_file)["hands"]
    assert left["state"] == ABSENT
    assert (right["state"], right["t_ns"]) == (MEASURED, 5)
    assert right["joints"]["position"].tolist() == [[0.5, 1.0, 2.0]] * 26
    assert right["sequence"] == first["hands"][1]["sequence"] + 2
    memory.close()
    assert read(memory_file)["hands"]["state"].tolist() == [ABSENT, ABSENT]


def test_two_bridges_do_not_write_at_once(memory_file: Path) -> None:
    memory = HandsMemory()
    with pytest.raises(DeviceError, match=r"another `rhot bridge openxr` writes there; end it first"):
        HandsMemory()
    memory.close()
    HandsMemory().close()


@pytest.mark.parametrize("odd", [7, 0xFFFFFFFF])
def test_a_writer_that_died_while_it_wrote_is_followed_by_another(memory_file: Path, odd: int) -> None:
    dead = np.zeros(1, HANDS)
    dead["hands"]["sequence"] = odd
    memory_file.write_bytes(dead.tobytes())
    memory = HandsMemory()
    memory.write("left", PREDICTED, 9, joints(0.1))
    left = read(memory_file)["hands"][0]
    assert left["sequence"] % 2 == 0
    assert left["state"] == PREDICTED
    memory.close()


def test_what_is_no_file_of_ours_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RHOT_HANDS", str(tmp_path / "no" / "folder"))
    with pytest.raises(DeviceError, match="no/folder: the hands' shared memory cannot be made"):
        HandsMemory()
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    monkeypatch.setenv("RHOT_HANDS", str(tmp_path / "link"))
    with pytest.raises(DeviceError):
        HandsMemory()
    assert not (tmp_path / "elsewhere").exists(), "a link in a folder that all may write to leads anywhere"


@pytest.mark.parametrize("rate_hz", [15.0, 30.0, 60.0, 200.0])
def test_velocities_are_those_of_the_hand(rate_hz: float) -> None:
    speed, spin = np.array([0.3, -1.0, 2.0]), np.array([1.0, -4.0, 2.0])
    motion = Motion()
    still = bridge_poses.hand("flat", "right")
    for number in range(8):
        t_s = number / rate_hz
        angle = float(np.linalg.norm(spin)) * t_s
        axis = spin / np.linalg.norm(spin) * np.sin(angle / 2.0)
        # The sign of a quaternion is anybody's choice.
        sign = -1.0 if number % 2 else 1.0
        quaternions = np.tile(sign * np.array([*axis, np.cos(angle / 2.0)]), (26, 1))
        hand = BridgedHand(round(1e9 * t_s), "measured", 1.0, still.positions + speed * t_s, quaternions, still.radii)
        linear, angular = motion.add(hand)
        # The first moments count as longer than they are.
        share = min(t_s / 0.03, 1.0)
        np.testing.assert_allclose(linear, np.tile(share * speed, (26, 1)), atol=1e-6)
        np.testing.assert_allclose(angular, np.tile(share * spin, (26, 1)), atol=1e-6)


def test_a_finger_that_is_seen_again_where_nobody_expected_it_has_not_flown_there() -> None:
    motion, flat = Motion(), bridge_poses.hand("flat", "right")
    speed, index = np.array([0.2, 0.0, 0.0]), np.array([name.startswith("index") for name in JOINTS])
    found = []
    for number in range(6):
        positions = flat.positions + speed * number / 60.0
        positions[index] += [0.0, 0.05 if number >= 3 else 0.0, 0.0]
        measured = ~index if number < 3 else np.ones(26, dtype=bool)
        t_ns = round(1e9 * number / 60.0)
        found.append(
            motion.add(BridgedHand(t_ns, "measured", 1.0, positions, flat.orientations, flat.radii, measured))[0]
        )
    np.testing.assert_allclose(found[3][~index], np.tile(speed, ((~index).sum(), 1)), atol=1e-6)
    assert not found[3][index].any()
    np.testing.assert_allclose(found[5], np.tile(speed, (26, 1)), atol=1e-6)


async def test_hands_stand_where_the_offset_puts_them(memory_file: Path) -> None:
    output = OpenXrOutput(BridgeConfig.model_validate({"target": "openxr"}))
    output.use_clock(ReadyClock())
    await output.open()
    hand = bridge_poses.hand("flat", "right")

    def write(t_ns: int) -> np.void:
        sample = BridgedHand(t_ns, "measured", 1.0, hand.positions, hand.orientations, hand.radii)
        assert output.send_sample("rhot/hand/right", sample)
        found: np.void = read(memory_file)["hands"][1]
        return found

    plain = write(time.time_ns())
    np.testing.assert_allclose(plain["joints"]["position"], hand.positions, atol=1e-6)
    assert abs(int(plain["t_ns"]) - time.monotonic_ns()) < 1e9
    output.use_config(BridgeConfig.model_validate({"target": "openxr", "offset": (0.1, 0.2, 0.3, 90.0)}))
    turned = write(time.time_ns())
    x, y, z = hand.positions.T
    # A quarter turn about the vertical takes x to −z and z to x.
    np.testing.assert_allclose(turned["joints"]["position"], np.column_stack([z + 0.1, y + 0.2, -x + 0.3]), atol=1e-6)
    assert not np.allclose(turned["joints"]["orientation"], hand.orientations)
    np.testing.assert_allclose(np.linalg.norm(turned["joints"]["orientation"], axis=1), 1.0, atol=1e-6)
    assert not output.send_sample("rhot/object/cube", bridge_poses.thing((0.0, 0.0, 0.0)))
    await output.close()


async def test_predicted_hands_count_as_the_setting_says(memory_file: Path) -> None:
    output = OpenXrOutput(BridgeConfig.model_validate({"target": "openxr"}))
    output.use_clock(ReadyClock())
    await output.open()
    hand = bridge_poses.hand("flat", "left")
    for predicted, state in (("send", PREDICTED), ("absent", ABSENT)):
        output.use_config(BridgeConfig.model_validate({"target": "openxr", "predicted": predicted}))
        sample = BridgedHand(time.time_ns(), "predicted", 1.0, hand.positions, hand.orientations, hand.radii)
        assert output.send_sample("rhot/hand/left", sample)
        assert read(memory_file)["hands"][0]["state"] == state
    await output.close()


def test_a_killed_writer_leaves_the_memory_and_no_lock(memory_file: Path) -> None:
    code = "from rhot_bridge.targets.openxr import HandsMemory; m = HandsMemory(); print('up', flush=True); input()"
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ}
    )
    assert child.stdout is not None
    assert child.stdout.readline() == b"up\n"
    child.send_signal(signal.SIGKILL)
    child.communicate()
    assert memory_file.exists()
    HandsMemory().close()


# Registration.


@pytest.fixture
def library(tmp_path: Path) -> Iterator[Path]:
    made = tmp_path / "librhot_openxr.so"
    made.write_bytes(b"")
    yield made


def run(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(openxr, arguments, standalone_mode=False)
    if done.exception is not None:
        raise done.exception
    return int(done.return_value), done.output


def test_install_and_remove(user: Path, library: Path) -> None:
    code, said = run("install", "--library", str(library))
    assert code == 0
    assert "rhot bridge openxr" in said
    path = user / "data/openxr/1/api_layers/implicit.d/rhot_hands.json"
    assert manifest_path() == path
    layer = json.loads(path.read_text())["api_layer"]
    assert layer["name"] == LAYER
    assert layer["library_path"] == str(library.resolve())
    assert layer["disable_environment"] == DISABLE
    assert {extension["name"] for extension in layer["instance_extensions"]} == set(EXTENSIONS)
    assert run("remove") == (0, f"{LAYER} is not registered any more.\n")
    assert not path.exists()
    assert run("remove") == (0, f"{LAYER} was not registered.\n")


def test_status_follows_the_chain(
    user: Path, library: Path, memory_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, said = run("status")
    assert code == 1
    assert "rhot openxr install" in said
    assert "make it the active runtime" in said
    assert "no bridge has written hands" in said
    run("install", "--library", str(library))
    runtime = user / "runtime.json"
    runtime.write_text("{}")
    monkeypatch.setenv("XR_RUNTIME_JSON", str(runtime))
    memory = HandsMemory()
    assert [step.holds for step in chain()] == [True, True, False]
    assert "no hand is in the memory now" in run("status")[1]
    memory.write("right", MEASURED, time.monotonic_ns() - 12_000_000, joints(0.0))
    code, said = run("status")
    assert code == 0
    assert "hands in the memory: right, 1" in said
    memory.write("right", MEASURED, time.monotonic_ns() - 1_000_000_000, joints(0.0))
    assert run("status")[0] == 1, "a second old"
    monkeypatch.setenv(DISABLE, "1")
    assert f"unset {DISABLE}" in run("status")[1]
    memory.close()
    memory_path().write_bytes(b"\1" * HANDS.itemsize)
    assert "another version" in run("status")[1]
    library.unlink()
    assert "is gone" in run("status")[1]
    manifest_path().write_text("[]")
    assert "not a manifest of ours" in run("status")[1]


def test_without_compiler_or_headers_it_says_what_to_install(
    user: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="apt install gcc libc6-dev libopenxr-dev"):
        run("install")
    assert not manifest_path().exists()
    missing = "rhot_layer.c:1:10: fatal error: openxr/openxr_loader_negotiation.h: No such file or directory"
    assert "libopenxr-dev" in openxr_layer._compile_problem(missing)
    assert "error: x" in openxr_layer._compile_problem("error: x")
