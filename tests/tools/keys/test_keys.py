"""`rhot keys` and what `rhot doctor` says of the bus: two commands secure two machines."""

from __future__ import annotations

import datetime as dt
import io
import stat
import tarfile
import tracemalloc
from pathlib import Path

import pytest
from click.testing import CliRunner

from rhot.errors import ConfigError
from rhot.keys import credentials, load_roles
from rhot.rig.folder import RIG_FILE, load_config, load_rig
from rhot.rig.toml_edit import change_rig_file
from rhot_tools.keys.command import install_bundle, keys
from rhot_tools.operate.findings import check_bus


def run(*arguments: str, data: bytes | None = None) -> str:
    result = CliRunner().invoke(keys, arguments, input=data, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def findings(rig: Path) -> str:
    return "\n".join(f"{finding.level} {finding.text} → {finding.remedy}" for finding in check_bus(load_rig(rig)))


def test_the_router_keeps_its_port(rig_folder: Path) -> None:
    change_rig_file(rig_folder, {("bus",): {"listen": ["tcp/127.0.0.1:7472"], "connect": ["tcp/127.0.0.1:7472"]}})
    run("make", "--address", "192.0.2.7", "--rig", str(rig_folder))
    bus = load_config(rig_folder).bus
    assert (bus.connect, bus.listen) == (("tls/192.0.2.7:7472",), ("tls/0.0.0.0:7472",))


def test_two_commands_secure_two_machines(rig_folder: Path, tmp_path: Path) -> None:
    assert "closed" in findings(rig_folder)
    said = run("make", "--address", "192.0.2.7", "--rig", str(rig_folder))
    bundle = rig_folder / "keys" / "camera-left.tar"
    assert str(bundle) in said
    pi = tmp_path / "pi"
    run("install", "-", "--rig", str(pi), data=bundle.read_bytes())
    for rig in (rig_folder, pi):
        bus = load_config(rig).bus
        assert bus.tls
        assert bus.connect == ("tls/192.0.2.7:7447",)
        assert bus.keys == str(rig.resolve() / "keys")
    assert credentials(pi / "keys", "camera-left").key.exists()
    with pytest.raises(ConfigError, match="no certificate operator or tool"):
        credentials(pi / "keys", "")
    assert credentials(rig_folder / "keys", "").key.name == "operator.key"
    private = [*(rig_folder / "keys").glob("*.key"), *(rig_folder / "keys").glob("*.tar"), *(pi / "keys").glob("*.key")]
    assert all(stat.S_IMODE(file.stat().st_mode) == 0o600 for file in private)
    assert not (pi / "keys" / "authority.key").exists()
    report = findings(rig_folder)
    assert "for who holds a certificate" in report
    assert "camera-right (camera)" in report


def test_a_rig_that_is_there_keeps_everything_but_its_bus(rig_folder: Path, tmp_path: Path) -> None:
    run("make", "--address", "pc.local", "--rig", str(rig_folder))
    pi = tmp_path / "pi"
    pi.mkdir()
    text = (rig_folder / RIG_FILE).read_text().replace("exposure_s = 0.004", "exposure_s = 0.002  # mine")
    (pi / RIG_FILE).write_text(text.replace("tls = true", "tls = false").replace("tls/pc.local", "tcp/old"))
    change_rig_file(pi, {("bus",): {"listen": ["tcp/127.0.0.1:7447"]}})
    run("install", str(rig_folder / "keys" / "camera-right.tar"), "--rig", str(pi))
    assert "# mine" in (pi / RIG_FILE).read_text()
    assert load_config(pi).bus.connect == ("tls/pc.local:7447",)


def test_one_more_and_one_less(rig_folder: Path, tmp_path: Path) -> None:
    run("make", "--address", "192.0.2.7", "--rig", str(rig_folder))
    run("add", "anna", "--role", "operator", "--rig", str(rig_folder))
    assert "anna                     operator, until" in run("list", "--rig", str(rig_folder))
    laptop = tmp_path / "laptop"
    run("install", str(rig_folder / "keys" / "anna.tar"), "--rig", str(laptop))
    assert load_config(laptop).bus.identity == "anna"
    run("remove", "anna", "--rig", str(rig_folder))
    assert "anna" not in load_roles(rig_folder / "keys").holders
    for arguments, says in (
        (("make", "--address", "x"), "holds keys already"),
        (("add", "services"), "is taken"),
        (("add", "third", "--role", "camera"), "--camera NAME"),
        (("remove", "router"), "can be removed"),
    ):
        with pytest.raises(ConfigError, match=says):
            run(*arguments, "--rig", str(rig_folder))


@pytest.mark.parametrize(
    "address", ["", "a b", "a..b", "192.0.2.7:7447", "tcp/192.0.2.7:7447", "ä.local", "-x", "x" * 64]
)
def test_an_address_that_is_none_is_refused_and_nothing_is_written(rig_folder: Path, address: str) -> None:
    before = (rig_folder / RIG_FILE).read_text()
    with pytest.raises(ConfigError, match="without protocol and port"):
        run("make", "--address", address, "--rig", str(rig_folder))
    assert (rig_folder / RIG_FILE).read_text() == before
    assert not (rig_folder / "keys").exists()
    with pytest.raises(ConfigError, match="`rhot keys make`, on the router's machine, makes it"):
        run("list", "--rig", str(rig_folder))
    run("make", "--address", "pc-2.local", "--address", "fe80::1", "--rig", str(rig_folder))


@pytest.mark.parametrize("name", ["../evil", "/etc/passwd", "keys/../../evil.key", "keys/a/b.pem", "run.sh"])
def test_a_bundle_writes_nowhere_else(tmp_path: Path, name: str) -> None:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        archive.addfile(tarfile.TarInfo(name), io.BytesIO())
    with pytest.raises(ConfigError, match="belongs to none"):
        install_bundle(stream.getvalue(), tmp_path / "pi")
    with pytest.raises(ConfigError, match="no bundle"):
        install_bundle(b"x" * 2000, tmp_path / "pi")
    assert not (tmp_path / "pi").exists()


def test_doctor_says_what_is_open(rig_folder: Path) -> None:
    change_rig_file(rig_folder, {("bus",): {"listen": ["tcp/0.0.0.0:7447"]}})
    assert "warn the router listens on tcp/0.0.0.0:7447 without certificates" in findings(rig_folder)
    change_rig_file(rig_folder, {("bus",): {"listen": ["tcp/127.0.0.1:7447"]}})
    run("make", "--address", "192.0.2.7", "--rig", str(rig_folder))
    run("remove", "camera-left", "--rig", str(rig_folder))
    (rig_folder / "keys" / "operator.key").chmod(0o644)
    report = findings(rig_folder)
    assert "camera left has no certificate" in report
    assert "others on this machine can read operator.key" in report


def test_tls_with_a_plain_endpoint_is_refused(rig_folder: Path) -> None:
    text = (rig_folder / RIG_FILE).read_text().replace("tls = false", "tls = true")
    (rig_folder / RIG_FILE).write_text(text)
    with pytest.raises(ConfigError, match="is not encrypted"):
        load_config(rig_folder)


def bundle_of(**files: bytes) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        for name, data in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return stream.getvalue()


@pytest.mark.parametrize("damage", ["no pem", "another key", "cut", "no key"])
def test_a_damaged_bundle_replaces_nothing(rig_folder: Path, tmp_path: Path, damage: str) -> None:
    run("make", "--address", "192.168.1.10", "--rig", str(rig_folder))
    pi = tmp_path / "pi"
    good = (rig_folder / "keys" / "camera-left.tar").read_bytes()
    install_bundle(good, pi)
    before = {file: file.read_bytes() for file in pi.rglob("*") if file.is_file()}
    with tarfile.open(fileobj=io.BytesIO(good)) as archive:
        files = {entry.name: stream.read() for entry in archive if (stream := archive.extractfile(entry))}
    certificate, key = "keys/camera-left.pem", "keys/camera-left.key"
    if damage == "no pem":
        files[certificate] = b"garbage"
    elif damage == "another key":
        files[key] = (rig_folder / "keys" / "camera-right.key").read_bytes()
    elif damage == "cut":
        files[certificate] = files[certificate][:300]
    else:
        del files[key]
    with pytest.raises(ConfigError, match=r"camera-left\.pem is no certificate with its key; nothing was replaced"):
        install_bundle(bundle_of(**files), pi)
    assert {file: file.read_bytes() for file in pi.rglob("*") if file.is_file()} == before


def test_a_bundle_that_says_it_is_gigabytes_is_refused(tmp_path: Path) -> None:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.GNU_FORMAT) as archive:
        entry = tarfile.TarInfo("rig.toml")
        entry.size = 1
        archive.addfile(entry, io.BytesIO(b"#"))
    data = bytearray(stream.getvalue())
    # An old GNU sparse file of 3.2 GB: one byte of data, the rest a hole (GNU tar manual, "Old GNU Format").
    data[156:157] = tarfile.GNUTYPE_SPARSE
    data[386:410] = b"00000000000\x0000000000001\x00"
    data[483:495] = f"{3_200_000_000:011o}".encode() + b"\0"
    data[148:156] = b" " * 8
    data[148:156] = f"{sum(data[:512]):06o}\0 ".encode()
    tracemalloc.start()
    with pytest.raises(ConfigError, match=r"belongs to none|more than itself"):
        install_bundle(bytes(data), tmp_path / "pi")
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()
    assert not (tmp_path / "pi").exists()


@pytest.mark.parametrize("year", [1999, 2011, 2025])
def test_no_certificates_are_made_with_a_clock_that_stands_in_the_past(
    rig_folder: Path, monkeypatch: pytest.MonkeyPatch, year: int
) -> None:
    class Past(dt.datetime):
        @classmethod
        def now(cls, tz: dt.tzinfo | None = None) -> Past:
            return cls(year, 1, 1, tzinfo=tz)

    monkeypatch.setattr("rhot_tools.keys.making.dt.datetime", Past)
    with pytest.raises(ConfigError, match=f"clock of this machine says {year}-01-01"):
        run("make", "--address", "192.168.1.10", "--rig", str(rig_folder))
    assert not (rig_folder / "keys").exists()
