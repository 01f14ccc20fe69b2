"""`make stacks`: our drivers and files on the software they were written for, and a report of what ran on what.

Usage: run.py [STACK…]. Installs what is missing from Debian (as root) and PyPI, keeps what it makes in `.stacks`, and
leaves nothing running. With `RHOT_DEVICE` a stack is tested on the device that is here instead of an emulated one:
`RHOT_DEVICE=/dev/video0 make stacks STACKS=v4l2`, `realsense`, `openvr`, `picamera2`, `/dev/serial/by-id/…`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
CACHE = Path(os.environ.get("RHOT_STACKS", REPOSITORY / ".stacks"))
CONSTRAINTS = REPOSITORY / "constraints.txt"
GUEST_S = 900.0
"""Longest run of the emulated machine."""
OUT = Console(highlight=False, width=None if sys.stdout.isatty() else 120)


@dataclass(frozen=True)
class Stack:
    """One software stack.

    Attributes:
        name: as on the command line.
        what: runs it, for the report.
        tests: paths of its tests.
        commands: programs it needs, each with Debian's package.
        guest: whether its tests run in the emulated machine.
        marker: of the tests.
        made: what they run in, for people, and a file that is there once it is made, in a folder that is named as the
            one here whose make.sh makes it.
    """

    name: str
    what: str
    tests: Sequence[str]
    commands: dict[str, str] = field(default_factory=dict)
    guest: bool = False
    marker: str = "stacks"
    made: tuple[str, str] | None = None


_ROOTS = {"mmdebstrap": "mmdebstrap"}
_GUEST = {**_ROOTS, "qemu-system-x86_64": "qemu-system-x86", "mke2fs": "e2fsprogs", "cpio": "cpio", "xz": "xz-utils"}
STACKS = (
    Stack("realsense", "RealSense SDK (pyrealsense2), its recorder and playback", ["test_realsense.py"], marker=""),
    Stack("openvr", "OpenVR's client library, a runtime of the test", ["test_openvr.py"], {"cc": "gcc"}, marker=""),
    Stack("v4l2", "Linux 6.12: vivid, v4l2loopback", ["test_v4l2.py"], _GUEST, guest=True),
    Stack("evening", "Linux 6.12: v4l2loopback, docs/evening.md", ["test_evening.py"], _GUEST, guest=True),
    Stack("serial", "Linux 6.12: USB gadget over dummy_hcd", ["test_serial.py"], _GUEST, guest=True),
    Stack("picamera2", "picamera2 on libcamera 0.4, vimc", ["test_picamera2.py"], _GUEST, guest=True),
    Stack(
        "openxr",
        "Khronos loader, Monado 25, pyopenxr, hello_xr",
        ["test_openxr.py"],
        _ROOTS,
        made=("a Debian with Monado", "openxr/.ready"),
    ),
    Stack(
        "arm64",
        "aarch64 wheels under QEMU",
        ["test_arm64.py"],
        {**_ROOTS, "qemu-aarch64": "qemu-user", "cc": "gcc"},
        made=("the ARM root", "arm64/count.so"),
    ),
    Stack(
        "containers",
        "Docker engine and compose",
        ["test_containers.py"],
        {**_ROOTS, "dockerd": "docker.io", "docker-compose": "docker-compose", "iptables": "iptables"},
    ),
    Stack("installer", "Debian with systemd, booted in namespaces", ["../deploy/test_fresh_root.py"], marker="faults"),
    Stack(
        "readers",
        "Blender, OpenSim, vmcp, Isaac Teleop",
        ["../tools/export/test_installed_readers.py"],
        made=("an environment of readers", "readers/.ready"),
    ),
    Stack(
        "robots",
        "dex-retargeting on Pinocchio: robot hands",
        ["test_robots.py"],
        made=("an environment of robots", "robots/.ready"),
    ),
)


def main(names: Sequence[str]) -> int:
    """Run the stacks that are named, or all, and return the exit code."""
    unknown = set(names) - {stack.name for stack in STACKS}
    if unknown:
        OUT.print(f"no such stack: {', '.join(sorted(unknown))}; there are {', '.join(s.name for s in STACKS)}")
        return 2
    chosen = [stack for stack in STACKS if not names or stack.name in names]
    if "RHOT_DEVICE" in os.environ:
        # The device is here: nothing has to be emulated.
        chosen = [replace(stack, commands={}, guest=False) for stack in chosen]
    CACHE.mkdir(parents=True, exist_ok=True)
    missing = _install(chosen)
    results: list[Result] = []
    guests = [stack for stack in chosen if stack.guest]
    for stack in chosen:
        if lacking := [package for command, package in stack.commands.items() if command in missing]:
            results.append(Result(stack, reason=f"needs {' '.join(lacking)}: apt install {' '.join(lacking)}"))
        elif stack not in guests:
            results.append(_run_here(stack))
    if ready := [stack for stack in guests if not missing & stack.commands.keys()]:
        results += _run_in_guest(ready)
    return _report(results)


@dataclass
class Result:
    """What a stack's tests said."""

    stack: Stack
    passed: int = 0
    failed: int = 0
    skipped: int = 0
    seconds: float = 0.0
    reason: str = ""
    notes: list[str] = field(default_factory=list)


