from __future__ import annotations

import asyncio
import datetime as dt
from pathlib import Path

import pytest
import things
from bus_watch import until_known

from rhot.bus import Bus
from rhot.messages import ServiceStatus
from rhot.rig import BusConfig, CamerasFile, HandFile, RegistrationFile, Rig, RigidTransform, load_rig, write_json_model
from rhot.rig.colors import nominal_colors
from rhot.rig.template import rig_template
from rhot_sim.walker.folder import write_walker_rig
from rhot_tools.operate.doctor import check_rig, check_running
from rhot_tools.operate.findings import Finding


def calibrate(rig_folder: Path, quality: object) -> Rig:
    cameras = load_rig(rig_folder).cameras
    date = (dt.datetime.now(dt.UTC).date() - dt.timedelta(days=40)).isoformat()
    write_json_model(rig_folder / "cameras.json", CamerasFile(date=date, quality=quality, cameras=cameras))
    return load_rig(rig_folder)


def about(findings: list[Finding], word: str) -> Finding:
    (found,) = [finding for finding in findings if word in finding.text]
    return found


def test_missing_calibrations_name_the_exact_command(rig_folder: Path) -> None:
    toml = (rig_folder / "rig.toml").read_text() + '\n[objects.cup]\nsource = "steamvr"\nserial = "LHR-1"\n'
    (rig_folder / "rig.toml").write_text(toml)
    _, findings = check_rig(rig_folder)
    for file, remedy in (
        ("cameras.json", f"rhot calibrate cameras RECORDING --rig {rig_folder} --board 9x6 --square-mm 25"),
        ("hand.json", f"rhot calibrate hand RECORDING --rig {rig_folder}"),
        ("registration.steamvr.json", f"rhot calibrate objects --live --object cup --marker NAME --rig {rig_folder}"),
    ):
        assert remedy in about(findings, file).remedy


def test_colours_that_cannot_be_used_or_lack_a_marker_are_told(rig_folder: Path) -> None:
    file = rig_folder / "colors.json"
    file.write_text('{"markers": {"thumb": {"kind": "paint"}}}')
    found = about(check_rig(rig_folder)[1], "colors.json")
    assert (found.level, "rhot calibrate colors" in found.remedy) == ("bad", True)
    paints = dict.fromkeys(("thumb", "index", "middle", "ring", "little"), (200, 30, 30))
    write_json_model(file, nominal_colors(paints))
    found = about(check_rig(rig_folder)[1], "colors.json")
    assert (found.level, "no colour for base" in found.text) == ("warn", True)
    write_json_model(file, nominal_colors(paints | {"base": (30, 30, 200)}))
    assert about(check_rig(rig_folder)[1], "colors.json").level == "ok"


def test_a_patch_that_is_nearly_square_is_told(rig_folder: Path) -> None:
    assert not any("square" in finding.text for finding in check_rig(rig_folder)[1])
    toml = rig_folder / "rig.toml"
    toml.write_text(toml.read_text().replace("size_m = [0.04, 0.03]", "size_m = [0.032, 0.03]"))
    found = about(check_rig(rig_folder)[1], "nearly square")
    assert (found.level, "32 x 30 mm" in found.text) == ("warn", True)


def test_a_rig_of_feet_alone_is_not_asked_for_what_hands_need(tmp_path: Path) -> None:
    write_walker_rig(tmp_path / "rig")
    _, findings = check_rig(tmp_path / "rig")
    assert "feet left, right (depth camera: simulated)" in about(findings, "rig.toml").text
    assert [finding for finding in findings if finding.level != "ok"] == []


async def test_a_running_rig_of_feet_alone_needs_no_fusion(tmp_path: Path, router: BusConfig) -> None:
    rig = write_walker_rig(tmp_path / "rig")
    async with await Bus.open(router) as bus:
        status = ServiceStatus(t_ns=1, service="ik", instance="main", state="running", clock_uncertainty_s=1e-4)
        bus.publisher("rhot/status/ik/main", ServiceStatus).put(status)
        bus.alive("rhot/alive/ik/main")
        await until_known(router, "ik/main")
        findings = await check_running(router, rig)
    assert [finding.text for finding in findings if finding.level == "bad"] == ["feet/main is not running"]


