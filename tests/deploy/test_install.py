from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

STUB = """#!/bin/sh
echo "$(basename "$0") $*" >> "$CALLS"
"""
PYTHON_STUB = """#!/bin/sh
echo "$(basename "$0") $*" >> "$CALLS"
case "$*" in
"-m venv"*)
    for folder in "$@"; do :; done
    mkdir -p "$folder/bin"
    cp "$0" "$folder/bin/python"
    printf '#!/bin/sh\\necho "rhot $*" >> "$CALLS"\\n[ "$1" = init ] && mkdir -p "$2" && echo fresh > "$2/rig.toml"\\n' > "$folder/bin/rhot"
    chmod +x "$folder/bin/rhot" ;;
esac
"""  # noqa: E501  # a line of the script


NO_CHRONY = f"""{STUB}case "$*" in
--version) echo "systemd 252 (252.1)" ;;
"cat chrony"*) exit 1 ;;
esac
exit 0
"""


class Machine:
    """A make-believe machine: files below a folder, and commands that only write down how they were called."""

    def __init__(self, folder: Path, script: Path) -> None:
        self.root = folder / "root"
        self.calls_file = folder / "calls"
        self._script = script
        self._bin = folder / "bin"
        self._bin.mkdir()
        (self.root / "etc").mkdir(parents=True)
        (self.root / "etc/os-release").write_text('ID=raspbian\nID_LIKE="debian"\n', encoding="utf-8")
        for name in ("apt-get", "useradd", "userdel", "chown"):
            self.command(name, STUB)
        self.command("python3", PYTHON_STUB)
        self.command("uname", "#!/bin/sh\necho aarch64\n")
        self.systemd(252)
        self.command("dpkg-query", "#!/bin/sh\nexit 1\n")
        self.user(exists=False)

    def command(self, name: str, text: str) -> None:
        path = self._bin / name
        path.write_text(text, encoding="utf-8")
        path.chmod(0o755)

    def systemd(self, version: int) -> None:
        self.command(
            "systemctl", f'{STUB}[ "$1" = --version ] && echo "systemd {version} ({version}.1-1~deb12u1)"\nexit 0\n'
        )

    def user(self, *, exists: bool, root: bool = True) -> None:
        known = 0 if exists else 1
        self.command("id", f'#!/bin/sh\n[ "$1" = -u ] && echo {0 if root else 1000} && exit 0\nexit {known}\n')

    def install(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        self.calls_file.write_text("", encoding="utf-8")
        return subprocess.run(
            ["bash", str(self._script), *arguments],
            env={
                "PATH": f"{self._bin}:{os.environ['PATH']}",
                "RHOT_INSTALL_ROOT": str(self.root),
                "CALLS": str(self.calls_file),
                "LC_ALL": "C",
            },
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    @property
    def calls(self) -> list[str]:
        return self.calls_file.read_text(encoding="utf-8").replace(str(self.root), "").splitlines()

    def files(self) -> dict[str, bytes]:
        return {str(path.relative_to(self.root)): path.read_bytes() for path in self.root.rglob("*") if path.is_file()}


@pytest.fixture
def script(deploy: Path) -> Path:
    return deploy / "install.sh"


@pytest.fixture
def machine(tmp_path: Path, script: Path) -> Machine:
    return Machine(tmp_path, script)


CAPTURE = ("capture", "--camera", "left", "--connect", "tcp/10.0.0.1:7447")


def test_it_is_a_script_that_bash_can_read(script: Path) -> None:
    assert os.access(script, os.X_OK)
    assert script.read_text(encoding="utf-8").startswith("#!/usr/bin/env bash\n")
    assert "set -euo pipefail" in script.read_text(encoding="utf-8")
    assert subprocess.run(["bash", "-n", str(script)], capture_output=True, check=False).returncode == 0


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is not installed here")
def test_shellcheck_has_nothing_to_say(script: Path) -> None:
    result = subprocess.run(["shellcheck", str(script)], capture_output=True, text=True, check=False)
    assert result.stdout == ""


@pytest.mark.parametrize("arguments", [CAPTURE, ("pc",), ("--uninstall", "--purge")])
def test_a_dry_run_does_nothing_and_plans_the_same_twice(machine: Machine, arguments: tuple[str, ...]) -> None:
    machine.user(exists=False, root=False)
    before = machine.files()
    first, second = machine.install(*arguments, "--dry-run"), machine.install(*arguments, "--dry-run")
    assert first.returncode == 0, first.stderr
    assert first.stdout == second.stdout
    assert machine.files() == before
    assert not [
        call for call in machine.calls if not call.startswith(("python3 -c", "systemctl --version", "systemctl cat"))
    ]


def test_the_dry_run_tells_what_the_real_run_does(machine: Machine) -> None:
    plan = machine.install(*CAPTURE, "--dry-run").stdout.replace(str(machine.root), "").replace("\\", "")
    planned = [line.removeprefix("+ ").removeprefix("/opt/rhot/venv/bin/") for line in plan.splitlines()]
    machine.install(*CAPTURE)
    looks = ("python3 -c", "systemctl --version", "systemctl cat")
    commands = [call for call in machine.calls if not call.startswith(looks)]
    assert len(commands) > 10
    assert [call for call in commands if call not in planned] == []


def test_installing_a_camera_twice_leaves_the_same_files(machine: Machine) -> None:
    first = machine.install(*CAPTURE)
    assert first.returncode == 0, first.stderr
    files = machine.files()
    units = "etc/systemd/system"
    assert {
        f"{units}/rhot.target",
        f"{units}/rhot-capture@.service",
        f"{units}/rhot-.service.d/hardening.conf",
        "var/lib/rhot/rig/rig.toml",
        f"{units}/rhot-start.service.d/oneshot.conf",
        f"{units}/systemd-time-wait-sync.service.d/rhot.conf",
        "etc/default/rhot",
        "opt/rhot/share/deploy.md",
    } <= set(files)
    assert f"{units}/rhot-fusion.service" not in files
    assert b"\nRHOT_CONNECT=tcp/10.0.0.1:7447\n" in files["etc/default/rhot"]
    assert "systemctl enable --quiet rhot.target rhot-capture@left.service" in machine.calls
    machine.user(exists=True)
    second = machine.install(*CAPTURE)
    assert second.returncode == 0, second.stderr
    assert machine.files() == files
    assert not [call for call in machine.calls if call.startswith(("useradd", "rhot init"))]
    assert [call for call in machine.calls if "pip install" in call], "running again is how it is updated"


def test_a_rig_and_settings_that_are_there_stay(machine: Machine) -> None:
    rig = machine.root / "var/lib/rhot/rig"
    rig.mkdir(parents=True)
    (rig / "rig.toml").write_text("mine", encoding="utf-8")
    (machine.root / "etc/default").mkdir()
    (machine.root / "etc/default/rhot").write_text("RHOT_CONNECT=tcp/10.9.9.9:7447\n", encoding="utf-8")
    result = machine.install(*CAPTURE)
    assert result.returncode == 0, result.stderr
    assert machine.files()["var/lib/rhot/rig/rig.toml"] == b"mine"
    assert machine.files()["etc/default/rhot"] == b"RHOT_CONNECT=tcp/10.9.9.9:7447\n"
    assert "does not say RHOT_CONNECT=tcp/10.0.0.1:7447" in result.stderr


def test_a_rig_of_a_former_installation_comes_along(machine: Machine) -> None:
    """It lay in a folder of root's, where the services could not save."""
    (machine.root / "etc/rhot").mkdir()
    (machine.root / "etc/rhot/rig.toml").write_text("mine", encoding="utf-8")
    (machine.root / "etc/rhot/colors.json").write_text("{}", encoding="utf-8")
    result = machine.install("pc")
    assert "copied the rig from" in result.stdout
    files = machine.files()
    assert files["var/lib/rhot/rig/rig.toml"] == files["etc/rhot/rig.toml"] == b"mine"
    assert "var/lib/rhot/rig/colors.json" in files
    (machine.root / "etc/rhot/rig.toml").write_text("changed since", encoding="utf-8")
    machine.install("pc")
    assert machine.files()["var/lib/rhot/rig/rig.toml"] == b"mine"


def test_the_rig_belongs_to_the_services(machine: Machine) -> None:
    machine.install(*CAPTURE)
    assert "chown -R rhot:rhot /var/lib/rhot" in machine.calls


def test_something_waits_for_the_clock(machine: Machine) -> None:
    machine.install("pc")
    assert "systemctl enable --quiet chrony-wait.service" in machine.calls
    machine.command("systemctl", NO_CHRONY)
    machine.install("pc")
    assert "systemctl enable --quiet systemd-time-wait-sync.service" in machine.calls


def test_the_pi_gets_picamera2_and_the_program_for_it(machine: Machine) -> None:
    machine.install(*CAPTURE)
    calls = machine.calls
    assert "apt-get install --yes --no-install-recommends python3-venv python3-picamera2" in calls
    assert "python3 -m venv --system-site-packages /opt/rhot/venv" in calls
    pip = [call for call in calls if "pip install" in call]
    assert pip[0].endswith("[capture]")
    assert "simplejpeg>=1.8.1" in pip[1], "the system's simplejpeg breaks picamera2 beside numpy 2"
    assert "python -c import picamera2" in calls


def test_a_machine_with_usb_cameras_needs_no_picamera2(machine: Machine) -> None:
    machine.install(*CAPTURE, "--without-picamera2")
    assert not [call for call in machine.calls if "picamera2" in call or "simplejpeg" in call]


def test_the_pc_gets_all_its_services(machine: Machine) -> None:
    result = machine.install("pc")
    assert result.returncode == 0, result.stderr
    enabled = next(call for call in machine.calls if call.startswith("systemctl enable --quiet rhot.target"))
    for name in ("router", "fusion", "ik", "objects", "feet", "viewer", "start"):
        assert f"rhot-{name}.service" in enabled
        assert f"etc/systemd/system/rhot-{name}.service" in machine.files()
    assert "capture" not in enabled


@pytest.mark.parametrize(("version", "expected"), [(252, False), (253, False), (254, True), (257, True)])
def test_back_off_is_installed_where_systemd_knows_it(machine: Machine, version: int, expected: bool) -> None:
    machine.systemd(version)
    machine.install("pc")
    assert ("etc/systemd/system/rhot-.service.d/backoff.conf" in machine.files()) is expected


def test_a_camera_installed_earlier_under_another_name_is_reported(machine: Machine) -> None:
    wants = machine.root / "etc/systemd/system/rhot.target.wants"
    wants.mkdir(parents=True)
    for name in ("left", "leftmost"):
        (wants / f"rhot-capture@{name}.service").symlink_to("../rhot-capture@.service")
    result = machine.install(*CAPTURE)
    assert result.returncode == 0, result.stderr
    assert "sudo systemctl disable --now rhot-capture@leftmost.service\n" in result.stderr
    assert "rhot-capture@left.service" not in result.stderr
    assert "earlier" not in machine.install("pc").stderr


def test_uninstalling_keeps_the_rig_and_can_be_repeated(machine: Machine) -> None:
    machine.install(*CAPTURE)
    machine.user(exists=True)
    wants = machine.root / "etc/systemd/system/rhot.target.wants"
    wants.mkdir()
    (wants / "rhot-capture@left.service").symlink_to("../rhot-capture@.service")
    result = machine.install("--uninstall")
    assert result.returncode == 0, result.stderr
    assert "systemctl disable --quiet --now rhot.target rhot-capture@left.service" in machine.calls
    assert "userdel rhot" in machine.calls
    assert set(machine.files()) == {"etc/os-release", "var/lib/rhot/rig/rig.toml", "etc/default/rhot"}
    machine.user(exists=False)
    assert machine.install("--uninstall").returncode == 0
    assert machine.install("--uninstall", "--purge").returncode == 0
    assert set(machine.files()) == {"etc/os-release"}


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((), "say what this machine is"),
        (("capture",), "needs at least one --camera"),
        (("capture", "--camera"), "--camera needs the name"),
        (("capture", "--camera", "a b"), "got 'a b'"),
        (("capture", "--camera", "../x"), "got '../x'"),
        (("pc", "--camera", "left"), "--camera goes with the role capture"),
        (("pc", "capture"), "one role at a time"),
        (("pc", "--connect", "10.0.0.1"), "--connect needs an endpoint"),
        (("pc", "--purge"), "--purge goes with --uninstall"),
        (("pc", "--uninstall"), "removes every role"),
        (("pc", "--frobnicate"), "unknown argument '--frobnicate'"),
    ],
)
def test_wrong_arguments_are_named(machine: Machine, arguments: tuple[str, ...], complaint: str) -> None:
    result = machine.install(*arguments)
    assert result.returncode == 1
    assert complaint in result.stderr
    assert result.stderr.count("\n") == 1
    assert machine.calls == []