def _install(stacks: Sequence[Stack]) -> set[str]:
    """Install Debian's packages where that is possible; return the commands that are missing."""
    wanted = {command: package for stack in stacks for command, package in stack.commands.items()}
    missing = {command for command in wanted if shutil.which(command) is None}
    if missing and os.geteuid() == 0 and shutil.which("apt-get"):
        packages = sorted({wanted[command] for command in missing})
        OUT.print(f"installing {' '.join(packages)}")
        quiet = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        command = ["apt-get", "install", "--yes", "--quiet", "--no-install-recommends", *packages]
        for update in (["apt-get", "update", "--quiet"], command):
            subprocess.run(update, env=quiet, stdout=subprocess.DEVNULL, check=False)
        missing = {command for command in wanted if shutil.which(command) is None}
    return missing


def _made(name: str, mark: str) -> str:
    """Make something in the cache unless it is there; return why it could not be made."""
    if (CACHE / mark).exists():
        return ""
    OUT.print(f"making {name}")
    folder = mark.partition("/")[0]
    command = [HERE / folder / "make.sh", CACHE / folder, CONSTRAINTS, Path(sys.executable).with_name("pip")]
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return ""
    last = (done.stderr or done.stdout).strip().splitlines()[-1:]
    return f"{name} cannot be made: {' '.join(last)}"


def _run_here(stack: Stack) -> Result:
    if stack.made and (reason := _made(*stack.made)):
        return Result(stack, failed=1, reason=reason)
    OUT.print(f"running {stack.name}")
    report = CACHE / f"{stack.name}.xml"
    marker = ["-m", stack.marker] if stack.marker else []
    tests = [str(HERE / test) for test in stack.tests]
    variables = {**os.environ, "RHOT_STACKS": str(CACHE)}
    subprocess.run(
        [sys.executable, "-m", "pytest", *marker, "-rs", f"--junitxml={report}", *tests],
        cwd=REPOSITORY,
        env=variables,
        check=False,
    )
    return _read(stack, report)


