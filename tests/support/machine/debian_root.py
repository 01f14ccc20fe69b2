"""A Debian of the test's own, with systemd as its first process: namespaces over a copy-on-write view of this machine.

Needs root, overlayfs, namespaces and cgroup v2; where the kernel refuses one of them, `booted_root` says so. What runs
in it sees no network but its own loopback, and nothing of it is left afterwards.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

_BOOT_S = 60.0
_IN_CGROUP = ("sh", "-c", 'echo $$ > "$0/cgroup.procs" && exec "$@"')
_BOOT = r"""
set -e
mount --make-rprivate /
base=$1; root=$base/root; shift
mount -t tmpfs tmpfs "$base"
mkdir "$base/up" "$base/work" "$root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$base/up,workdir=$base/work" "$root"
mount -t proc proc "$root/proc"
mount -t sysfs sysfs "$root/sys"
mount -t cgroup2 cgroup2 "$root/sys/fs/cgroup"
for folder in run tmp dev; do mount -t tmpfs tmpfs "$root/$folder"; done
chmod 1777 "$root/tmp"
for node in null zero full random urandom tty; do cp -a "/dev/$node" "$root/dev/"; done
mkdir "$root/dev/pts" "$root/dev/shm"
mount -t devpts -o newinstance,ptmxmode=0666 devpts "$root/dev/pts"
ln -s pts/ptmx "$root/dev/ptmx"
while [ $# -gt 0 ]; do
    mkdir -p "$root$2"
    mount --bind "$1" "$root$2"
    mount -o remount,ro,bind "$root$2"
    shift 2
done
# A machine that knows nothing of the one below: no services of its own, no variables, none of our files.
rm -rf "$root"/etc/systemd/system/*.wants "$root"/etc/systemd/system/rhot* "$root/etc/default/rhot"
rm -rf "$root/opt/rhot" "$root/etc/rhot" "$root/var/lib/rhot" "$root"/var/log/journal
echo 0123456789abcdef0123456789abcdef > "$root/etc/machine-id"
for unit in systemd-udevd systemd-udev-trigger systemd-modules-load systemd-sysctl systemd-logind systemd-random-seed \
    systemd-timesyncd apparmor; do
    ln -sf /dev/null "$root/etc/systemd/system/$unit.service"
done
ip link set lo up
exec env -i container=rhot-test PATH=/usr/sbin:/usr/bin:/sbin:/bin \
    chroot "$root" /lib/systemd/systemd --system --unit=multi-user.target --log-target=journal --show-status=no
"""


class RootRefusedError(Exception):
    """This machine lets no root be made; says why."""


class DebianRoot:
    """A booted root."""

    def __init__(self, pid: int) -> None:
        self._pid = pid

    def run(
        self, *command: str, environment: Mapping[str, str] | None = None, timeout_s: float = 120.0
    ) -> subprocess.CompletedProcess[str]:
        """Run a command in it as root."""
        variables = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL": "C", **(environment or {})}
        return subprocess.run(
            [
                *("nsenter", "--target", str(self._pid), "--mount", "--pid", "--net", "--uts", "--ipc", "--cgroup"),
                *("--root", "--wd=/", "env", "-i", *(f"{name}={value}" for name, value in variables.items()), *command),
            ],
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )

    def output(self, *command: str, environment: Mapping[str, str] | None = None) -> str:
        """Return what a command says; it has to succeed."""
        done = self.run(*command, environment=environment)
        assert done.returncode == 0, f"{' '.join(command)}: {done.stdout}{done.stderr}"
        return done.stdout.strip()

    def write(self, path: str, text: str, mode: str = "0644") -> None:
        """Write a file."""
        script = 'mkdir -p "$(dirname "$1")"; printf %s "$2" > "$1"; chmod "$3" "$1"'
        self.output("sh", "-c", script, "sh", path, text, mode)

    def as_service(self, unit: str, *command: str) -> subprocess.CompletedProcess[str]:
        """Run a command where a running service runs: its view of the files, its user, without any privilege."""
        pid = self.output("systemctl", "show", "--property=MainPID", "--value", unit)
        user = ("setpriv", "--reuid=rhot", "--regid=rhot", "--clear-groups", "--no-new-privs", "--bounding-set=-all")
        return self.run("nsenter", "--target", pid, "--mount", "--root", "--wd=/", *user, *command)


@contextlib.contextmanager
def booted_root(folders: Mapping[Path, str]) -> Iterator[DebianRoot]:
    """Boot a root; `folders` of this machine are seen in it read-only, by the path there.

    Raises:
        RootRefusedError: the machine lets none be made.
    """
    needed = ("unshare", "nsenter", "chroot", "mount", "ip", "setpriv", "systemctl")
    missing = [name for name in needed if shutil.which(name) is None]
    if os.geteuid() != 0 or missing:
        raise RootRefusedError(f"needs root and {', '.join(needed)}; missing: {', '.join(missing) or 'root'}")
    base = Path(tempfile.mkdtemp(prefix="rhot-root-"))
    groups = Path(tempfile.mkdtemp(prefix="rhot-cgroup-"))
    try:
        mounted = subprocess.run(["mount", "-t", "cgroup2", "cgroup2", str(groups)], capture_output=True, check=False)
        if mounted.returncode:
            raise RootRefusedError("no cgroup v2 on this kernel")
        group = groups / base.name
        group.mkdir()
        binds = [word for here, there in folders.items() for word in (str(here), there)]
        unshare = ["unshare", "--mount", "--pid", "--fork", "--cgroup", "--uts", "--ipc", "--net", "--kill-child"]
        process = subprocess.Popen(
            # Its cgroup first, so that the namespace of cgroups begins there.
            [*_IN_CGROUP, str(group), *unshare, "bash", "-c", _BOOT, "boot", str(base), *binds],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            yield _booted(process)
        finally:
            process.kill()
            process.communicate()
            _remove(group)
    finally:
        subprocess.run(["umount", str(groups)], capture_output=True, check=False)
        groups.rmdir()
        base.rmdir()


def _booted(process: subprocess.Popen[str]) -> DebianRoot:
    deadline = time.monotonic() + _BOOT_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise RootRefusedError(f"the kernel refuses a root: {process.communicate()[1].strip()[-300:]}")
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        if children and Path(f"/proc/{children[0]}/comm").read_text().strip() == "systemd":
            root = DebianRoot(int(children[0]))
            state = root.run("systemctl", "is-system-running").stdout.strip()
            if state in ("running", "degraded"):
                return root
        time.sleep(0.1)
    raise RootRefusedError("systemd does not come up in a namespace here")


def _remove(group: Path) -> None:
    """Remove a cgroup and those below it, as soon as their processes have ended."""
    deadline = time.monotonic() + 10.0
    while group.exists() and time.monotonic() < deadline:
        for folder, _, _ in os.walk(group, topdown=False):
            with contextlib.suppress(OSError):
                Path(folder).rmdir()
        time.sleep(0.05)
