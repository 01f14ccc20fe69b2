from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Settings = dict[str, dict[str, list[str]]]

SERVICES = (
    "rhot-capture@",
    "rhot-feet",
    "rhot-router",
    "rhot-fusion",
    "rhot-ik",
    "rhot-objects",
    "rhot-bridge",
    "rhot-viewer",
    "rhot-grasp",
)
PC_SERVICES = (*SERVICES[1:], "rhot-start")
WITHOUT_DEVICES = (*SERVICES[2:], "rhot-start")
SAVING = {"rhot-capture@", "rhot-viewer", "rhot-grasp"}
HARDENING = {
    "User": "rhot",
    "NoNewPrivileges": "yes",
    "CapabilityBoundingSet": "",
    "ProtectSystem": "strict",
    "ProtectHome": "yes",
    "PrivateTmp": "yes",
    "ProtectKernelTunables": "yes",
    "ProtectKernelModules": "yes",
    "ProtectControlGroups": "yes",
    "RestrictAddressFamilies": "AF_INET AF_INET6 AF_UNIX AF_NETLINK",
    "RestrictRealtime": "yes",
    "RestrictNamespaces": "yes",
    "RestrictSUIDSGID": "yes",
    "LockPersonality": "yes",
    "SystemCallArchitectures": "native",
    "SystemCallFilter": "@system-service",
    "Type": "notify",
    "NotifyAccess": "main",
    "WatchdogSec": "10",
    "Restart": "always",
    "TimeoutStopSec": "5",
}
NEWER_THAN_252 = ("RestartSteps", "RestartMaxDelaySec", "RestartMode", "ProtectControlGroupsEx", "PrivatePIDs")

needs_systemd_analyze = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None,
    reason="systemd-analyze is not installed here (Debian: package systemd), so units are only parsed, not verified",
)


def parse(text: str) -> Settings:
    """Read a unit: sections of settings that may come several times; systemd has no configparser-like defaults."""
    sections: Settings = {}
    section = None
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith(("#", ";")):
            continue
        if header := re.fullmatch(r"\[(\w+)]", line):
            section = sections.setdefault(header[1], {})
            continue
        key, equals, value = line.partition("=")
        assert section is not None, f"line {number}: a setting before any section"
        assert equals, f"line {number}: neither setting nor section: {line}"
        assert not line.endswith("\\"), f"line {number}: continuation lines are not used here"
        section.setdefault(key.strip(), []).append(value.strip())
    return sections


def effective(folder: Path, name: str) -> Settings:
    """What systemd 252 makes of a unit with its drop-in: the last setting wins, lists are joined."""
    merged = parse((folder / f"{name}.service").read_text(encoding="utf-8"))
    drop_ins = [folder / "rhot-.service.d/hardening.conf", *(folder / f"{name}.service.d").glob("*.conf")]
    for file in sorted(drop_ins, key=lambda file: file.name):
        for section, settings in parse(file.read_text(encoding="utf-8")).items():
            for key, values in settings.items():
                merged.setdefault(section, {}).setdefault(key, []).extend(values)
    return merged


@pytest.fixture(scope="module")
def units(deploy: Path) -> Path:
    return deploy / "systemd"


@pytest.fixture
def verifiable(units: Path, tmp_path: Path) -> Path:
    """The units as they lie in /etc/systemd/system, but with a program that exists here and without what is newer."""
    folder = tmp_path / "units"
    shutil.copytree(units, folder)
    (folder / "rhot-.service.d/backoff.conf").unlink()
    program = tmp_path / "rhot"
    program.write_text(f"#!{sys.executable}\n", encoding="utf-8")
    program.chmod(0o755)
    for unit in folder.glob("**/*.service"):
        text = unit.read_text(encoding="utf-8")
        unit.write_text(text.replace("/opt/rhot/venv/bin/rhot", str(program)), encoding="utf-8")
    return folder