def _run_in_guest(stacks: Sequence[Stack]) -> list[Result]:
    """Boot the emulated machine once, and run all its tests in it."""
    folder, share = CACHE / "guest", CACHE / "share"
    if reason := _made("the emulated machine (minutes, once)", "guest/disk.ext4"):
        return [Result(stack, failed=1, reason=reason) for stack in stacks]
    shutil.rmtree(share, ignore_errors=True)
    (share / "played").mkdir(parents=True)
    # What is installed here, so that the guest's `rhot` knows its commands.
    for installed in Path(sys.executable).parents[1].glob("lib/python3*/site-packages/rhot*.dist-info"):
        shutil.copytree(installed, share / "site" / installed.name)
    subprocess.run([sys.executable, str(HERE / "prepare.py"), str(share / "played")], check=True)
    parts = ["common", "tools", "calibration", "simulation", "bench", *_services()]
    pytest = "python -m pytest -o cache_dir=/tmp/pytest -m stacks -rs"
    runs = [
        f"timeout -s INT 600 {pytest} --junitxml=/share/{stack.name}.xml "
        + " ".join(f"tests/stacks/{test}" for test in stack.tests)
        for stack in stacks
    ]
    paths = ":".join(["/share/site", *(f"/rhot/{part}" for part in parts)])
    (share / "job.sh").write_text("\n".join(["cd /rhot", f"export RHOT_GUEST=1 PYTHONPATH={paths}", *runs, ""]))
    OUT.print(f"running {', '.join(stack.name for stack in stacks)} in an emulated machine")
    mounts = [f"local,path={path},mount_tag={tag},security_model=none{more}" for path, tag, more in (
        (share, "share", ""), (REPOSITORY, "rhot", ",readonly=on"))]  # fmt: skip
    with (share / "console.txt").open("w") as console:
        subprocess.run(
            [
                *("timeout", str(GUEST_S), "qemu-system-x86_64", "-machine", "q35", "-accel", "tcg,thread=multi"),
                *("-cpu", "max", "-smp", "2", "-m", "2048", "-nographic", "-no-reboot", "-nodefaults"),
                *("-serial", "stdio", "-kernel", str(folder / "vmlinuz"), "-initrd", str(folder / "initrd")),
                *("-append", "console=ttyS0 quiet loglevel=3 mitigations=off panic=-1"),
                *("-drive", f"file={folder / 'disk.ext4'},if=virtio,format=raw,snapshot=on"),
                *(part for mount in mounts for part in ("-virtfs", mount)),
            ],
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=console,
            check=False,
        )
    output = share / "output.txt"
    OUT.print(output.read_text() if output.exists() else (share / "console.txt").read_text(), markup=False)
    return [_read(stack, share / f"{stack.name}.xml") for stack in stacks]


def _services() -> list[str]:
    return sorted(f"services/{path.name}" for path in (REPOSITORY / "services").iterdir() if path.is_dir())


def _read(stack: Stack, report: Path) -> Result:
    """Return what a JUnit report of pytest says."""
    if not report.exists():
        return Result(stack, failed=1, reason="its tests did not end; see above")
    suites = ET.parse(report)
    result = Result(stack, seconds=sum(float(suite.get("time", 0.0)) for suite in suites.iter("testsuite")))
    for case in suites.iter("testcase"):
        skipped = case.find("skipped")
        if case.find("failure") is not None or case.find("error") is not None:
            result.failed += 1
        elif skipped is not None:
            result.skipped += 1
            result.notes.append(f"{case.get('name')}: {skipped.get('message')}")
        else:
            result.passed += 1
        result.notes += [f"{told.get('name')}: {told.get('value')}" for told in case.iter("property")]
    report.unlink()
    return result


def _report(results: Sequence[Result]) -> int:
    """Print the table and return the exit code."""
    table = Table("stack", "ran on", "passed", "failed", "skipped", "seconds", title="Real stacks")
    for result in results:
        counts = [str(count) for count in (result.passed, result.failed, result.skipped)]
        where = os.environ.get("RHOT_DEVICE", result.stack.what)
        table.add_row(result.stack.name, result.reason or where, *counts, f"{result.seconds:.0f}")
    OUT.print(table)
    for result in results:
        for note in result.notes:
            OUT.print(f"{result.stack.name}: {note}", markup=False)
    return 1 if any(result.failed for result in results) or not any(result.passed for result in results) else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
