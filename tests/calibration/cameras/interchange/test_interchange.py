from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from marker_streams import SQUARE_M, calibration, pinhole_cameras, thesis_cameras

from rhot.errors import CalibrationError, RhotError
from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation
from rhot.rig import CameraCalibration, CamerasFile
from rhot_calibration.cameras.interchange.interchange import export_opencv_yaml, import_cameras

LENS = np.array([0.1, -0.05, 0.001, -0.002, 0.01])


def rig(count: int, names: tuple[str, ...] = ()) -> dict[str, CameraCalibration]:
    cameras = pinhole_cameras(count, LENS)
    return dict(zip(names or tuple(cameras), cameras.values(), strict=True))


def nominal(cameras: dict[str, CameraCalibration]) -> dict[str, CameraCalibration]:
    K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    return {name: calibration(K, np.zeros(0), np.eye(4)) for name in cameras}


def assert_same(read: CamerasFile, wanted: dict[str, CameraCalibration], atol: float = 1e-9) -> None:
    """The same cameras; poses against the first camera."""
    assert list(read.cameras) == list(wanted)
    first = np.linalg.inv(np.array(next(iter(wanted.values())).T_rig_camera))
    for name, camera in wanted.items():
        np.testing.assert_allclose(read.cameras[name].K, camera.K, atol=atol)
        np.testing.assert_allclose(read.cameras[name].distortion, camera.distortion, atol=atol)
        np.testing.assert_allclose(read.cameras[name].T_rig_camera, first @ np.array(camera.T_rig_camera), atol=atol)


def test_the_thesis_pair(thesis_rig: Path) -> None:
    files = [thesis_rig / "intrinsics.yml", thesis_rig / "extrinsics.yml"]
    wanted = thesis_cameras(thesis_rig)
    read = import_cameras(files, nominal(wanted), unit_m=SQUARE_M, names=("right", "left"))
    assert_same(read, wanted, atol=1e-6)
    with pytest.raises(CalibrationError, match=r"75\.6 mm to the left of camera left"):
        import_cameras(files, nominal(wanted), unit_m=SQUARE_M)
    with pytest.raises(CalibrationError, match="in what unit"):
        import_cameras(files, nominal(wanted))
    with pytest.raises(CalibrationError, match="Check the unit"):
        import_cameras(files, nominal(wanted), unit_m=SQUARE_M * 1e3, names=("right", "left"))
    with pytest.raises(CalibrationError, match=r"no R, .*extrinsics\.yml"):
        import_cameras(files[:1], nominal(wanted), unit_m=SQUARE_M)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_opencv_round_trip(tmp_path: Path, count: int) -> None:
    cameras = rig(count)
    files = export_opencv_yaml(CamerasFile(cameras=cameras), tmp_path / "opencv")
    assert {file.name for file in files} == (
        {"intrinsics.yml", "extrinsics.yml"} if count == 2 else {f"{name}.yml" for name in cameras}
    )
    assert_same(import_cameras(files, nominal(cameras), unit_m=1.0), cameras)


def test_the_exported_fundamental_matrix_holds(tmp_path: Path) -> None:
    cameras = rig(2)
    export_opencv_yaml(CamerasFile(cameras=cameras), tmp_path)
    storage = cv2.FileStorage(str(tmp_path / "extrinsics.yml"), cv2.FILE_STORAGE_READ)
    F = storage.getNode("F").mat()
    point = np.array([0.05, -0.03, 0.7, 1.0])
    seen = []
    for camera in cameras.values():
        u = np.array(camera.K) @ (np.linalg.inv(np.array(camera.T_rig_camera)) @ point)[:3]
        seen.append(u / u[2])
    assert abs(seen[1] @ F @ seen[0]) / np.linalg.norm((F @ seen[0])[:2]) < 1e-9


def ros_text(K: list[float], D: list[float], R: list[float], P: list[float], extra: str = "plumb_bob") -> str:
    return (
        f"image_width: 640\nimage_height: 480\ncamera_name: any\ncamera_matrix: {{rows: 3, cols: 3, data: {K}}}\n"
        f"distortion_model: {extra}\ndistortion_coefficients: {{rows: 1, cols: {len(D)}, data: {D}}}\n"
        f"rectification_matrix: {{rows: 3, cols: 3, data: {R}}}\nprojection_matrix: {{rows: 3, cols: 4, data: {P}}}\n"
    )


def ros_pair(folder: Path, cameras: dict[str, CameraCalibration]) -> list[Path]:
    first, second = cameras.values()
    T_21 = np.linalg.inv(np.array(second.T_rig_camera)) @ np.array(first.T_rig_camera)
    K1, K2, D = np.array(first.K), np.array(second.K), np.array(first.distortion)
    R1, R2, P1, P2 = cv2.stereoRectify(K1, D, K2, D, (640, 480), T_21[:3, :3], T_21[:3, 3:].copy())[:4]
    files = []
    for name, K, R, P in (("left", K1, R1, P1), ("right", K2, R2, P2)):
        files.append(folder / f"{name}.yaml")
        files[-1].write_text(ros_text(K.ravel().tolist(), D.tolist(), R.ravel().tolist(), P.ravel().tolist()))
    return files