def analyze(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["systemd-analyze", "--no-pager", *arguments],
        # The colon keeps the system's own units in reach, network-online.target among them.
        env={"SYSTEMD_UNIT_PATH": f"{folder}:", "PATH": "/usr/bin:/bin", "SYSTEMD_LOG_LEVEL": "warning"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@needs_systemd_analyze
@pytest.mark.parametrize("unit", [*(f"{name}.service" for name in PC_SERVICES), "rhot-capture@left.service"])
def test_systemd_accepts_each_service(verifiable: Path, unit: str) -> None:
    result = analyze(verifiable, "verify", str(verifiable / unit))
    complaints = [line for line in (result.stdout + result.stderr).splitlines() if "rhot" in line]
    assert complaints == []
    assert result.returncode == 0, result.stderr


@needs_systemd_analyze
def test_systemd_accepts_the_target_and_the_users_unit(verifiable: Path) -> None:
    for arguments in (["rhot.target"], ["--user", "user/rhot-objects.service"]):
        *options, unit = arguments
        result = analyze(verifiable, "verify", *options, str(verifiable / unit))
        assert [line for line in (result.stdout + result.stderr).splitlines() if "rhot" in line] == []


@needs_systemd_analyze
def test_verifying_would_notice_a_fault(verifiable: Path) -> None:
    unit = verifiable / "rhot-ik.service"
    unit.write_text(unit.read_text(encoding="utf-8").replace("PrivateDevices=", "PrivateDevises="), encoding="utf-8")
    result = analyze(verifiable, "verify", str(unit))
    assert "PrivateDevises" in result.stderr


@needs_systemd_analyze
@pytest.mark.parametrize("unit", [*(f"{name}.service" for name in PC_SERVICES), "rhot-capture@left.service"])
def test_systemd_finds_little_exposure(verifiable: Path, unit: str) -> None:
    # Out of 10.0; up to 4.9 counts as OK. The drop-in of the common prefix is found for the template, too.
    result = analyze(verifiable, "security", "--offline=true", "--threshold=20", str(verifiable / unit))
    assert result.returncode == 0, result.stdout + result.stderr
    exposure = re.search(r"Overall exposure level for \S+: ([\d.]+)", result.stdout)
    assert exposure is not None, result.stdout
    assert float(exposure[1]) <= 3.0


@pytest.mark.parametrize("name", SERVICES)
def test_each_service_is_hardened_and_comes_back(units: Path, name: str) -> None:
    settings = effective(units, name)
    assert {key: settings["Service"].get(key, ["(missing)"])[-1] for key in HARDENING} == HARDENING
    assert settings["Unit"]["StartLimitIntervalSec"] == ["0"], "systemd would give up after five restarts"
    assert settings["Install"]["WantedBy"] == ["rhot.target"]
    assert settings["Unit"]["PartOf"] == ["rhot.target"], "stopping the target stops the services"


@pytest.mark.parametrize("name", SERVICES)
def test_each_service_waits_for_network_and_time(units: Path, name: str) -> None:
    unit = effective(units, name)["Unit"]
    after = unit["After"][-1].split()
    assert {"network-online.target", "time-sync.target"} <= set(after)
    # Without being wanted by somebody that target never becomes active.
    assert "network-online.target" in unit["Wants"][-1].split()


def test_services_come_after_the_router_of_their_machine_but_live_without_it(units: Path) -> None:
    for name in (name for name in PC_SERVICES if name != "rhot-router"):
        unit = effective(units, name)["Unit"]
        assert "rhot-router.service" in unit["After"][-1].split()
        # Requires= or BindsTo= would take all services down whenever the router restarts.
        assert not {"Requires", "BindsTo", "Requisite"} & set(unit)


def test_what_tracks_goes_before_pages_and_bridges(units: Path) -> None:
    nice = {name: int(effective(units, name)["Service"].get("Nice", ["0"])[-1]) for name in SERVICES}
    showing = {"rhot-bridge", "rhot-viewer", "rhot-grasp"}
    assert {nice[name] for name in SERVICES if name not in showing} == {-5}
    assert {nice[name] for name in showing} == {0}


def test_only_those_that_save_may_write_and_only_their_own_state(units: Path) -> None:
    for name in (*SERVICES, "rhot-start"):
        service = effective(units, name)["Service"]
        assert service.get("StateDirectory") == (["rhot"] if name in SAVING else None), name
        assert "ReadWritePaths" not in service
        for line in service["ExecStart"] + service.get("ExecCondition", []):
            assert "/var/lib/rhot/rig" in line, "the rig is in the state directory"


def test_the_session_starts_once_and_by_itself(units: Path) -> None:
    settings = effective(units, "rhot-start")
    service = {key: values[-1] for key, values in settings["Service"].items()}
    assert (service["Type"], service["RemainAfterExit"], service["WatchdogSec"]) == ("oneshot", "yes", "0")
    assert service["Restart"] == "on-failure", "a rig that does not come up within an hour is waited for again"
    assert {key: service[key] for key in ("User", "ProtectSystem", "NoNewPrivileges")} == {
        "User": "rhot",
        "ProtectSystem": "strict",
        "NoNewPrivileges": "yes",
    }
    assert settings["Unit"]["PartOf"] == ["rhot.target"]
    assert settings["Install"]["WantedBy"] == ["rhot.target"]


def test_feet_see_their_sensors_and_cameras_only(units: Path) -> None:
    feet = effective(units, "rhot-feet")["Service"]
    assert feet["DevicePolicy"] == ["closed"]
    assert feet["SupplementaryGroups"] == ["dialout plugdev video"]
    allowed = {value.split()[0] for value in feet["DeviceAllow"]}
    assert allowed == {"char-ttyUSB", "char-ttyACM", "char-usb_device", "char-video4linux", "char-media"}


def test_a_rig_without_a_time_server_starts_all_the_same(units: Path) -> None:
    wait = parse((units / "systemd-time-wait-sync.service.d/rhot.conf").read_text(encoding="utf-8"))
    assert wait == {"Service": {"TimeoutStartSec": ["90"]}}


def test_only_capture_sees_cameras(units: Path) -> None:
    capture = effective(units, "rhot-capture@")["Service"]
    assert "PrivateDevices" not in capture
    assert capture["DevicePolicy"] == ["closed"]
    assert capture["SupplementaryGroups"] == ["video"]
    allowed = {value.split()[0] for value in capture["DeviceAllow"]}
    assert {"char-video4linux", "char-media", "char-dma_heap", "/dev/vchiq"} <= allowed
    for name in WITHOUT_DEVICES:
        service = effective(units, name)["Service"]
        assert service["PrivateDevices"] == ["yes"]
        assert service["MemoryDenyWriteExecute"] == ["yes"]
        assert "DeviceAllow" not in service


def test_a_unit_sets_nothing_that_the_common_settings_would_undo(units: Path) -> None:
    # Drop-ins are read after the unit, so a deviation in a unit would be ignored without a word.
    common = parse((units / "rhot-.service.d/hardening.conf").read_text(encoding="utf-8"))["Service"]
    for name in (*SERVICES, "rhot-start"):
        own = parse((units / f"{name}.service").read_text(encoding="utf-8"))["Service"]
        # Variables add up.
        assert set(own) & set(common) <= {"Environment"}
        variables = [value.partition("=")[0] for values in (own, common) for value in values.get("Environment", [])]
        assert len(set(variables)) == len(variables)


def test_nothing_is_newer_than_the_systemd_of_bookworm(units: Path) -> None:
    for file in units.glob("**/*"):
        if file.is_file() and file.name != "backoff.conf":
            settings = parse(file.read_text(encoding="utf-8"))
            assert not [key for section in settings.values() for key in section if key in NEWER_THAN_252], file


def test_each_unit_runs_a_command_that_exists(units: Path, resolve_command: Callable[[list[str]], str]) -> None:
    found = {}
    for file in units.glob("**/*.service"):
        (line,) = parse(file.read_text(encoding="utf-8"))["Service"]["ExecStart"]
        program, *words = shlex.split(line.replace("%i", "left"))
        assert program == "/opt/rhot/venv/bin/rhot"
        assert words[-2:] == ["--rig", "/var/lib/rhot/rig"]
        found[file.stem] = resolve_command(words)
    assert found == {
        "rhot-capture@": "capture",
        "rhot-router": "router",
        "rhot-fusion": "fusion",
        "rhot-ik": "ik",
        "rhot-objects": "objects",
        "rhot-feet": "feet",
        "rhot-viewer": "viewer",
        "rhot-grasp": "viewer",
        "rhot-bridge": "bridge",
        "rhot-start": "start",
    }


def test_the_users_unit_asks_for_nothing_that_only_root_can_give(units: Path) -> None:
    service = parse((units / "user/rhot-objects.service").read_text(encoding="utf-8"))["Service"]
    assert not {"User", "Group", "CapabilityBoundingSet", "DeviceAllow"} & set(service)
    assert (service["Type"], service["Restart"], service["WatchdogSec"]) == (["notify"], ["always"], ["10"])


@pytest.mark.parametrize(
    ("rig", "needed"),
    [
        ("[feet.camera]\nsource = 'realsense'\n", True),
        ("[feet]\n", True),
        ("feet.left.marker_id = 0\n", True),
        ("# [feet.camera]\n", False),
        ("[cameras.feet]\n", False),
    ],
)
def test_feet_run_only_where_the_rig_has_some(units: Path, tmp_path: Path, rig: str, needed: bool) -> None:
    is_run_where_needed(units / "rhot-feet.service", tmp_path, rig, needed)


@pytest.mark.parametrize(
    ("rig", "needed"),
    [
        ("[objects.cup]\nserial = 'LHR-1'\n", True),
        ("  [objects.cup]\n", True),
        ("[objects]\ncup = {serial = 'LHR-1'}\n", True),
        ("objects.cup.serial = 'LHR-1'\n", True),
        ("# [objects.cup]\n#   serial\n[hand]\n", False),
        ("[cameras.objects]\n", False),
        ("", False),
    ],
)
def test_objects_run_only_where_the_rig_has_some(units: Path, tmp_path: Path, rig: str, needed: bool) -> None:
    is_run_where_needed(units / "rhot-objects.service", tmp_path, rig, needed)


@pytest.mark.parametrize(
    ("rig", "needed"),
    [
        ("[bridges.avatar]\ntarget = 'vmc'\n", True),
        ("bridges.avatar.target = 'vmc'\n", True),
        ("# [bridges.avatar]\n", False),
        ("[objects.bridges]\n", False),
    ],
)
def test_bridges_run_only_where_the_rig_has_some(units: Path, tmp_path: Path, rig: str, needed: bool) -> None:
    is_run_where_needed(units / "rhot-bridge.service", tmp_path, rig, needed)


def is_run_where_needed(unit: Path, tmp_path: Path, rig: str, needed: bool) -> None:
    (line,) = parse(unit.read_text(encoding="utf-8"))["Service"]["ExecCondition"]
    *words, file = shlex.split(line)
    assert file == "/var/lib/rhot/rig/rig.toml"
    assert "\\" not in line, "systemd and the shell disagree about backslashes"
    assert "%" not in line
    (tmp_path / "rig.toml").write_text(rig, encoding="utf-8")
    words[0] = shutil.which("grep") or words[0]
    assert (subprocess.run([*words, str(tmp_path / "rig.toml")], check=False).returncode == 0) is needed
