"""Trackers that lose their map: positions that jump are bridged at a speed that people have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.messages import BodyPose, FootPose, HeadPose, Side
from rhot.messages.base import wire_position, wire_quaternion
from rhot.rig import BodyConfig, load_rig
from rhot_ik.body_core import FOOT, HEAD, BodyCore, JumpBridge
from rhot_sim.walker.foot_path import SIDES
from rhot_sim.walker.person import Person, person_of
from rhot_sim.walker.programs import PROGRAMS
from rhot_sim.walker.world import WalkerWorld

START_NS = 1_700_000_000_000_000_000
RATE_HZ = 88.0
FASTEST_FOOT_M_S = 8.0
WALKING_ANKLE_M_S, WALKING_KNEE_M_S = 5.0, 4.0
"""Of a walker whose ankle swings at 2.9 and whose knee at 1.8 m/s, and who goes to where a jump led at 2 m/s."""
WALKS = ("HW3003_0.5", "HW3006_1.5", "HW3008_1.0")
JUMPS_M = (0.046, 0.15, 0.605)
FEET = "\n[feet]\n[feet.left]\nmarker_id = 1\n[feet.right]\nmarker_id = 2\n"


def bridged(positions: FloatArray, rate_hz: float = RATE_HZ) -> tuple[FloatArray, NDArray[np.bool_], int]:
    """Return positions (N, 3) without their jumps, which of them are bridging, and the number of jumps."""
    bridge = JumpBridge(FOOT)
    found = [bridge.update(START_NS + round(1e9 * k / rate_hz), position) for k, position in enumerate(positions)]
    return np.array([each.position for each in found]), np.array([each.bridging for each in found]), bridge.jumps


def recorded(shared_data: Path, name: str, foot: str, kind: str = "p") -> FloatArray:
    rows = np.genfromtxt(shared_data / "vive_tracker" / f"{name}.csv", delimiter=",", names=True)
    return np.stack([rows[f"{foot}_{kind}{axis}"] for axis in "xyz"], axis=-1)


@pytest.mark.parametrize("program", PROGRAMS)
def test_what_people_do_is_no_jump(program: str) -> None:
    walker = Person(5, BodyModel.from_config(BodyConfig()), program, np.radians(20.0))
    for rate_hz in (30.0, 200.0):
        t_s = np.arange(0.0, 12.0, 1.0 / rate_hz)
        heads = JumpBridge(HEAD)
        for side in SIDES:
            ankles = walker.ankles(side, t_s)[:, :3, 3]
            smooth, bridging, jumps = bridged(ankles, rate_hz)
            assert jumps == 0
            assert not bridging.any()
            np.testing.assert_allclose(smooth, ankles)
        for k, position in enumerate(walker.heads(t_s)[:, :3, 3]):
            heads.update(START_NS + round(1e9 * k / rate_hz), position)
        assert heads.jumps == 0


@pytest.mark.parametrize("name", WALKS)
def test_real_ankles_do_not_jump(shared_data: Path, name: str) -> None:
    for foot in ("lfoot", "rfoot"):
        assert bridged(recorded(shared_data, name, foot, "gt_"))[2] == 0


@pytest.mark.parametrize("jump_m", JUMPS_M)
@pytest.mark.parametrize("back", [True, False])
def test_a_jump_is_bridged_and_said(jump_m: float, *, back: bool) -> None:
    """A standing foot's tracker jumps, and a second later back or not at all."""
    positions = np.zeros((264, 3))
    positions[88 : 176 if back else None] = [0.0, 0.6 * jump_m, 0.8 * jump_m]
    smooth, bridging, jumps = bridged(positions)
    assert jumps == 1 + back
    speed = np.linalg.norm(np.diff(smooth, axis=0), axis=1) * RATE_HZ
    assert speed.max() <= FOOT.bridging + 1e-6
    assert bridging[88]
    assert np.linalg.norm(smooth[88]) < 1e-9, "the sample that jumps is not believed"
    assert not bridging[:88].any()
    assert not bridging[-1]
    np.testing.assert_allclose(smooth[-1], positions[-1], atol=1e-9)


def test_a_spike_of_one_sample_leaves_nothing() -> None:
    positions = np.zeros((100, 3))
    positions[:, 0] = 0.03 * np.arange(100)
    spiked = positions.copy()
    spiked[50] += [0.3, 0.0, 0.1]
    smooth, bridging, _ = bridged(spiked)
    assert np.abs(smooth - positions).max() < 1e-7
    assert np.flatnonzero(bridging).tolist() == [50]


def test_a_kick_harder_than_any_is_believed_at_once_more() -> None:
    """From rest to 5 m/s within a sample: one increment is missed, the next is believed."""
    positions = np.zeros((100, 3))
    positions[50:, 2] = -5.0 / RATE_HZ * np.arange(1, 51)
    smooth, _, jumps = bridged(positions)
    assert jumps == 1
    assert np.linalg.norm(smooth - positions, axis=1).max() < 5.0 / RATE_HZ + 1e-9
    assert np.linalg.norm(smooth[80:] - positions[80:], axis=1).max() < 1e-9


def test_after_a_long_silence_nothing_is_bridged() -> None:
    bridge = JumpBridge(FOOT)
    bridge.update(START_NS, np.zeros(3))
    after = bridge.update(START_NS + 2_000_000_000, np.array([1.0, 0.0, 0.0]))
    assert not after.bridging
    np.testing.assert_array_equal(after.position, [1.0, 0.0, 0.0])


def core_of(rig_folder: Path) -> BodyCore:
    rig_file = rig_folder / "rig.toml"
    rig_file.write_text(rig_file.read_text() + FEET)
    return BodyCore(load_rig(rig_folder))


