from __future__ import annotations

import asyncio
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bus_watch import PATIENCE_S
from click.testing import CliRunner, Result

from rhot.arrays import FloatArray
from rhot.bus import Bus
from rhot.calibration_step import StepContext
from rhot.errors import BusError, CalibrationError, ConfigError
from rhot.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from rhot.messages import ObjectPose, Point, PointSet
from rhot.rig import BusConfig, RegistrationFile, RigidTransform, read_json_model, write_json_model
from rhot_calibration.objects.command import COLUMNS, objects, read_places
from rhot_calibration.objects.live import PlaceCollector
from rhot_calibration.objects.page_step import ObjectStep
from rhot_objects.pose import Pose, Registration

R = rotation_from_vector(np.array([0.4, -1.2, 0.7]))
T = np.array([0.3, 0.9, 1.6])
LEVER = np.array([0.01, -0.03, 0.02])
MIDDLE = np.array([0.0, 0.0, 0.8])
CORNERS = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)] + [[1, 0, 0], [-1, 0, 0]], float)


def shown(
    seed: int = 1, noise_m: float = 1e-3, moved_m: FloatArray | None = None, turned_deg: float = 0.0
) -> FloatArray:
    """Rows (10, 10) of a table; the space may have moved and turned (about its middle) since."""
    rng = np.random.default_rng(seed)
    x = MIDDLE + CORNERS * [0.2, 0.15, 0.15] + rng.uniform(-0.02, 0.02, (10, 3))
    axes = rng.normal(size=(10, 3))
    R_device = np.array([rotation_from_vector(one / np.linalg.norm(one)) for one in axes])
    p = (x - T) @ R - R_device @ LEVER
    drift = rotation_from_vector(np.radians(turned_deg) * np.array([0.0, 1.0, 0.0]))
    seen = (x - MIDDLE) @ drift.T + MIDDLE + (0.0 if moved_m is None else moved_m)
    return np.column_stack([seen + rng.normal(0.0, noise_m, x.shape), p, quaternion_from_rotation(R_device)])


