from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import things
from click.testing import CliRunner, Result
from touched.take import take, touch_rig, write_take

from rhot.errors import CalibrationError, ConfigError
from rhot.geometry.rotations import rotation_between, rotation_from_quaternion
from rhot.rig import RegistrationFile, Rig, RigidTransform, read_json_model, write_json_model
from rhot.rig.toml_edit import change_rig_file
from rhot_calibration.objects.command import objects
from rhot_calibration.objects.touch.streams import TOUCHES_A_FACE
from rhot_sim.world import touching

ROUND_S = 56.0
"""All touches of the simulated world."""


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return touch_rig(tmp_path / "rig")


def run(rig: Rig, *arguments: str | Path) -> Result:
    return CliRunner().invoke(objects, [*map(str, arguments), "--rig", str(rig.path)], catch_exceptions=False)


def off(file: RegistrationFile) -> tuple[float, float]:
    found = file.T_tracker_object["cube"]
    true = touching.T_DEVICE_OBJECT
    turned = rotation_between(true[:3, :3], rotation_from_quaternion(np.array(found.orientation)))
    moved_mm = 1e3 * float(np.linalg.norm(np.array(found.position) - true[:3, 3]))
    return moved_mm, float(np.degrees(np.linalg.norm(turned)))


def test_the_world_touches_in_the_order_in_which_the_command_asks() -> None:
    assert touching.TOUCHES_A_FACE == TOUCHES_A_FACE


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_recording_of_touches_gives_the_offset(rig: Rig, tmp_path: Path, seed: int) -> None:
    file = write_take(tmp_path / "take.mcap", take(rig.path, rig, ROUND_S, seed=seed))
    before = read_json_model(rig.path / "registration.simulated.json", RegistrationFile)
    other = before.model_copy(
        update={"T_tracker_object": {"cup": RigidTransform(position=(0.1, 0.0, 0.0), orientation=(0.0, 0.0, 0.0, 1.0))}}
    )
    write_json_model(rig.path / "registration.simulated.json", other)
    done = run(rig, "--touch", "cube", file)
    assert "RMS over 20 touches" in done.output
    written = read_json_model(rig.path / "registration.simulated.json", RegistrationFile)
    off_mm, off_deg = off(written)
    assert off_mm < 2.0
    assert off_deg < 1.0
    assert written.T_rig_tracker == before.T_rig_tracker
    assert written.T_tracker_object["cup"] == other.T_tracker_object["cup"]
    assert written.quality["touched"]["cube"]["touches"] == 20
    assert read_json_model(rig.path / "registration.simulated.previous.json", RegistrationFile) == other


def test_an_offset_that_is_there_is_undone_first(rig: Rig, tmp_path: Path) -> None:
    before = read_json_model(rig.path / "registration.simulated.json", RegistrationFile)
    wrong = RigidTransform(position=(0.05, 0.0, -0.1), orientation=(0.0, 0.6, 0.0, 0.8))
    write_json_model(
        rig.path / "registration.simulated.json", before.model_copy(update={"T_tracker_object": {"cube": wrong}})
    )
    done = run(rig, "--touch", "cube", write_take(tmp_path / "take.mcap", take(rig.path, rig, ROUND_S)))
    assert "the offset before was" in done.output
    off_mm, _ = off(read_json_model(rig.path / "registration.simulated.json", RegistrationFile))
    assert off_mm < 2.0


def test_a_dry_run_writes_nothing(rig: Rig, tmp_path: Path) -> None:
    text = (rig.path / "registration.simulated.json").read_text()
    done = run(rig, "--touch", "cube", write_take(tmp_path / "take.mcap", take(rig.path, rig, ROUND_S)), "--dry-run")
    assert "nothing was written" in done.output
    assert (rig.path / "registration.simulated.json").read_text() == text


def test_faces_in_another_order_are_refused(rig: Rig, tmp_path: Path) -> None:
    file = write_take(tmp_path / "take.mcap", take(rig.path, rig, ROUND_S))
    with pytest.raises(CalibrationError, match="contradict"):
        run(rig, "--touch", "cube", file, "--faces", "top,front,left,back,right")


def test_a_session_that_ends_early_says_what_is_missing(rig: Rig, tmp_path: Path) -> None:
    file = write_take(tmp_path / "take.mcap", take(rig.path, rig, 29.0))
    with pytest.raises(CalibrationError, match="left or right, too"):
        run(rig, "--touch", "cube", file)


@pytest.mark.parametrize(("hand", "finger"), [("predicted", "predicted"), ("measured", "predicted")])
def test_fingers_that_no_camera_sees_touch_nothing(rig: Rig, tmp_path: Path, hand: str, finger: str) -> None:
    messages = take(rig.path, rig, 15.0, hand=hand, finger=finger)  # type: ignore[arg-type]
    with pytest.raises(CalibrationError, match="touch"):
        run(rig, "--touch", "cube", write_take(tmp_path / "take.mcap", messages))


def test_calls_that_cannot_work_say_why(rig: Rig, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no \[objects.cup\]; there is cube"):
        run(rig, "--touch", "cup")
    with pytest.raises(ConfigError, match="no face 'side'"):
        run(rig, "--touch", "cube", "--faces", "top,side")
    with pytest.raises(ConfigError, match="no finger is called 'pinky'"):
        run(rig, "--touch", "cube", "--finger", "pinky")
    with pytest.raises(ConfigError, match="the left hand; the rig tracks right"):
        run(rig, "--touch", "cube", "--hand", "left")
    with pytest.raises(ConfigError, match="is not there"):
        run(rig, "--touch", "cube", tmp_path / "absent.mcap")
    file = write_take(tmp_path / "hand.mcap", (pair for pair in take(rig.path, rig, 1.0) if "hand" in pair[0]))
    with pytest.raises(ConfigError, match="no rhot/object/cube in it"):
        run(rig, "--touch", "cube", file)
    change_rig_file(rig.path, {("objects", "cube"): {"source": "recorded", "path": "a.csv"}})
    text = (rig.path / "rig.toml").read_text()
    (rig.path / "rig.toml").write_text("\n".join(line for line in text.splitlines() if not line.startswith("shape")))
    with pytest.raises(ConfigError, match=r"\[objects.cube\] has no shape.*add for instance"):
        run(rig, "--touch", "cube")
    things.save(things.mug(), rig.path / "cup.glb")
    toml = (rig.path / "rig.toml").read_text()
    mesh = '[objects.cube]\nshape = { kind = "mesh", file = "cup.glb" }'
    (rig.path / "rig.toml").write_text(toml.replace("[objects.cube]", mesh))
    box = r'is a mesh, .*Touch it as the box .*shape = \{ kind = "box", size = \[0.08, 0.095, 0.115\] \}'
    with pytest.raises(ConfigError, match=box):
        run(rig, "--touch", "cube")