async def test_a_camera_is_at_fault_after_seconds_without_pictures_not_after_one(
    rig_folder: Path, router: BusConfig
) -> None:
    """A busy machine may leave a second without a picture."""
    rig = load_rig(rig_folder)
    async with await Bus.open(router) as bus:
        publisher = bus.publisher("rhot/status/capture/left", ServiceStatus)

        def publish(rate_hz: float) -> None:
            rates = {"frames": rate_hz}
            publisher.put(ServiceStatus(t_ns=1, service="capture", instance="left", state="running", rates=rates))

        publish(0.0)
        bus.alive("rhot/alive/capture/left")
        await until_known(router, "capture/left")
        asyncio.get_running_loop().call_later(1.0, publish, 15.0)
        findings = await check_running(router, rig)
        assert not [finding for finding in findings if "gets no pictures" in finding.text]
        publish(0.0)
        finding = about(await check_running(router, rig), "gets no pictures")
    assert (finding.level, "capture/left" in finding.text) == ("bad", True)


def test_the_size_of_a_mesh_is_shown_and_a_bad_file_is_bad(rig_folder: Path) -> None:
    with (rig_folder / "rig.toml").open("a") as file:
        file.write('\n[objects.cup]\nserial = "LHR-1"\nshape = { kind = "mesh", file = "cup.glb" }\n')
    _, findings = check_rig(rig_folder)
    assert about(findings, "object cup").level == about(findings, "cannot be read").level == "bad"
    things.save(things.mug(), rig_folder / "cup.glb")
    _, findings = check_rig(rig_folder)
    assert "cup.glb, 80 x 95 x 115 mm" in about(findings, "object cup").text


def test_calibrations_are_shown_with_date_age_and_figures(rig_folder: Path) -> None:
    quality = {
        "rms_px": 0.21,
        "cameras": {"left": {"rms_px": 0.2}, "right": {"rms_px": "?"}},
        "pairs": {"left-right": {"epipolar_p95_px": 0.34}},
        "expected_error_mm": {"75 cm": {"with_marker_noise": 2.34}},
    }
    calibrate(rig_folder, quality)
    write_json_model(rig_folder / "hand.json", HandFile(date="2026-01-01", quality={"bones_sd_mm": 1.5}))
    registration = RegistrationFile(
        T_rig_tracker=RigidTransform.identity(), quality={"residual_rms_mm": 1.234, "covariance": [[1.0]], "places": 10}
    )
    write_json_model(rig_folder / "registration.json", registration)
    _, findings = check_rig(rig_folder)
    cameras = about(findings, "cameras.json")
    assert (
        "40 days old, rms 0.21 px; left RMS 0.20 px; left-right epipolar p95 0.34 px; 2.3 mm expected at 75 cm"
        in cameras.text
    )
    assert "rhot evaluate calibration" in cameras.remedy
    assert "of 2026-01-01" in about(findings, "hand.json").text
    assert "bones sd 1.5 mm" in about(findings, "hand.json").text
    assert about(findings, "registration.json").text == "registration.json: of unknown date, residual rms 1.23 mm"