def write_table(file: Path, rows: FloatArray) -> Path:
    lines = [",".join(COLUMNS), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
    file.write_text("\n".join(lines) + "\n")
    return file


FILE = "registration.steamvr.json"
"""Of the only source of objects that a rig without objects can have."""


def run(rig: Path, *arguments: str | Path) -> Result:
    return CliRunner().invoke(objects, [*map(str, arguments), "--rig", str(rig)], catch_exceptions=False)


def registration(rig: Path) -> RegistrationFile:
    return read_json_model(rig / FILE, RegistrationFile)


def off(file: RegistrationFile, moved_m: FloatArray | float = 0.0) -> tuple[float, float]:
    """Return the error of a registration at the middle of the places, mm, and of its rotation, degrees."""
    R_found = rotation_from_quaternion(np.array(file.T_rig_tracker.orientation))
    found = R_found @ (R.T @ (MIDDLE - T)) + np.array(file.T_rig_tracker.position)
    turn = np.degrees(np.linalg.norm(vector_from_rotation(R_found @ R.T)))
    return 1e3 * float(np.linalg.norm(found - MIDDLE - moved_m)), float(turn)


def test_a_table_becomes_a_registration(rig_folder: Path, tmp_path: Path) -> None:
    cup = RigidTransform(position=(0.1, 0.0, 0.0), orientation=(0.0, 0.0, 0.0, 1.0))
    write_json_model(
        rig_folder / "registration.json",
        RegistrationFile(T_rig_tracker=RigidTransform.identity(), T_tracker_object={"cup": cup}),
    )
    done = run(rig_folder, write_table(tmp_path / "places.csv", shown()))
    assert done.exit_code == 0
    assert "places.csv:2" in done.output
    assert "RMS over 10 places" in done.output
    written = registration(rig_folder)
    off_mm, off_deg = off(written)
    assert off_mm < 1.5
    assert off_deg < 0.3
    assert written.T_tracker_object == {"cup": cup}, "where the objects sit on their devices stays"
    assert written.quality["places"] == 10
    assert 0.3 < written.quality["position_sd_mm"] < 2.0
    np.testing.assert_allclose(written.quality["lever_m"], LEVER, atol=2e-3)
    assert (rig_folder / "registration.steamvr.previous.json").exists()


def test_a_dry_run_writes_nothing(rig_folder: Path, tmp_path: Path) -> None:
    done = run(rig_folder, write_table(tmp_path / "places.csv", shown()), "--dry-run")
    assert "nothing was written" in done.output
    assert not (rig_folder / FILE).exists()


def test_realign_with_one_place_moves_and_does_not_turn(rig_folder: Path, tmp_path: Path) -> None:
    run(rig_folder, write_table(tmp_path / "first.csv", shown(noise_m=2e-4)))
    first = registration(rig_folder)
    moved = np.array([0.006, -0.003, 0.002])
    # The place nearest to the middle of all.
    rows = shown(seed=2, noise_m=2e-4, moved_m=moved)
    nearest = np.argsort(np.linalg.norm(rows[:, :3] - MIDDLE, axis=1))[:1]
    done = run(rig_folder, write_table(tmp_path / "now.csv", rows[nearest]), "--realign")
    assert "changed by" in done.output
    assert "one place cannot tell" in done.output
    written = registration(rig_folder)
    assert off(first, moved)[0] > 6.5
    assert off(written, moved)[0] < 1.5
    assert off(written)[1] < 0.15
    assert written.quality["method"] == "realigned"
    assert 4.0 < written.quality["moved_mm"] < 8.0
    assert written.quality["rotation_sd_deg"] > 0.15, "a place cannot make the rotation surer"
    assert read_json_model(rig_folder / "registration.steamvr.previous.json", RegistrationFile) == first


def test_realign_with_four_places_turns_too(rig_folder: Path, tmp_path: Path) -> None:
    run(rig_folder, write_table(tmp_path / "first.csv", shown(noise_m=2e-4)))
    moved = np.array([0.004, 0.0, -0.003])
    rows = shown(seed=3, noise_m=2e-4, moved_m=moved, turned_deg=0.4)[[0, 3, 5, 6]]
    run(rig_folder, write_table(tmp_path / "now.csv", rows), "--realign")
    off_mm, turned_deg = off(registration(rig_folder), moved)
    assert off_mm < 1.0
    assert turned_deg == pytest.approx(0.4, abs=0.1)


def test_realign_refuses_what_is_no_drift(rig_folder: Path, tmp_path: Path) -> None:
    table = write_table(tmp_path / "places.csv", shown(moved_m=np.array([0.08, 0.0, 0.0])))
    with pytest.raises(ConfigError, match="register once without"):
        run(rig_folder, table, "--realign")
    run(rig_folder, write_table(tmp_path / "first.csv", shown()))
    with pytest.raises(CalibrationError, match="Register again without --realign"):
        run(rig_folder, table, "--realign")
    run(rig_folder, table, "--realign", "--drift-mm", "100")
    assert off(registration(rig_folder), np.array([0.08, 0.0, 0.0]))[0] < 1.5


def test_realign_of_a_registration_of_unknown_origin_asks_for_the_lever(rig_folder: Path, tmp_path: Path) -> None:
    x, y, z, w = quaternion_from_rotation(R).tolist()
    by_hand = RegistrationFile(T_rig_tracker=RigidTransform(position=(0.3, 0.9, 1.6), orientation=(x, y, z, w)))
    write_json_model(rig_folder / "registration.json", by_hand)
    moved = np.array([0.006, 0.0, 0.0])
    table = write_table(tmp_path / "now.csv", shown(noise_m=1e-4, moved_m=moved)[8:9])
    assert "--lever X,Y,Z" in run(rig_folder, table, "--realign", "--dry-run").output
    run(rig_folder, table, "--realign", "--lever", "10,-30,20", "--lever-sd-mm", "0.5")
    assert off(registration(rig_folder), moved)[0] < 1.5


def test_a_damaged_record_is_named(rig_folder: Path, tmp_path: Path) -> None:
    table = write_table(tmp_path / "first.csv", shown())
    run(rig_folder, table)
    content = json.loads((rig_folder / FILE).read_text())
    damages: list[tuple[str, Any]] = [("covariance", [[0.0] * 9] * 9), ("covariance", [1.0]), ("lever_m", "long")]
    for field, value in damages:
        damaged = {**content, "quality": {**content["quality"], field: value}}
        (rig_folder / FILE).write_text(json.dumps(damaged))
        with pytest.raises(CalibrationError, match=rf"quality\.{field}.*without --realign"):
            run(rig_folder, table, "--realign")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", ":1: no column rig_x_m"),
        (",".join(COLUMNS[:-1]) + "\n", ":1: no column tracker_qw"),
        (",".join(COLUMNS) + "\n0,0,0,0,0,0,0,0,0,1\n0,0,x,0,0,0,0,0,0,1\n", ":3: rig_z_m is 'x'"),
        (",".join(COLUMNS) + "\n0,0,0,0,0,0,0,0,0\n", ":2: tracker_qw is ''"),
        (",".join(COLUMNS) + "\n0,0,0,0,inf,0,0,0,0,1\n", ":2: tracker_y_m is inf"),
        (",".join(COLUMNS) + "\n0,0,812,0,0,0,0,0,0,1\n", "millimetres"),
        (",".join(COLUMNS) + "\n0,0,0,0,0,0,0,0,0,0\n", ":2: tracker_qx … tracker_qw has norm 0"),
        (",".join((*COLUMNS, "sigma_m")) + "\n0,0,0,0,0,0,0,0,0,1,-1\n", ":2: sigma_m is -1"),
        (",".join(COLUMNS) + "\n", "0 places are too few"),
    ],
)
def test_a_wrong_table_is_named_by_line_and_column(rig_folder: Path, tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "places.csv").write_text(text)
    with pytest.raises(CalibrationError, match=says):
        run(rig_folder, tmp_path / "places.csv")


