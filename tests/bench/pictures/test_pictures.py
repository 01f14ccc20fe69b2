"""`rhot evaluate pictures`: calibrated by our own commands, and scored by the data's own scorer."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot.offline import track
from rhot.recording import load_recording
from rhot.rig import Rig
from rhot_bench.motion.references.plain_ekf import plain_ekf
from rhot_bench.motion.references.spline_reference import views_of
from rhot_bench.pictures.rendered import (
    Measures,
    at_rate_of,
    found_markers,
    prepare_rig,
    read_marker_frames,
    require_pictures,
)
from rhot_bench.pictures.scoring import score_estimates, score_messages

# In one worker: what they share takes seconds.
pytestmark = pytest.mark.xdist_group("rendered pictures")


@pytest.fixture(scope="module")
def pictures(shared_data: Path) -> Path:
    if not (shared_data / "rendered").is_dir():
        pytest.skip(f"no rendered pictures at {shared_data / 'rendered'}")
    return require_pictures(shared_data)


@pytest.fixture(scope="module")
def kept(pictures: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Rig]:
    folder = tmp_path_factory.mktemp("kept")
    return folder, prepare_rig(pictures, folder / "rig")


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no rendered pictures"):
        require_pictures(tmp_path)


def test_what_is_missing_of_the_pictures_is_named(tmp_path: Path) -> None:
    (tmp_path / "G1").mkdir()
    (tmp_path / "score.py").touch()
    with pytest.raises(ConfigError, match=r"C/left/timestamps.csv, .*calib.json, hand.json missing"):
        require_pictures(tmp_path)


def test_another_set_is_measured_by_what_it_states_of_its_hand_patch_and_board(tmp_path: Path) -> None:
    hand = {
        "bone_lengths_mm": {"middle": {"proximal": 45.0, "middle": 28.0, "distal_to_tip": 26.2}},
        "mcp_in_hand_frame_mm": {"middle": [0.0, 90.0, 0.0]},
        "base_patch_mm": [40, 30, 0.5],
    }
    (tmp_path / "hand.json").write_text(json.dumps(hand))
    (tmp_path / "C").mkdir()
    (tmp_path / "C" / "truth_boards.json").write_text('{"pattern": "8x5 inner corners, 30.0 mm"}')
    measures = Measures.of(tmp_path, side="left")
    assert (measures.length_m, measures.width_m) == pytest.approx((0.189, 0.081))
    assert measures.patch_m == pytest.approx((0.040, 0.030))
    assert (measures.board, measures.side) == ((8, 5), "left")
    assert measures.square_m == pytest.approx(0.030)
    assert Measures.of(tmp_path, width_m=0.085).width_m == 0.085

    (tmp_path / "hand.json").write_text("[]")
    with pytest.raises(ConfigError, match=r"hand.json: does not describe a hand"):
        Measures.of(tmp_path)


def test_the_rig_is_what_a_person_would_have_set_up(kept: tuple[Path, Rig]) -> None:
    _, rig = kept
    first, second = (np.array(camera.T_rig_camera)[:3, 3] for camera in rig.cameras.values())
    assert np.linalg.norm(second - first) == pytest.approx(0.090, abs=0.0005)
    assert rig.hand.length_m == pytest.approx(0.172)
    assert rig.config.markers["base"].size_m == (0.035, 0.025)
    assert rig.config.cameras["left"].readout_s == pytest.approx(0.014)


def test_cameras_run_at_the_recordings_rate(pictures: Path, kept: tuple[Path, Rig]) -> None:
    rig = at_rate_of(kept[1], load_recording(pictures / "G2"))
    assert rig.config.cameras["right"].rate_hz == pytest.approx(30.0, abs=0.01)


def test_kept_markers_are_read_again_as_they_were_and_score(pictures: Path, kept: tuple[Path, Rig]) -> None:
    folder, rig = kept
    found = found_markers(rig, pictures, "G1", folder)
    assert found == list(read_marker_frames(folder / "G1.jsonl"))
    assert found == found_markers(rig, pictures, "G1", folder)
    names = list(rig.config.markers)
    score = score_estimates(pictures, "G1", plain_ekf(views_of(found, rig), len(found), len(names)), names)
    # Limits as wide as a change of the detector may move them; the plain filter gave 1.24 mm and 96.8 %.
    assert score.median_mm < 2.0
    assert score.coverage > 90.0
    # The plain filter knows nothing of paint that is hidden: a strip of a fingertip takes it 25 mm away. Ours is not.
    ours = score_messages(pictures, "G1", track(at_rate_of(rig, load_recording(pictures / "G1")), iter(found)))
    assert ours.swaps == ours.hallucinations == 0