def test_a_rectified_ros_pair(tmp_path: Path) -> None:
    K = np.array([[530.0, 0.0, 319.5], [0.0, 528.0, 239.5], [0.0, 0.0, 1.0]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector(np.array([0.02, -0.05, 0.01])), (0.075, 0.002, -0.003)
    cameras = {"left": calibration(K, LENS, np.eye(4)), "right": calibration(K, LENS, T)}
    read = import_cameras(ros_pair(tmp_path, cameras), nominal(cameras))
    assert_same(read, cameras, atol=1e-7)


def test_ros_cameras_without_poses_keep_the_nominal_ones(tmp_path: Path) -> None:
    cameras = rig(2)
    P = [530.0, 0.0, 319.5, 0.0, 0.0, 528.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]
    files = []
    for name, camera in cameras.items():
        files.append(tmp_path / f"{name}.yaml")
        files[-1].write_text(
            ros_text(np.ravel(camera.K).tolist(), list(camera.distortion), np.eye(3).ravel().tolist(), P)
        )
    read = import_cameras(files, cameras)
    assert read.cameras == cameras
    assert "nominal" in read.quality["imported"]["poses"]


@pytest.mark.parametrize("style", ["anipose", "caliscope", "nested"])
def test_toml(tmp_path: Path, style: str) -> None:
    cameras = rig(3)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation_from_vector(np.array([0.3, -0.2, 0.5])), (1.0, 2.0, 3.0)
    lines = []
    for number, (name, camera) in enumerate(cameras.items()):
        T = np.linalg.inv(world @ np.array(camera.T_rig_camera))
        lines.append(f"[{'cameras.' if style == 'nested' else 'cam_'}{number}]")
        lines.append(f'name = "{name}"' if style == "anipose" else f"port = {number}\nrotation_count = 0")
        lines.append(f"size = [640, 480]\nmatrix = {np.array(camera.K).tolist()}")
        lines.append(f"distortions = {list(camera.distortion)}")
        lines.append(f"rotation = {vector_from_rotation(T[:3, :3]).tolist()}")
        lines.append(f"translation = {(1e3 * T[:3, 3]).tolist()}")
    lines.append("[metadata]\nadjusted = false")
    file = tmp_path / "calibration.toml"
    file.write_text("\n".join(lines))
    assert_same(import_cameras([file], nominal(cameras), unit_m=1e-3), cameras, atol=1e-8)


GOOD = (
    "[cam_0]\nname = 'a'\nsize = [640, 480]\nmatrix = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]\n"
    "distortions = [0.1, 0.0, 0.0, 0.0, 0.0]\nrotation = [0.0, 0.0, 0.0]\ntranslation = [0.0, 0.0, 0.0]\n"
)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.yml", "", "is empty"),
        ("a.yml", "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [1, 2", "damaged"),
        ("a.yml", "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [1]\n", "damaged"),
        ("a.yml", "%YAML:1.0\n---\nsomething: 3\n", "no camera in it"),
        ("a.xml", '<?xml version="1.0"?>\n<opencv_storage><M1>', "damaged|not an OpenCV"),
        ("a.yaml", "camera_matrix: [1, 2", "not YAML"),
        ("a.yaml", "just text", "not a ROS"),
        ("a.yaml", "camera_matrix: {data: [1, 2]}\n", "needs 9 finite numbers"),
        ("a.yaml", "distortion_model: equidistant\n", "fisheye"),
        ("a.yaml", "distortion_model: division\n", "division is unknown"),
        ("a.toml", "[cam_0\n", "not TOML"),
        ("a.toml", "x = 1\n", "no calibrated camera"),
        ("a.toml", GOOD + "fisheye = true\n", "fisheye"),
        ("a.toml", GOOD + "rotation_count = 1\n", "turned"),
        ("a.toml", GOOD.replace("[640, 480]", "[640]"), "needs 2 finite numbers"),
        ("a.toml", GOOD.replace("[640, 480]", "[1280, 720]"), "1280x720"),
        ("a.toml", GOOD.replace("500.0, 0.0, 320.0", "-500.0, 0.0, 320.0"), "not a camera matrix"),
        ("a.toml", GOOD.replace("240.0", "'x'"), "not a list"),
        ("a.toml", GOOD.replace("320.0", "900.0"), "principal point"),
        ("a.toml", GOOD.replace("[0.1, ", "[nan, "), "finite"),
        ("a.toml", GOOD.replace("[0.1, 0.0, ", "[0.1, "), None),
        ("a.toml", GOOD.replace("[0.1, 0.0, 0.0, ", "[0.1, "), "3 distortion coefficients"),
        ("a.toml", GOOD.replace("rotation = [0.0,", "rotation = ['z',"), "rotation"),
        ("a.toml", GOOD + GOOD.replace("cam_0", "cam_1"), "2 cameras, the rig has 1"),
    ],
)
def test_broken_files_name_what_is_wrong(tmp_path: Path, name: str, text: str, says: str | None) -> None:
    file = tmp_path / name
    file.write_text(text)
    cameras = nominal(rig(1))
    if says is None:
        assert import_cameras([file], cameras).cameras
        return
    with pytest.raises(RhotError, match=says) as caught:
        import_cameras([file], cameras, unit_m=1.0)
    assert name in str(caught.value)


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot be read"):
        import_cameras([tmp_path / "a.yml"], nominal(rig(1)))
    with pytest.raises(CalibrationError, match="no file"):
        import_cameras([], nominal(rig(1)))
    (tmp_path / "file").write_text("")
    with pytest.raises(CalibrationError, match="is a file"):
        export_opencv_yaml(CamerasFile(cameras=rig(1)), tmp_path / "file")