def foot_pose(side: Side, t_ns: int, T: FloatArray, velocity: FloatArray) -> FootPose:
    return FootPose(
        t_ns=t_ns,
        side=side,
        frame="rig",
        position=wire_position(T[:3, 3]),
        orientation=wire_quaternion(quaternion_from_rotation(T[:3, :3])),
        velocity=wire_position(velocity),
        sigma=0.003,
        stage="marker",
        state="measured",
    )


def played(rig_folder: Path, *, foot_m: FloatArray, head_m: FloatArray) -> tuple[list[BodyPose], FloatArray, BodyCore]:
    """Return the bodies of a walker whose left foot's and head's trackers are off by (N, 3), and the true left knee.

    As from a tracker, a foot's velocity is that of its positions, jumps included.
    """
    core = core_of(rig_folder)
    world = WalkerWorld(3, person_of(BodyModel.from_config(BodyConfig()), 3), "walk")
    t_s = np.arange(len(foot_m)) / RATE_HZ
    heads, feet = world.head(t_s), world.feet(t_s)
    heads[:, :3, 3] += head_m
    feet["left"][:, :3, 3] += foot_m
    found: list[BodyPose] = []
    for k in range(len(t_s)):
        t_ns = START_NS + round(1e9 * t_s[k])
        orientation = wire_quaternion(quaternion_from_rotation(heads[k, :3, :3]))
        core.feed(
            HeadPose(
                t_ns=t_ns,
                frame="rig",
                position=wire_position(heads[k, :3, 3]),
                orientation=orientation,
                state="measured",
            )
        )
        for side in SIDES:
            velocity = (feet[side][k] - feet[side][max(k - 1, 0)])[:3, 3] * RATE_HZ
            found += [body for _, body in core.feed(foot_pose(side, t_ns, feet[side][k], velocity))
                      if isinstance(body, BodyPose)]  # fmt: skip
    return found, world.joints(t_s)["left_knee"][:, :3, 3], core


def fastest(bodies: list[BodyPose], joint: str) -> float:
    """Return the greatest speed of a joint from one body to the next, m/s."""
    at = {body.t_ns: body.joints[joint].position for body in bodies if joint in body.joints}
    t_s, positions = 1e-9 * (np.array(list(at)) - START_NS), np.array(list(at.values()))
    return float((np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(t_s)).max())


@pytest.mark.parametrize("jump_m", [0.0, *JUMPS_M])
def test_no_joint_of_a_body_moves_faster_than_a_person_can(rig_folder: Path, jump_m: float) -> None:
    """The left foot's tracker loses its map at 2 s and finds it at 3.5 s."""
    count = round(6.0 * RATE_HZ)
    off = np.zeros((count, 3))
    lost, again = round(2.0 * RATE_HZ), round(3.5 * RATE_HZ)
    off[lost:again] = jump_m * np.array([0.48, 0.6, 0.64])
    bodies, knees, core = played(rig_folder, foot_m=off, head_m=np.zeros((count, 3)))
    assert fastest(bodies, "left_ankle") < WALKING_ANKLE_M_S
    assert fastest(bodies, "left_knee") < WALKING_KNEE_M_S
    at_loss = min(bodies, key=lambda body: abs(body.t_ns - START_NS - round(1e9 * lost / RATE_HZ)))
    assert at_loss.legs.get("left") == ("predicted" if jump_m else "measured")
    assert core.counts["jumps"] == (2 if jump_m else 0)
    late = [body for body in bodies if body.t_ns - START_NS > 5_000_000_000]
    true = [knees[round((body.t_ns - START_NS) * 1e-9 * RATE_HZ)] for body in late]
    errors = np.linalg.norm(np.array([body.joints["left_knee"].position for body in late]) - true, axis=1)
    assert np.mean(errors) < 0.05
    assert {body.legs["left"] for body in late} == {"measured"}


def test_a_head_that_jumps_takes_no_joint_along_faster_than_a_person_can(rig_folder: Path) -> None:
    count = round(5.0 * RATE_HZ)
    off = np.zeros((count, 3))
    off[round(2.0 * RATE_HZ) :] = [0.3, 0.0, 0.2]
    bodies, _, core = played(rig_folder, foot_m=np.zeros((count, 3)), head_m=off)
    assert core.counts["jumps"] == 1
    assert fastest(bodies, "hips") < 4.0
    assert fastest(bodies, "left_knee") < WALKING_KNEE_M_S
    assert "predicted" in {body.state for body in bodies}


@pytest.mark.parametrize("name", WALKS)
@pytest.mark.parametrize("jump_m", JUMPS_M)
def test_real_trackers_that_jump(rig_folder: Path, shared_data: Path, name: str, jump_m: float) -> None:
    """Recorded walks whose left tracker is somewhere else for a second, beginning at ten moments of the gait.

    The hidden walks that jump by themselves are not here, so that jumps of their sizes are put into these.
    """
    walk = recorded(shared_data, name, "lfoot")[300:800]
    jumps_before = bridged(walk)[2]
    for beginning in range(10):
        positions = walk.copy()
        lost = 200 + 9 * beginning
        positions[lost : lost + 88] += jump_m * np.array([0.6, 0.48, 0.64])
        smooth, bridging, jumps = bridged(positions)
        speed = np.linalg.norm(np.diff(smooth, axis=0), axis=1) * RATE_HZ
        assert speed.max() < FASTEST_FOOT_M_S
        assert jumps_before <= jumps <= jumps_before + 4
        if jump_m > 0.1:
            assert bridging[lost]