@pytest.mark.parametrize(
    ("correction_px", "quality", "level", "says"),
    [
        (0.4, {}, "ok", "stand as calibrated, to 0.4 px"),
        (1.7, {}, "warn", "have moved since calibration (1.7 px, 1.0 px is the limit)"),
        (1.7, {"pairs": {"right-left": {"epipolar_p95_px": 0.7}}}, "ok", "stand as calibrated"),
        (2.2, {"pairs": {"right-left": {"epipolar_p95_px": 0.7}}}, "warn", "2.1 px is the limit"),
    ],
)
async def test_a_running_rig_whose_cameras_have_moved_is_told(
    rig_folder: Path, router: BusConfig, correction_px: float, quality: object, level: str, says: str
) -> None:
    rig = calibrate(rig_folder, quality)
    async with await Bus.open(router) as bus:
        status = ServiceStatus(
            t_ns=1,
            service="fusion",
            instance="main",
            state="running",
            figures={"epipolar_correction_px": correction_px, "epipolar_px": 0.3},
            clock_uncertainty_s=0.0,
        )
        bus.publisher("rhot/status/fusion/main", ServiceStatus).put(status)
        bus.alive("rhot/alive/fusion/main")
        await until_known(router, "fusion/main")
        finding = about(await check_running(router, rig), "fusion/main: the cameras")
    assert finding.level == level
    assert says in finding.text
    assert level == "ok" or f"rhot calibrate cameras RECORDING --rig {rig_folder}" in finding.remedy


async def test_an_uncalibrated_rig_has_nothing_to_have_moved_from(rig_folder: Path, router: BusConfig) -> None:
    async with await Bus.open(router) as bus:
        figures = {"epipolar_correction_px": 9.0, "epipolar_px": 0.3}
        status = ServiceStatus(t_ns=1, service="fusion", instance="main", state="running", figures=figures)
        bus.publisher("rhot/status/fusion/main", ServiceStatus).put(status)
        bus.alive("rhot/alive/fusion/main")
        await until_known(router, "fusion/main")
        findings = await check_running(router, load_rig(rig_folder))
    assert not [finding for finding in findings if "moved" in finding.text]


async def test_before_anything_was_seen_nothing_is_said(rig_folder: Path, router: BusConfig) -> None:
    rig = calibrate(rig_folder, {})
    async with await Bus.open(router) as bus:
        figures = {"epipolar_correction_px": 0.0, "epipolar_px": 0.0}
        status = ServiceStatus(t_ns=1, service="fusion", instance="main", state="running", figures=figures)
        bus.publisher("rhot/status/fusion/main", ServiceStatus).put(status)
        bus.alive("rhot/alive/fusion/main")
        await until_known(router, "fusion/main")
        findings = await check_running(router, rig)
    assert not [finding for finding in findings if "stand as calibrated" in finding.text]


def test_one_camera_gives_no_depth(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(rig_template(folder="rig", name="test", cameras=["left"], camera_xs_m=[0.0]))
    found = about(check_rig(tmp_path)[1], "the rig has one camera, left")
    assert (found.level, "[cameras.NAME]" in found.remedy) == ("bad", True)


def test_the_same_device_twice_is_one_camera(tmp_path: Path) -> None:
    toml = rig_template(folder="rig", name="test", source="v4l2").splitlines()
    lines = ['device = "/dev/video0"' if line.split("=")[0].strip(" #") == "device" else line for line in toml]
    (tmp_path / "rig.toml").write_text("\n".join(lines))
    assert [camera.device for camera in load_rig(tmp_path).config.cameras.values()] == ["/dev/video0"] * 2
    found = about(check_rig(tmp_path)[1], "have the same device")
    assert (found.level, "/dev/v4l/by-id" in found.remedy) == ("warn", True)


def test_paints_that_are_taken_for_each_other_are_told(rig_folder: Path) -> None:
    quality = {"thumb": {"confusion": 0.11, "nearest": "ring"}, "ring": {"confusion": 0.02, "nearest": "thumb"}}
    colors = nominal_colors({name: (10 * i, 30, 200) for i, name in enumerate(load_rig(rig_folder).config.markers)})
    write_json_model(rig_folder / "colors.json", colors.model_copy(update={"quality": quality}))
    found = about(check_rig(rig_folder)[1], "11 % of thumb would be taken for ring")
    assert (found.level, "another colour" in found.remedy) == ("warn", True)
