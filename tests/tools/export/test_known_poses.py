"""A left hand is a left hand, up is up, and metres are metres, in every file of motion.

Files are read by programs that are not ours: TRC by trc-data-reader, C3D by c3d, MOT and glTF by parsers of their own
that keep to the specifications; BVH by that of `test_bvh`. Each of the four poses is compared joint by joint with
where it is above the floor, and looked at as a person would.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import c3d
import numpy as np
import pytest
from bridged.poses import POSES, T_RIG_STAGE, hand, hand_message
from click.testing import CliRunner
from exported import person
from exported.bvh_reader import read_bvh_file, world_positions
from exported.gltf_reader import GltfScene
from scipy.spatial.transform import Rotation
from trc import TRCData

from rhot.anatomy.skeleton import CHAINS, JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.messages import Side
from rhot_tools.recordings.export import export

At = Callable[[float, str], FloatArray]
"""Seconds from the first pose and a name of ours to a position (3,), metres, y up."""

SIDES: tuple[Side, ...] = ("left", "right")


def exported(recording: Path, folder: Path, *options: str) -> list[str]:
    done = CliRunner().invoke(export, [str(recording), *(each.replace("@", str(folder)) for each in options)])
    assert done.exit_code == 0, done.output + repr(done.exception)
    assert "no floor" not in done.output
    return done.output.splitlines()


def read_trc(recording: Path, folder: Path) -> At:
    exported(recording, folder, "--trc", "@/x.trc")
    data = TRCData()
    data.load(str(folder / "x.trc"))
    assert data["Units"] == "m"
    assert float(data["DataRate"]) == pytest.approx(100.0, abs=1e-3)
    assert data["Time"][0] == 0.0
    times = np.array(data["Time"])
    return lambda t_s, name: np.array(data[name][int(np.abs(times - t_s).argmin())])


def read_c3d(recording: Path, folder: Path) -> At:
    exported(recording, folder, "--c3d", "@/x.c3d")
    with (folder / "x.c3d").open("rb") as stream:
        reader = c3d.Reader(stream)
        labels = [label.strip() for label in reader.point_labels]
        assert reader.get("POINT:UNITS").string_value.strip() == "mm"
        assert reader.get("POINT:Y_SCREEN").string_value.strip() == "+Y"
        rate_hz = float(reader.point_rate)
        points = np.stack([frame for _, frame, _ in reader.read_frames()])
    assert rate_hz == pytest.approx(100.0, abs=1e-3)
    assert (points[..., 3] == -1).any(axis=0)[labels.index("foot_left")], "feet begin a little later: a gap"
    return lambda t_s, name: 1e-3 * points[round(t_s * rate_hz), labels.index(name), :3].astype(np.float64)


def read_gltf(suffix: str) -> Callable[[Path, Path], At]:
    def read(recording: Path, folder: Path) -> At:
        exported(recording, folder, "--gltf", f"@/x{suffix}")
        scene = GltfScene(folder / f"x{suffix}")
        return lambda t_s, name: scene.position(name, t_s)

    return read


def read_bvh(recording: Path, folder: Path) -> At:
    files = {}
    for name in ("hand_left", "hand_right", "object_cube", "head", "foot_left", "foot_right", "body"):
        exported(recording, folder, "--bvh", f"@/{name}.bvh", "--bvh-of", name)
        files[name] = read_bvh_file((folder / f"{name}.bvh").read_text())

    def at(t_s: float, name: str) -> FloatArray:
        thing = next(each for each in files if name.startswith(each))
        root, interval_s, frames = files[thing]
        found = world_positions(root, frames[min(round(t_s / interval_s), len(frames) - 1)])
        joint = name.removeprefix(thing).removeprefix("_") or "origin"
        ends = {chain[-1]: f"{chain[-2]} end" for chain in CHAINS.values()}
        ends |= {f"{side}_foot": f"{side}_ankle end" for side in SIDES}
        ends |= {"head": "neck end"} if thing == "body" else {}
        ends |= {f"{side}_wrist": f"{side}_elbow end" for side in SIDES}
        return 0.01 * found[ends.get(joint, joint)]

    return at


READERS = {"bvh": read_bvh, "trc": read_trc, "c3d": read_c3d, "glb": read_gltf(".glb"), "gltf": read_gltf(".gltf")}


# In one worker: what they share takes seconds.
pytestmark = pytest.mark.xdist_group("known poses")


@pytest.fixture(params=list(READERS), scope="module")
def at(request: pytest.FixtureRequest, poses_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> At:
    return READERS[request.param](poses_recording, tmp_path_factory.mktemp(request.param))


def look_at(pose: str, side: Side, p: Callable[[str], FloatArray]) -> None:
    """What a person would see."""
    inwards = 1.0 if side == "left" else -1.0
    ahead = p("middle_tip") - p("wrist")
    across = p("index_proximal") - p("little_proximal")
    assert 1.0 < p("wrist")[1] < 1.2, "as high above the floor as it was held"
    assert p("wrist")[0] * inwards < -0.15, "a left hand is on the left"
    if pose == "flat":
        assert 0.15 < np.linalg.norm(ahead) < 0.22, "metres"
        assert ahead[2] < -0.15, "fingers point forward"
        assert p("thumb_tip")[0] * inwards > p("little_tip")[0] * inwards, "palm down, thumbs point at one another"
    elif pose == "fist":
        assert np.linalg.norm(ahead) < 0.12
        assert p("middle_tip")[1] < p("middle_proximal")[1] - 0.01, "fingers close downwards, into the palm"
    elif pose == "thumb up":
        assert p("thumb_tip")[1] - p("wrist")[1] > 0.06, "up is up"
        assert across[1] > 0.03
        assert p("middle_tip")[0] * inwards > p("middle_proximal")[0] * inwards, "palms face one another"
    else:
        assert (p("index_tip") - p("wrist"))[2] < -0.14, "the index finger points forward"
        assert (p("middle_tip") - p("wrist"))[2] > -0.12, "and it alone"


@pytest.mark.parametrize("side", SIDES)
def test_hands(at: At, side: Side) -> None:
    for number, pose in enumerate(POSES):
        t_s = (number + 0.5) * person.SECONDS_A_POSE
        truth = dict(zip(JOINTS, hand(pose, side).positions, strict=True))
        found = {joint: at(t_s, f"hand_{side}_{joint}") for joint in JOINTS}
        for joint in JOINTS:
            np.testing.assert_allclose(found[joint], truth[joint], atol=2e-5, err_msg=f"{pose} {side} {joint}")
        look_at(pose, side, found.__getitem__)


def test_all_the_rest(at: At) -> None:
    np.testing.assert_allclose(at(0.7, "object_cube"), (0.0, 0.75, -0.6), atol=2e-5)
    np.testing.assert_allclose(at(0.7, "head"), person.HEAD, atol=2e-5)
    for side in SIDES:
        np.testing.assert_allclose(at(0.7, f"foot_{side}"), person.FEET[side], atol=2e-5)
    for name, position in person.JOINTS.items():
        np.testing.assert_allclose(at(0.7, f"body_{name}"), position, atol=2e-5)


def test_rigid_things_have_axes_in_files_of_markers(poses_recording: Path, tmp_path: Path) -> None:
    at = read_trc(poses_recording, tmp_path)
    for axis, direction in zip("xyz", np.eye(3), strict=True):
        np.testing.assert_allclose(at(0.7, f"foot_left_{axis}") - at(0.7, "foot_left"), 0.1 * direction, atol=2e-5)


def test_angles_are_degrees_by_opensims_names_and_signs(poses_recording: Path, tmp_path: Path) -> None:
    exported(poses_recording, tmp_path, "--mot", "@/x.mot")
    columns, time_range = read_mot(tmp_path / "x.mot")
    fist = np.abs(columns["time"] - 0.75).argmin()
    assert time_range[0] == 0.0
    assert columns["hand_left_index_pip_flexion"][fist] == pytest.approx(np.degrees(1.7), abs=1e-4)
    thumb = [name.removeprefix("hand_right_thumb_") for name in columns if name.startswith("hand_right_thumb_")]
    assert sorted(thumb) == ["cmc_abduction", "cmc_flexion", "ip_flexion", "mcp_flexion"]
    assert columns["hand_right_thumb_cmc_flexion"][fist] == pytest.approx(np.degrees(0.6), abs=1e-4)
    wrist = hand_message("fist", "right", 0).joints["wrist"].orientation
    R = T_RIG_STAGE[:3, :3].T @ rotation_from_quaternion(np.array(wrist))
    yaw, pitch, roll = (float(columns[f"hand_right_wrist_{name}"][fist]) for name in ("yaw", "pitch", "roll"))
    np.testing.assert_allclose(Rotation.from_euler("YXZ", [yaw, pitch, roll], degrees=True).as_matrix(), R, atol=1e-6)
    assert columns["knee_angle_r"][fist] == pytest.approx(np.degrees(person.KNEE_RAD), abs=1e-4)
    assert columns["hip_adduction_l"][fist] == pytest.approx(-np.degrees(0.05), abs=1e-4)
    assert columns["hip_rotation_l"][fist] == pytest.approx(-np.degrees(0.02), abs=1e-4)
    assert columns["ankle_angle_l"][fist] == pytest.approx(-np.degrees(0.1), abs=1e-4)


def read_mot(file: Path) -> tuple[dict[str, FloatArray], tuple[float, float]]:
    """Read a motion file strictly as OpenSim's documentation has it ("Motion (.mot) Files", form 2)."""
    head, _, data = file.read_text().partition("endheader\n")
    lines = head.splitlines()
    assert lines[0] == "x"
    stated = dict(line.split("=") for line in lines if "=" in line)
    assert stated["inDegrees"] == "yes"
    rows = data.splitlines()
    labels = rows[0].split("\t")
    values = np.array([[float(cell) for cell in row.split("\t")] for row in rows[1:]])
    assert labels[0] == "time"
    assert len(set(labels)) == len(labels)
    assert values.shape == (int(stated["nRows"]), int(stated["nColumns"]))
    assert (np.diff(values[:, 0]) > 0).all()
    return dict(zip(labels, values.T, strict=True)), (values[0, 0], values[-1, 0])
