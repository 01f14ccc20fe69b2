"""Two hands that touch and cross, measured end to end."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from rhot.anatomy.markers import own_paints
from rhot.messages import MarkerFrame
from rhot.rig import Rig, load_rig, write_json_model
from rhot.rig.colors import nominal_colors
from rhot_bench.speed.scaling import bare_rig
from rhot_bench.speed.simulated import world_of
from rhot_bench.tracking import two_hands as command
from rhot_bench.tracking.two_hands import named_frames
from rhot_sim.world.paint import paints_of
from rhot_tools.measures.points import PointTrack, identity_swaps

Invoke = Callable[..., str]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    bare = bare_rig(tmp_path_factory.mktemp("two") / "rig", 2, 2)
    paints = paints_of(own_paints(bare.config.markers))
    colors = nominal_colors({name: (red, green, blue) for name, (blue, green, red) in paints.items()})
    write_json_model(bare.colors_path, colors)
    rig = load_rig(bare.path)
    sim = rig.config.sim.model_copy(update={"motion": "crossing"})
    return dataclasses.replace(rig, config=rig.config.model_copy(update={"sim": sim}))


def test_command_measures_every_figure(
    rig: Rig, invoke: Invoke, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextlib.contextmanager
    def ready(seed: int, *, share: bool) -> Iterator[Rig]:
        assert share
        yield rig

    monkeypatch.setattr(command, "_crossing_rig", ready)
    monkeypatch.setattr(command, "SETTLE_S", 0.3)
    file = tmp_path / "two.json"
    invoke(command.two_hands, "--duration", 1, "--names-for", 1, "--json", file)
    sections = json.loads(file.read_text())["sections"]
    rows = {(section["title"], row["name"]): row["value"] for section in sections for row in section["rows"]}
    assert rows["Two hands: Offline, 60 fps", "fingertip position, median"] < 4.0
    assert rows["Two hands: Offline, 60 fps", "swaps between the hands"] == 0
    assert rows["Two hands: Offline, 60 fps", "left hand, 26 joints, all tips measured, mean"] < 12.0
    assert rows["Which hand: 1 s of pictures", "fingertip blobs of a wrong name"] == 0.0
    assert rows["Which hand: 1 s of blobs without pictures", "fingertip blobs of a wrong name"] == 0.0


def test_no_blob_gets_the_other_hands_name_in_two_cycles(rig: Rig) -> None:
    sim = rig.config.sim.model_copy(update={"seed": 4})
    other = dataclasses.replace(rig, config=rig.config.model_copy(update={"sim": sim}))
    world = world_of(other)
    frames = list(named_frames(other, world, 24.0, 4))
    naming = command.wrong_names(other, world, frames)
    assert naming.named > 15_000
    assert naming.wrong == 0


def test_wrong_names_are_counted(rig: Rig) -> None:
    world = world_of(rig)
    frames = list(named_frames(rig, world, 0.5))
    swapped: list[MarkerFrame] = []
    for frame in frames:
        markers = dict(frame.markers)
        if {"ring", "left_index"} <= set(markers):
            markers["ring"], markers["left_index"] = markers["left_index"], markers["ring"]
        swapped.append(frame.model_copy(update={"markers": markers}))
    assert command.wrong_names(rig, world, swapped).wrong > len(frames)


def test_swaps_between_hands_leave_out_those_within_one() -> None:
    true = np.array([[[0.0, 0, 0.8], [0.1, 0, 0.8], [0.2, 0, 0.8]]])
    track = PointTrack(("a", "b", "c"), np.zeros(1), true[:, [1, 0, 2]], np.ones((1, 3), bool), true, np.zeros((1, 3)))
    assert identity_swaps(track) == 2
    assert identity_swaps(track, ("right", "right", "left")) == 0
    assert identity_swaps(track, ("right", "left", "left")) == 2
