from __future__ import annotations

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.messages import Side, Truth, decode, encode
from rhot.rig import HandFile, MarkerConfig
from rhot_sim.world.motion import OBJECT_SIZE_M, StillMotion
from rhot_sim.world.script import CYCLE_S, GRAB_S, RELEASE_S
from rhot_sim.world.world import World


def two_handed(markers: dict[str, MarkerConfig]) -> World:
    sides: tuple[Side, Side] = ("right", "left")
    both = {
        f"{name}.{side}": marker.model_copy(update={"hand": side}) for side in sides for name, marker in markers.items()
    }
    return World(3, {side: HandModel.from_file(HandFile(), side) for side in sides}, both, ["box"])


def test_random_access_equals_sequence(
    world: World, hands: dict[Side, HandModel], markers: dict[str, MarkerConfig]
) -> None:
    t = np.linspace(0.0, 40.0, 81)
    sequence = world.sample(t)
    fresh = World(1, hands, markers, ["box"])
    for place in np.random.default_rng(0).permutation(len(t)):
        alone = fresh.sample(t[place : place + 1])
        np.testing.assert_allclose(
            alone.joints["right"].positions[0], sequence.joints["right"].positions[place], atol=1e-12
        )
        np.testing.assert_allclose(alone.objects["box"][0], sequence.objects["box"][place], atol=1e-12)


def test_seeds_differ(hands: dict[Side, HandModel], markers: dict[str, MarkerConfig], world: World) -> None:
    t = np.array([9.0])
    other = World(2, hands, markers, ["box"]).sample(t).markers["base"]
    assert np.linalg.norm(other - world.sample(t).markers["base"]) > 0.005


@pytest.mark.parametrize("seed", [1, 2, 7])
def test_angles_keep_the_limits(hands: dict[Side, HandModel], markers: dict[str, MarkerConfig], seed: int) -> None:
    angles = World(seed, hands, markers, ["box"]).sample(np.arange(0.0, 96.0, 0.02)).angles["right"]
    hand = hands["right"]
    assert (angles >= hand.angle_min - 1e-9).all()
    assert (angles <= hand.angle_max + 1e-9).all()
    # It does bend its fingers: a hand that never moved would keep the limits too.
    assert np.degrees(np.ptp(angles[:, 1:, 2], axis=0)).min() > 40.0


@pytest.mark.parametrize("seed", [1, 2, 7])
def test_motion_is_smooth_and_as_fast_as_hands_are(
    hands: dict[Side, HandModel], markers: dict[str, MarkerConfig], seed: int
) -> None:
    h = 0.002
    sample = World(seed, hands, markers, ["box"]).sample(np.arange(0.0, 96.0, h))
    speeds = []
    for positions in sample.markers.values():
        velocity = np.diff(positions, axis=0) / h
        acceleration = np.diff(velocity, axis=0) / h
        jerk = np.diff(acceleration, axis=0) / h
        speeds.append(np.linalg.norm(velocity, axis=1))
        assert np.linalg.norm(acceleration, axis=1).max() < 15.0
        # A step in acceleration (no C2) of 1 m/s² would show as 500 m/s³.
        assert np.linalg.norm(jerk, axis=1).max() < 250.0
    assert 0.4 < np.max(speeds) < 1.2
    assert np.median(np.max(speeds, axis=0)) > 0.03
    still = np.max(speeds, axis=0) < 1e-6
    assert still.mean() > 0.02


def test_object_moves_with_the_hand_between_grab_and_release(world: World) -> None:
    t = np.arange(GRAB_S + 0.05, RELEASE_S - 0.05, 0.05)
    sample = world.sample(t)
    wrist = sample.joints["right"]
    offset = np.einsum("nji,nj->ni", wrist.rotation("wrist"), sample.objects["box"][:, :3, 3] - wrist.position("wrist"))
    np.testing.assert_allclose(offset, np.tile(offset[0], (len(t), 1)), atol=1e-9)
    travelled = np.linalg.norm(sample.objects["box"][-1, :3, 3] - sample.objects["box"][0, :3, 3])
    assert travelled > 0.02


def test_object_never_jumps_and_lies_on_the_desk_otherwise(
    hands: dict[Side, HandModel], markers: dict[str, MarkerConfig]
) -> None:
    h = 0.004
    t = np.arange(0.0, 4.0 * CYCLE_S, h)
    sample = World(5, hands, markers, ["box", "other"]).sample(t)
    phase = t % CYCLE_S
    lying = (phase < GRAB_S) | (phase >= RELEASE_S)
    for poses in sample.objects.values():
        assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 0.6 * h
        assert np.abs(np.diff(poses[:, :3, :3], axis=0)).max() < 3.0 * h
        np.testing.assert_allclose(poses[lying, 2, 3], 0.95 - OBJECT_SIZE_M[1] / 2.0, atol=1e-9)
    apart = np.linalg.norm(sample.objects["box"][:, :3, 3] - sample.objects["other"][:, :3, 3], axis=1)
    assert apart[lying].min() > 0.06


def test_stands_still_before_the_start(world: World) -> None:
    sample = world.sample(np.array([-100.0, -0.01, 0.0]))
    np.testing.assert_array_equal(sample.markers["index"][0], sample.markers["index"][2])


def test_two_hands_stay_apart(markers: dict[str, MarkerConfig]) -> None:
    sample = two_handed(markers).sample(np.arange(0.0, 64.0, 0.1))
    assert set(sample.joints) == {"right", "left"}
    right, left = (sample.joints[side].positions[..., 0] for side in ("right", "left"))
    # The right hand of somebody whose arms come in at the picture's top is to the left in it.
    assert right.max(axis=1).mean() < left.min(axis=1).mean()
    # Its thumb points to the other hand.
    thumb = sample.joints["right"].position("thumb_tip") - sample.joints["right"].position("little_tip")
    assert (thumb[:, 0] > 0.0).all()


def test_truth_is_a_message_of_all_there_is(world: World) -> None:
    truth = decode(encode(world.truth(2.0, 1_700_000_000_000_000_000, seq=4)), Truth)
    sample = world.sample(np.array([2.0]))
    assert truth.t_ns == 1_700_000_000_000_000_000
    assert truth.seq == 4
    assert set(truth.points) == set(world.markers)
    assert len(truth.hands["right"]) == 26
    np.testing.assert_allclose(truth.points["ring"], sample.markers["ring"][0], atol=1e-12)
    np.testing.assert_allclose(truth.objects["box"].position, sample.objects["box"][0, :3, 3], atol=1e-12)


def test_still_motion_never_moves(hands: dict[Side, HandModel], markers: dict[str, MarkerConfig]) -> None:
    world = World(1, hands, markers, ["box"], motion=StillMotion(("right",), ["box"]))
    sample = world.sample(np.array([0.0, 3.3, 500.0]))
    for positions in sample.markers.values():
        np.testing.assert_array_equal(positions[0], positions[2])
