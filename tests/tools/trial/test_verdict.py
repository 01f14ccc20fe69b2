"""The verdict on trials that are good, and on trials that something was wrong with."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from simulated_take import simulated_rig, write_take

from rhot.cli.main import main
from rhot.messages import HandPose, Marker, MarkerFrame, Message
from rhot.offline import OfflineTracker
from rhot.recording.mcap.reader import open_mcap
from rhot.rig import load_rig
from rhot_tools.trial.verdict import TrialJudge, TrialVerdict

Change = Callable[[dict[str, Any]], None]

# In one worker: they share one take.
pytestmark = pytest.mark.xdist_group("verdicts")


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A rig folder, and 2.5 simulated seconds recorded with it."""
    folder = tmp_path_factory.mktemp("verdicts")
    rig = simulated_rig(folder / "rig")
    write_take(rig, folder / "take.mcap", 0.5, 3.0)
    return folder / "rig", folder / "take.mcap"


@pytest.fixture
def frames(take: tuple[Path, Path]) -> list[MarkerFrame]:
    messages = [sample.message() for sample in open_mcap(take[1]).samples()]
    return [message for message in messages if isinstance(message, MarkerFrame)]


@pytest.fixture
def rig_path(take: tuple[Path, Path], tmp_path: Path) -> Path:
    """A copy of the rig that a test may spoil."""
    path = tmp_path / "rig"
    path.mkdir()
    for file in take[0].iterdir():
        (path / file.name).write_bytes(file.read_bytes())
    return path


def change_cameras(rig_path: Path, change: Change) -> None:
    file = json.loads((rig_path / "cameras.json").read_text())
    change(file["cameras"])
    (rig_path / "cameras.json").write_text(json.dumps(file))


def judged(
    rig_path: Path, frames: Iterable[MarkerFrame], *, smooth: bool = False
) -> tuple[TrialVerdict, list[Message]]:
    rig = load_rig(rig_path)
    tracker, judge = OfflineTracker(rig, smooth=smooth), TrialJudge(rig)
    messages = [message for _, message in tracker.run(frames)]
    for message in messages:
        judge.add(message)
    return judge.verdict(tracker.problems), messages


def measured_share(messages: list[Message]) -> float:
    hands = [message for message in messages if isinstance(message, HandPose)]
    return sum(hand.state == "measured" for hand in hands) / max(len(hands), 1)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_good_trial_is_good(rig_path: Path, frames: list[MarkerFrame], smooth: bool) -> None:
    verdict, messages = judged(rig_path, frames, smooth=smooth)
    assert (verdict.level, verdict.findings, verdict.exit_code) == ("good", (), 0)
    assert measured_share(messages) > 0.95
    values = {name: value for name, value, _ in verdict.figures}
    assert float(values["right hand, fit"].removesuffix(" mm")) < 2.0
    assert float(values["epipolar shift"].removesuffix(" px")) < 0.5


def test_frames_that_nobody_looked_at_are_told(rig_path: Path, frames: list[MarkerFrame]) -> None:
    third, most = ([one for one in frames if one.frame % keep == 0] for keep in (3, 40))
    verdict, _ = judged(rig_path, third)
    assert verdict.level == "doubtful"
    assert "% of the frames of left were not looked at; its machine is too slow" in verdict.findings[0].text
    judge = TrialJudge(load_rig(rig_path))
    for frame in most:
        judge.add(frame)
    nearly_empty = judge.verdict()
    assert (nearly_empty.judged, nearly_empty.exit_code) == (True, 1)
    assert nearly_empty.findings[0].text.startswith(f"only {len(most)} of ")


@pytest.mark.parametrize("since", [0, 20], ids=["from the beginning", "after a while"])
def test_cameras_whose_times_are_apart_are_told_so(rig_path: Path, frames: list[MarkerFrame], since: int) -> None:
    own = [frame for frame in frames if frame.camera == "left"]
    later = {id(frame) for frame in own[since:]}
    hour_ns = 3600 * 10**9
    moved = [f.model_copy(update={"t_ns": f.t_ns + hour_ns}) if id(f) in later else f for f in frames]
    verdict, _ = judged(rig_path, sorted(moved, key=lambda frame: frame.t_ns))
    assert verdict.level == "not usable"
    assert "looked at the same time as another camera for only" in verdict.findings[0].text
    assert not any("colours" in finding.text for finding in verdict.findings)


def test_a_marker_that_no_camera_sees_and_a_blind_camera_are_named(rig_path: Path, frames: list[MarkerFrame]) -> None:
    def without(frame: MarkerFrame, names: set[str]) -> MarkerFrame:
        return frame.model_copy(update={"markers": {n: m for n, m in frame.markers.items() if n not in names}})

    texts = [f.text for f in judged(rig_path, [without(frame, {"base"}) for frame in frames])[0].findings]
    assert texts[0].startswith("no camera sees base: painted and lit as when colours were calibrated?")
    blind = [without(frame, set(frame.markers)) if frame.camera == "left" else frame for frame in frames]
    texts = [finding.text for finding in judged(rig_path, blind)[0].findings]
    assert texts[0].startswith("left sees no marker at all: is its lens free")