def test_unreadable_tables_are_refused(tmp_path: Path) -> None:
    (tmp_path / "picture.csv").write_bytes(b"\xff\xd8\xff\xe0")
    for file in (tmp_path / "picture.csv", tmp_path / "absent.csv"):
        with pytest.raises(CalibrationError, match="cannot be read"):
            read_places(file)


def test_calls_that_cannot_work_say_why(rig_folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"PLACES\.csv"):
        run(rig_folder)
    with pytest.raises(ConfigError, match="--object"):
        run(rig_folder, "--live")
    with pytest.raises(ConfigError, match=r"no \[objects.cup\]"):
        run(rig_folder, "--live", "--object", "cup", "--marker", "index")
    assert "three lengths" in run(rig_folder, "--lever", "1,2").output
    assert "three numbers" in run(rig_folder, "--lever", "a,b,c").output


class Hand:
    """Somebody who moves a tracker with a marker on it, sampled at 60 Hz on the rig clock."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(5)
        self.t_ns = 1_700_000_000_000_000_000

    def sample(self, place: Pose) -> tuple[int, FloatArray, Pose]:
        """Return time, marker as the cameras see it (2 mm of shake), and device pose for a device pose in space."""
        self.t_ns += 16_666_667
        device = Pose.from_arrays(place.position + self.rng.normal(0.0, 2e-4, 3), place.orientation_xyzw)
        x = R @ (rotation_from_quaternion(place.orientation_xyzw) @ LEVER + place.position) + T
        return self.t_ns, x + self.rng.normal(0.0, 1e-3, 3), device

    def poses(self) -> list[Pose]:
        return [Pose.from_arrays(row[3:6], row[6:10]) for row in shown(noise_m=0.0)]


def feed(collector: PlaceCollector, hand: Hand, places: list[Pose]) -> None:
    for place in places:
        t_ns, x, device = hand.sample(place)
        collector.add_point(t_ns, x, 2e-3)
        collector.add_pose(t_ns, device)


def between(first: Pose, second: Pose, count: int = 20) -> list[Pose]:
    """The way from one place to the next: the position in a straight line, the orientation at once."""
    return [
        Pose.from_arrays(first.position + share * (second.position - first.position), second.orientation_xyzw)
        for share in np.linspace(0.0, 1.0, count)
    ]


def test_a_place_is_taken_when_both_are_still_and_only_once() -> None:
    collector, hand = PlaceCollector(), Hand()
    first, second, *_ = hand.poses()
    assert collector.hint == "the cameras do not see the marker"
    feed(collector, hand, between(second, first, 60))
    assert not collector.places, "it moves"
    assert collector.hint == "hold it still"
    feed(collector, hand, [first] * 120)
    assert len(collector.places) == 1
    assert collector.hint == "go to another place, and turn it"
    feed(collector, hand, [*between(first, second), *[second] * 40])
    assert len(collector.places) == 2
    taken = collector.to_places()
    np.testing.assert_allclose(taken.p_space_device, [first.position, second.position], atol=5e-4)
    turned = Pose.from_arrays(second.position, quaternion_from_rotation(rotation_from_vector(np.array([1.0, 0.2, 0]))))
    feed(collector, hand, [turned] * 40)
    assert len(collector.places) == 3, "turned on the spot tells about the lever arm"


def test_no_place_without_both_streams() -> None:
    collector, hand = PlaceCollector(), Hand()
    for _ in range(100):
        t_ns, x, _ = hand.sample(hand.poses()[0])
        collector.add_point(t_ns, x, 2e-3)
    assert not collector.places
    assert collector.hint == "the tracking system does not see the device"


def with_cup(rig_folder: Path) -> RegistrationFile:
    toml = (rig_folder / "rig.toml").read_text() + '\n[objects.cup]\nsource = "steamvr"\nserial = "LHR-1"\n'
    (rig_folder / "rig.toml").write_text(toml)
    # What the objects service runs with, and what is undone: nothing like the truth, with a frame of the cup's own.
    old = RegistrationFile(
        T_rig_tracker=RigidTransform(position=(1.0, -2.0, 0.5), orientation=(0.5, 0.5, -0.5, 0.5)),
        T_tracker_object={"cup": RigidTransform(position=(0.0, 0.05, 0.1), orientation=(0.0, 0.6, 0.0, 0.8))},
    )
    write_json_model(rig_folder / "registration.json", old)
    return old


async def test_live_places_register_the_space(rig_folder: Path, router: BusConfig, endpoint: str) -> None:
    old = with_cup(rig_folder)
    service, hand = Registration.from_file(old), Hand()
    command = ["--live", "--object", "cup", "--marker", "index", "--places", "6", "--connect", endpoint]
    async with await Bus.open(router) as bus:
        points, poses = bus.publisher("rhot/points", PointSet), bus.publisher("rhot/object/cup", ObjectPose)

        async def move() -> None:
            route = hand.poses()
            places = [step for a, b in pairwise(route) for step in [*[a] * 45, *between(a, b)]]
            while not (await points.wait_for_reader(0.1) and await poses.wait_for_reader(0.1)):
                pass
            while True:
                for place in places:
                    t_ns, x, device = hand.sample(place)
                    cup = service.to_rig("cup", device)
                    px, py, pz = cup.position.tolist()
                    qx, qy, qz, qw = cup.orientation_xyzw.tolist()
                    u, v, w = x.tolist()
                    index = Point(position=(u, v, w), sigma=2e-3, views=2, state="measured")
                    held = Point(position=(0.0, 0.0, 0.0), sigma=1e-2, views=0, state="predicted")
                    points.put(PointSet(t_ns=t_ns, frame="rig", points={"index": index, "thumb": held}))
                    poses.put(
                        ObjectPose(
                            t_ns=t_ns,
                            frame="rig",
                            position=(px, py, pz),
                            orientation=(qx, qy, qz, qw),
                            state="measured",
                        )
                    )
                    await asyncio.sleep(0.001)

        moving = asyncio.create_task(move())
        try:
            async with asyncio.timeout(PATIENCE_S):
                done = await asyncio.to_thread(run, rig_folder, *command)
        finally:
            moving.cancel()
    assert done.exit_code == 0
    assert "place 6 of 6 taken" in done.output
    written = registration(rig_folder)
    off_mm, off_deg = off(written)
    assert off_mm < 3.0
    assert off_deg < 0.5
    assert written.T_tracker_object == old.T_tracker_object
    assert (written.quality["object"], written.quality["marker"]) == ("cup", "index")


async def test_silence_says_which_service_is_missing(
    rig_folder: Path, router: BusConfig, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_cup(rig_folder)
    monkeypatch.setattr("rhot_calibration.objects.command._PATIENCE_S", 0.3)
    with pytest.raises(BusError, match=r"rhot/points .* `rhot fusion`"):
        await asyncio.to_thread(
            run, rig_folder, "--live", "--object", "cup", "--marker", "index", "--connect", endpoint
        )


async def test_the_page_takes_places_and_can_end(rig_folder: Path, router: BusConfig) -> None:
    with_cup(rig_folder)
    step = ObjectStep(StepContext(rig_folder, router))
    values = {"object": "cup", "marker": "index"}
    started = asyncio.create_task(step.press("start", values))
    async with asyncio.timeout(PATIENCE_S):
        while not any("nothing on rhot/points yet" in remark.text for remark in step.view().remarks):
            await asyncio.sleep(0.02)
    assert step.view().enabled == {"solve"}
    await step.press("solve", values)
    with pytest.raises(CalibrationError, match="place"):
        await started
    assert "start" in step.view().enabled
    assert "try" not in step.view().enabled