def test_what_is_missing_on_the_machine_is_named(machine: Machine) -> None:
    machine.user(exists=False, root=False)
    assert "needs root; run it with sudo" in machine.install("pc").stderr
    machine.user(exists=False)
    machine.command("uname", "#!/bin/sh\necho armv7l\n")
    assert "needs a 64-bit system, this is armv7l" in machine.install("pc").stderr
    machine.command("uname", "#!/bin/sh\necho x86_64\n")
    machine.command("python3", '#!/bin/sh\n[ "$1" = --version ] && echo Python 3.9.2\nexit 1\n')
    assert "needs Python 3.11 or newer, Python 3.9.2 is installed" in machine.install("pc").stderr
    (machine.root / "etc/os-release").write_text("ID=fedora\n", encoding="utf-8")
    assert "only Debian and its relatives" in machine.install("pc").stderr
    assert set(machine.files()) == {"etc/os-release"}


def test_when_picamera2_does_not_load_nothing_is_started(machine: Machine) -> None:
    broken = PYTHON_STUB.replace('case "$*" in', '[ "$*" = "-c import picamera2" ] && exit 1\ncase "$*" in')
    machine.command("python3", broken)
    result = machine.install(*CAPTURE)
    assert result.returncode == 1
    assert "picamera2 does not load" in result.stderr
    assert not [call for call in machine.calls if call.startswith("systemctl enable")]