def with_wrong_side(rig_path: Path) -> None:
    text = (rig_path / "rig.toml").read_text()
    assert 'hand = "right"' in text
    (rig_path / "rig.toml").write_text(text.replace('hand = "right"', 'hand = "left"'))


@pytest.mark.parametrize("smooth", [False, True])
def test_a_hand_of_the_wrong_side_is_not_called_measured(
    rig_path: Path, frames: list[MarkerFrame], smooth: bool
) -> None:
    with_wrong_side(rig_path)
    verdict, messages = judged(rig_path, frames, smooth=smooth)
    assert verdict.exit_code == 1
    assert "do not fit a left hand" in verdict.findings[0].text
    assert 'set hand = "right" in rig.toml' in verdict.findings[0].text
    assert measured_share(messages) < 0.02


def test_a_mirrored_world_is_named(rig_path: Path, frames: list[MarkerFrame]) -> None:
    """Both cameras mirror, and were calibrated so: everything fits but the hand."""

    def mirror(cameras: dict[str, Any]) -> None:
        M = np.diag([-1.0, 1.0, 1.0, 1.0])
        for camera in cameras.values():
            camera["K"][0][2] = camera["width"] - 1 - camera["K"][0][2]
            camera["distortion"][3] *= -1.0
            camera["T_rig_camera"] = (M @ np.array(camera["T_rig_camera"]) @ M).tolist()

    def mirrored(frame: MarkerFrame, marker: Marker) -> Marker:
        width = frame.width
        side = None if marker.skin_side is None else (-marker.skin_side[0], marker.skin_side[1])
        corners = None if marker.corners is None else tuple((width - 1 - u, v) for u, v in marker.corners)
        return marker.model_copy(update={"u": width - 1 - marker.u, "skin_side": side, "corners": corners})

    def frames_mirrored() -> Iterator[MarkerFrame]:
        for frame in frames:
            markers = {name: mirrored(frame, marker) for name, marker in frame.markers.items()}
            yield frame.model_copy(update={"markers": markers})

    change_cameras(rig_path, mirror)
    verdict, messages = judged(rig_path, frames_mirrored())
    assert verdict.exit_code == 1
    assert "all cameras mirror their pictures" in verdict.findings[0].text
    assert measured_share(messages) < 0.02


def test_swapped_cameras_are_named(rig_path: Path, frames: list[MarkerFrame]) -> None:
    def swap(cameras: dict[str, Any]) -> None:
        cameras["left"], cameras["right"] = cameras["right"], cameras["left"]

    change_cameras(rig_path, swap)
    verdict, _ = judged(rig_path, frames)
    assert verdict.exit_code == 1
    assert "left and right are swapped" in verdict.findings[0].text


@pytest.mark.parametrize(("degrees", "code"), [(0.07, 0), (0.2, 1), (3.0, 1)])
def test_cameras_that_moved_since_their_calibration_are_named(
    rig_path: Path, frames: list[MarkerFrame], degrees: float, code: int
) -> None:
    def turn(cameras: dict[str, Any]) -> None:
        T = np.array(cameras["right"]["T_rig_camera"])
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        T[:3, :3] = T[:3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        cameras["right"]["T_rig_camera"] = T.tolist()

    change_cameras(rig_path, turn)
    verdict, _ = judged(rig_path, frames)
    assert verdict.exit_code == code, verdict.findings
    assert "moved since the calibration" in verdict.findings[0].text


def test_a_short_or_empty_trial_has_no_verdict(rig_path: Path, frames: list[MarkerFrame]) -> None:
    verdict, _ = judged(rig_path, frames[:40])
    assert (verdict.judged, verdict.exit_code) == (False, 0)


def test_export_says_why_a_recording_cannot_be_used(take: tuple[Path, Path], tmp_path: Path) -> None:
    good = CliRunner().invoke(main, ["export", str(take[1]), "--csv", str(tmp_path / "good")])
    assert good.exit_code == 0, good.output
    assert "verdict: good" in good.output
    poor = tmp_path / "rig"
    poor.mkdir()
    for file in take[0].iterdir():
        (poor / file.name).write_bytes(file.read_bytes())
    change_cameras(poor, lambda cameras: cameras.update(left=cameras["right"], right=cameras["left"]))
    words = ["export", str(take[1]), "--csv", str(tmp_path / "poor"), "--rig", str(poor)]
    told = CliRunner().invoke(main, words)
    assert told.return_value == 1 or told.exit_code == 1
    assert "left and right are swapped" in told.output
    assert (tmp_path / "poor").exists()
