"""`install.sh` in a fresh Debian with systemd as its first process: the services run, as their user, with their rights.

Only pip is stood in for, as these tests use no network: what it would fetch is seen read-only from the tests' own
environment, and Debian's Python runs it.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from machine.debian_root import DebianRoot, RootRefusedError, booted_root

pytestmark = [pytest.mark.faults]

_PATIENCE_S = 120.0
UNITS = Path(__file__).parents[2] / "deploy" / "systemd"
PACKAGES = "/opt/rhot-test-packages"
SOURCE = "/usr/src/rhot"
SPACED = "/usr/src/RHOT of mine"
RHOT = "/opt/rhot/venv/bin/rhot"
RIG = "/var/lib/rhot/rig"
RUNNING = ("router", "fusion", "ik", "objects", "viewer")
PIP = f'''
import pathlib, sys, sysconfig
if sys.argv[1:2] != ["install"]:
    sys.exit(f"not expected of this pip: {{sys.argv}}")
source = pathlib.Path("{SOURCE}")
services = sorted(str(path) for path in (source / "services").iterdir() if path.is_dir())
parts = "common", "calibration", "simulation", "tools", "bench"
paths = [*(str(source / name) for name in parts), *services, "{PACKAGES}"]
(pathlib.Path(sysconfig.get_path("purelib")) / "rhot.pth").write_text("\\n".join(paths) + "\\n")
script = pathlib.Path(sys.prefix) / "bin" / "rhot"
script.write_text(f"#!{{sys.prefix}}/bin/python\\nimport sys\\nfrom rhot.cli import main\\nsys.exit(main())\\n")
script.chmod(0o755)
'''


def eventually(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + _PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {_PATIENCE_S:.0f} s: {what}"
        time.sleep(0.2)


@pytest.fixture(scope="module")
def root(repository: Path) -> Iterator[DebianRoot]:
    """A booted Debian without RHOT."""
    debian = Path("/usr/bin/python3")
    version = "import sys; print('%d.%d' % sys.version_info[:2])"
    ours = "{}.{}".format(*sys.version_info[:2])
    if (
        not Path("/etc/debian_version").exists()
        or not debian.exists()
        or subprocess.run([debian, "-c", version], capture_output=True, text=True, check=False).stdout.strip() != ours
    ):
        pytest.skip(f"needs a Debian whose python3 is {ours}, as that of the tests: its packages run in the fresh root")
    try:
        with booted_root({repository: SOURCE, Path(sysconfig.get_path("purelib")): PACKAGES}) as made:
            if made.run("dpkg-query", "--show", "python3-venv").returncode:
                pytest.skip("python3-venv is not installed here, and these tests download nothing")
            made.write("/tmp/pip/pip/__main__.py", PIP)
            made.write("/tmp/pip/pip/__init__.py", "")
            yield made
    except RootRefusedError as refused:
        pytest.skip(str(refused))


def install(root: DebianRoot, *arguments: str, source: str = SOURCE) -> str:
    done = root.run(f"{source}/deploy/install.sh", *arguments, environment={"PYTHONPATH": "/tmp/pip"}, timeout_s=300.0)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def is_active(root: DebianRoot, unit: str) -> bool:
    return root.run("systemctl", "is-active", unit).stdout.strip() == "active"


def get(root: DebianRoot, key: str, *options: str) -> str:
    return root.run(RHOT, "get", key, "--rig", RIG, *options).stdout


def test_install_leaves_services_that_run_save_and_start_by_themselves(root: DebianRoot) -> None:
    install(root, "pc")
    install(root, "capture", "--camera", "left", "--without-picamera2")
    assert root.output("stat", "--format=%U", RIG, f"{RIG}/rig.toml").split() == ["rhot", "rhot"]
    units_are_accepted(root)

    # A rig whose cameras are simulated, so that all services have something to do.
    root.output("sh", "-c", f"rm -r {RIG} && {RHOT} init --sim {RIG} && chown -R rhot:rhot {RIG}")
    root.output("sed", "-i", "s/^autostart = false/autostart = true/", f"{RIG}/rig.toml")
    root.output("systemctl", "restart", "--no-block", "rhot.target")
    units = [*(f"rhot-{name}" for name in RUNNING), "rhot-capture@left", "rhot-start"]
    for unit in units:
        eventually(lambda unit=unit: is_active(root, unit), f"{unit} {logs(root, unit)}")  # type: ignore[misc]
    assert not is_active(root, "rhot-feet"), "a rig without feet"
    eventually(lambda: '"state": "running"' in get(root, "rhot/status/capture/left"), "the session starts by itself")

    rights_are_those_of_the_unit(root)
    saving_works(root)
    it_comes_back_after_a_power_cut(root)
    install(root, "--uninstall")
    assert root.run("id", "rhot").returncode != 0
    assert root.output("ls", RIG)


def test_interrupted_and_repeated_from_a_folder_with_spaces_it_ends_the_same(root: DebianRoot) -> None:
    root.output("ln", "--symbolic", SOURCE, SPACED)
    interrupted = 0
    for seconds in ("0.3", "1", "2.5"):
        done = root.run(
            *("timeout", "--signal=INT", seconds, f"{SPACED}/deploy/install.sh", "pc"),
            environment={"PYTHONPATH": "/tmp/pip"},
        )
        interrupted += done.returncode != 0
    assert interrupted, "it was quicker than the interruptions"
    after = []
    for _ in range(2):
        install(root, "pc", source=SPACED)
        after.append(installed_files(root))
    assert after[0] == after[1]
    for name in ("router", "fusion", "ik"):
        eventually(lambda name=name: is_active(root, f"rhot-{name}"), logs(root, f"rhot-{name}"))  # type: ignore[misc]
    install(root, "--uninstall", source=SPACED)


def installed_files(root: DebianRoot) -> str:
    """Every file of the installation with its checksum; compiled modules hold a time."""
    places = "/opt/rhot /etc/systemd/system/rhot* /etc/default/rhot*"
    return root.output("sh", "-c", f"find {places} -type f -not -name '*.pyc' -exec sha256sum {{}} + | sort -k 2")


def logs(root: DebianRoot, unit: str) -> str:
    return root.run("journalctl", "--no-pager", "--lines=15", "--unit", unit).stdout


def units_are_accepted(root: DebianRoot) -> None:
    files = root.output("sh", "-c", "ls /etc/systemd/system/rhot-*.service").split()
    assert {Path(file).name for file in files} == {unit.name for unit in UNITS.glob("rhot-*.service")}
    for file in files:
        unit = file.replace("@.", "@left.")
        verified = root.run("systemd-analyze", "verify", unit)
        assert verified.returncode == 0, verified.stderr
        assert "rhot" not in verified.stdout + verified.stderr, verified.stderr
        security = root.run("systemd-analyze", "security", "--no-pager", "--threshold=30", "--offline=true", unit)
        exposure = re.search(r"exposure level for \S+: ([\d.]+)", security.stdout)
        assert exposure is not None, security.stdout
        assert float(exposure[1]) <= 3.0, unit


def rights_are_those_of_the_unit(root: DebianRoot) -> None:
    """Read from the kernel for each running service, and tried in its place."""
    for name in (*RUNNING, "capture@left"):
        unit = f"rhot-{name}"
        pid = root.output("systemctl", "show", "--property=MainPID", "--value", unit)
        status = dict(
            line.split(":", 1) for line in root.output("cat", f"/proc/{pid}/status").splitlines() if ":" in line
        )
        rhot = root.output("id", "--user", "rhot")
        assert set(status["Uid"].split()) == {rhot}, unit
        assert {int(status[field], 16) for field in ("CapEff", "CapPrm", "CapBnd", "CapAmb")} == {0}, unit
        assert status["NoNewPrivs"].strip() == "1", unit
        assert status["Seccomp"].strip() == "2", unit

        def can(command: str, unit: str = unit) -> bool:
            return root.as_service(unit, "sh", "-c", command).returncode == 0

        saves = name in ("viewer", "capture@left")
        assert can(f"cat {RIG}/rig.toml > /dev/null"), unit
        assert can(f"touch {RIG}/.x && rm {RIG}/.x") is saves, unit
        assert can("touch /tmp/x"), unit
        for elsewhere in ("/etc/x", "/opt/rhot/x", "/var/lib/x", "/home/x", "/root/x", "/proc/sys/kernel/hostname"):
            assert not can(f"touch {elsewhere}"), (unit, elsewhere)
        assert not can("ls /root/* /home/*"), unit


def saving_works(root: DebianRoot) -> None:
    """What "Save" of the page's first step does: the capture service writes into its rig."""
    changed = root.run(RHOT, "config", "capture/left", "saturation=1.25", "--rig", RIG)
    assert changed.returncode == 0, changed.stderr
    answer = get(root, "rhot/keep/capture/left?do=save")
    assert "saturation = 1.25" in root.output("cat", f"{RIG}/rig.toml"), answer + changed.stdout
    assert root.output("stat", "--format=%U", f"{RIG}/rig.toml") == "rhot"
    # And what the other steps do, which the viewer writes itself, with the viewer's own rights.
    code = (
        "from pathlib import Path; from rhot.rig import HandFile; from rhot.rig.kept_file import KeptFile; "
        f"kept = KeptFile(Path('{RIG}/hand.json'), HandFile); kept.try_out(HandFile(length_m=0.2)); kept.save()"
    )
    saved = root.as_service("rhot-viewer", "/opt/rhot/venv/bin/python", "-c", code)
    assert saved.returncode == 0, saved.stderr
    assert json.loads(root.output("cat", f"{RIG}/hand.json"))["length_m"] == 0.2


def it_comes_back_after_a_power_cut(root: DebianRoot) -> None:
    """Everything dies at once and is started as at boot."""
    units = [f"rhot-{name}" for name in (*RUNNING, "capture@left")]
    root.output("systemctl", "stop", "rhot-start")
    root.output("systemctl", "kill", "--signal=SIGKILL", *units)
    root.output("systemctl", "stop", "rhot.target")
    eventually(lambda: not any(is_active(root, unit) for unit in units), "all are down")
    root.output("systemctl", "start", "--no-block", "rhot.target")
    eventually(lambda: '"state": "running"' in get(root, "rhot/status/capture/left"), "the session starts by itself")
