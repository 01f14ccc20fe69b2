"""What we write and send, read by programs that are not ours, each in an environment of its own."""

from __future__ import annotations

import json
import os
import socket
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bridged import poses as bridge_poses
from bridged.poses import POSES, angles, hand
from bridged.readers import messages
from click.testing import CliRunner
from exported import person

from rhot.anatomy.skeleton import HAND_ANGLE_NAMES, JOINTS
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.recording.messages import RecordedMessages
from rhot_bridge.axes import Converter
from rhot_bridge.targets.vmc import VmcTarget
from rhot_tools.export.poses import motions
from rhot_tools.recordings.export import export, stage_of

pytestmark = pytest.mark.stacks

REPOSITORY = Path(__file__).parents[3]
PYTHON = Path(os.environ.get("RHOT_STACKS", REPOSITORY / ".stacks")) / "readers" / "bin" / "python"
HERE = REPOSITORY / "tests" / "stacks" / "readers"


def read(script: str, *arguments: str, package: str) -> Any:
    """Return what a reader in its own environment prints."""
    if not PYTHON.exists():
        pytest.skip("no environment of readers: `make stacks` makes it")
    if subprocess.run([PYTHON, "-c", f"import {package}"], capture_output=True, check=False).returncode:
        pytest.skip(f"{package} has no wheel for this Python")
    done = subprocess.run([PYTHON, HERE / script, *arguments], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    # Blender also talks before.
    return json.loads(done.stdout[done.stdout.index("{") :])


def written(recording: Path, *options: str) -> None:
    done = CliRunner().invoke(export, [str(recording), *options])
    assert done.exit_code == 0, done.output


MIDDLES = [(name, (number + 0.5) * person.SECONDS_A_POSE) for number, name in enumerate(POSES)]
"""Each pose, and a moment in the middle of its time."""


@pytest.mark.parametrize(("pose", "at_s"), MIDDLES)
def test_blender_puts_every_joint_of_gltf_where_it_is(
    poses_recording: Path, tmp_path: Path, pose: str, at_s: float
) -> None:
    file = tmp_path / "x.glb"
    written(poses_recording, "--gltf", str(file))
    found = read("blender.py", str(file), str(at_s), package="bpy")
    worst_mm = []
    for side in ("left", "right"):
        truth = hand(pose, side).positions
        for number, joint in enumerate(JOINTS):
            name = next(name for name in found if f"hand_{side}" in name and name.endswith(joint))
            worst_mm.append(1e3 * float(np.linalg.norm(np.array(found[name]) - truth[number])))
    assert len(worst_mm) == 52
    assert max(worst_mm) < 0.1


@pytest.mark.parametrize(("pose", "at_s"), MIDDLES)
def test_blender_puts_every_joint_of_bvh_where_it_is(
    poses_recording: Path, tmp_path: Path, pose: str, at_s: float
) -> None:
    file = tmp_path / "x.bvh"
    written(poses_recording, "--bvh", str(file), "--hand", "right")
    found = read("blender.py", str(file), str(at_s), package="bpy")
    truth = hand(pose, "right").positions
    common = {joint: number for number, joint in enumerate(JOINTS) if any(name.endswith(joint) for name in found)}
    assert len(common) >= 20
    for joint, number in common.items():
        name = next(name for name in found if name.endswith(joint))
        assert 1e3 * float(np.linalg.norm(np.array(found[name]) - truth[number])) < 0.5, joint


def test_opensim_reads_markers_and_angles(poses_recording: Path, tmp_path: Path) -> None:
    written(poses_recording, "--trc", str(tmp_path / "x.trc"), "--mot", str(tmp_path / "x.mot"))
    markers = read("osim.py", str(tmp_path / "x.trc"), "10", package="opensim")["values"]
    truth = hand("flat", "left").positions[JOINTS.index("index_tip")]
    np.testing.assert_allclose(markers["hand_left_index_tip"], truth, atol=2e-6)
    found = read("osim.py", str(tmp_path / "x.mot"), "10", package="opensim")["values"]
    assert found["knee_angle_r"] == pytest.approx(np.degrees(person.KNEE_RAD), abs=1e-5)


@pytest.mark.parametrize(("pose", "at_s"), MIDDLES)
def test_opensim_finds_the_angles_of_hands_from_their_markers(
    poses_recording: Path, tmp_path: Path, pose: str, at_s: float
) -> None:
    model, trc = tmp_path / "x.osim", tmp_path / "x.trc"
    written(poses_recording, "--trc", str(trc), "--osim", str(model))
    times = (f"{at_s - 0.05:.3f}", f"{at_s + 0.05:.3f}")
    found = read("osim_ik.py", str(model), str(trc), str(tmp_path / "x.mot"), *times, package="opensim")
    assert found["worst_m"] < 1e-5
    truth_deg = np.degrees(angles(pose))
    for side in ("left", "right"):
        for name, wanted in zip(HAND_ANGLE_NAMES, truth_deg.ravel(), strict=True):
            np.testing.assert_allclose(found["degrees"][f"hand_{side}_{name}"], wanted, atol=0.02, err_msg=name)


def test_isaac_teleop_replays_both_hands_joint_by_joint(poses_recording: Path, tmp_path: Path) -> None:
    file = tmp_path / "x.mcap"
    written(poses_recording, "--isaac", str(file))
    messages_of = RecordedMessages(poses_recording)
    T_stage_rig = stage_of(messages_of, None)
    assert T_stage_rig is not None
    truth = {name: motion.moved(T_stage_rig) for name, motion in motions(messages_of).items()}
    count = len(truth["hand_right"].t_ns)
    found = read("isaac.py", str(count), str(file), package="isaacteleop")
    for side in ("left", "right"):
        motion, played = truth[f"hand_{side}"], np.array(found[side])
        np.testing.assert_allclose(played[..., :3], motion.positions, atol=1e-6)
        np.testing.assert_allclose(rotation_from_quaternion(played[..., 3:7]), motion.rotations, atol=1e-6)
        np.testing.assert_allclose(played[..., 7], np.broadcast_to(motion.radii_m, played.shape[:2]), atol=1e-6)
        assert (played[..., 8] == 1.0).all()


def test_the_validator_of_bids_finds_no_error(poses_recording: Path, tmp_path: Path) -> None:
    validator = PYTHON.with_name("bids-validator-deno")
    if not validator.exists():
        pytest.skip("no validator of BIDS: `make stacks` installs it")
    for name in ("sub-01_task-pose", "sub-02_ses-a_task-pose_run-1"):
        written(poses_recording, "--bids", str(tmp_path / "dataset"), "--bids-name", name)
    command = [str(validator), str(tmp_path / "dataset"), "--format", "json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    issues = json.loads(done.stdout)["issues"]["issues"]
    assert [issue for issue in issues if issue["severity"] == "error"] == []


def test_the_inspector_of_the_dandi_archive_asks_only_for_the_persons_age(
    poses_recording: Path, tmp_path: Path
) -> None:
    inspector = PYTHON.with_name("nwbinspector")
    if not inspector.exists():
        pytest.skip("no inspector of NWB: `make stacks` installs it")
    file, found = tmp_path / "x.nwb", tmp_path / "found.json"
    written(poses_recording, "--nwb", str(file))
    command = [str(inspector), str(file), "--config", "dandi", "--json-file-path", str(found)]
    subprocess.run(command, capture_output=True, timeout=120, check=True)
    refused = {
        each["check_function_name"]
        for each in json.loads(found.read_text())["messages"]
        if each["importance"] not in {"BEST_PRACTICE_SUGGESTION", "BEST_PRACTICE_VIOLATION"}
    }
    # Only the lab knows the age; these poses were recorded in a future year.
    assert refused - {"check_session_start_time_future_date"} == {"check_subject_age"}


def test_a_receiver_of_vmc_gets_every_bone(free_port: int) -> None:
    if not PYTHON.exists():
        pytest.skip("no environment of readers: `make stacks` makes it")
    packets = VmcTarget("arms").frame(Converter("unity", np.eye(4)).scene(bridge_poses.scene("flat")), 0)
    sent = {values[0]: values[1:] for address, values in messages(packets) if address == "/VMC/Ext/Bone/Pos"}
    with (
        subprocess.Popen(
            [PYTHON, HERE / "vmc.py", str(free_port), str(len(sent))],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as reader,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        assert reader.stderr is not None
        assert "listening" in reader.stderr.readline()
        for packet in packets:
            out.sendto(packet, ("127.0.0.1", free_port))
        told, _ = reader.communicate(timeout=60)
    found = json.loads(told)
    assert found.keys() == sent.keys()
    for bone, values in sent.items():
        np.testing.assert_allclose(found[bone], values, atol=1e-6)
