"""SteamVR's standing space moves: what was registered holds no longer."""

from __future__ import annotations

import numpy as np
import pytest
from devices.fake_steamvr import FakeSteamVr

from rhot_objects.sources import SpaceMovedError
from rhot_objects.sources.steamvr import SteamVrSource


def opened(steamvr: FakeSteamVr) -> SteamVrSource:
    source = SteamVrSource({"LHR-CUP": "cup"}, load=lambda: steamvr)
    source.open(0)
    return source


def test_a_reset_standing_position_is_told(steamvr: FakeSteamVr) -> None:
    source = opened(steamvr)
    assert "cup" in source.read(1)
    steamvr.reset_standing_position(0.4)
    with pytest.raises(SpaceMovedError, match=r"standing position was reset, by 0\.40 m.*rhot calibrate objects"):
        source.read(2)
    # Told once: what it is now is what the next registration will hold for.
    np.testing.assert_allclose(source.read(3)["cup"].pose.position[0], -0.4)


def test_a_new_room_setup_is_told(steamvr: FakeSteamVr) -> None:
    source = opened(steamvr)
    source.read(1)
    steamvr.set_up_room()
    with pytest.raises(SpaceMovedError, match="universe has changed"):
        source.read(2)


def test_a_space_that_moved_while_steamvr_was_down_is_told(steamvr: FakeSteamVr) -> None:
    source = opened(steamvr)
    source.read(1)
    source.close()
    steamvr.reset_standing_position(0.4, tells=False)
    source.open(0)
    with pytest.raises(SpaceMovedError, match="standing position was reset"):
        source.read(2)


def test_a_move_shows_once_steamvr_tells_its_space_again(steamvr: FakeSteamVr) -> None:
    source = opened(steamvr)
    source.read(1)
    source.close()
    steamvr.reset_standing_position(0.4, tells=False)
    steamvr.tells_space = False
    source.open(0)
    assert "cup" in source.read(2)
    steamvr.tells_space = True
    with pytest.raises(SpaceMovedError, match="standing position was reset"):
        source.read(3)


@pytest.mark.parametrize("event", [801, 808])
def test_an_event_without_a_change_is_none(steamvr: FakeSteamVr, event: int) -> None:
    source = opened(steamvr)
    source.read(1)
    steamvr.events.append(event)
    assert "cup" in source.read(2)


@pytest.mark.parametrize("event", [801, 808])
def test_where_steamvr_does_not_say_the_event_is_believed(steamvr: FakeSteamVr, event: int) -> None:
    steamvr.tells_space = False
    source = opened(steamvr)
    # Before the first pose, as when SteamVR recognises its universe: nothing was registered wrongly.
    steamvr.events.append(event)
    assert "cup" in source.read(1)
    steamvr.events.append(event)
    with pytest.raises(SpaceMovedError):
        source.read(2)
    assert "cup" in source.read(3)
