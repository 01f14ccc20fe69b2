"""The command line: help for everybody, one clear error for every mistake, no traceback."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from rich.console import Console

from rhot.cli import main
from rhot.cli.options import tool_bus
from rhot.errors import ConfigError
from rhot.report.html import figures_table
from rhot.rig.folder import load_config
from rhot.text import printable
from rhot_tools.operate.configure import parse_assignments
from rhot_tools.operate.inspect import json_text, plain_value

NOBODY = "unixsock-stream//nonexistent/z.sock"


def rhot(*arguments: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "rhot", *arguments], capture_output=True, text=True, timeout=timeout_s, check=False
    )


def commands() -> list[str]:
    return main.list_commands(click.Context(main))


@pytest.mark.parametrize("name", commands())
def test_every_command_has_a_help_for_newcomers(name: str) -> None:
    command = main.get_command(click.Context(main, info_name="rhot"), name)
    assert command is not None
    result = CliRunner().invoke(command, ["--help"])
    assert result.exit_code == 0
    assert len(result.output.split()) > 15
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"{name} {parameter.opts[0]} is not explained"


def test_the_overview_imports_no_command() -> None:
    code = (
        "import sys; from click.testing import CliRunner; from rhot.cli import main;"
        "CliRunner().invoke(main, ['--help']); print(sorted(m for m in ('cv2', 'zenoh', 'numpy') if m in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["statsu"], "No such command 'statsu'. Did you mean 'status'?"),
        (["fusion", "--rig", "/nonexistent"], "rhot init"),
        (["capture", "--camera", "middle", "--rig", "RIG"], "it has left, right"),
        (["objects", "--rig", "RIG"], "names no objects"),
        (["get", "rhot/**", "--connect", NOBODY], "no Zenoh router answers"),
        (["get", "rhot/**", "--connect", "nonsense"], "begins with its protocol"),
        (["sim", "--listen", "tcp/127.0.0.1:0"], "port 0"),
        (["status", "--connect", NOBODY], "rhot sim"),
        (["start", "--connect", NOBODY], "no Zenoh router answers"),
        (["config", "capture/*", "gain=2"], "one service at a time"),
        (["process", "/nonexistent", "--rig", "RIG", "--out", "OUT"], "/nonexistent"),
        (["process", "RIG", "--rig", "/nonexistent", "--out", "OUT"], "rhot init"),
        (["init", "RIG"], "is there already"),
        (["init", "/proc/rig"], "cannot be made"),
        (["sim", "--rig", "RIG"], "not simulated"),
        (["router", "--listen", "tcp/203.0.113.1:9"], "cannot open a Zenoh router"),
        (["truth", "--rig", "/nonexistent"], "rhot init"),
    ],
)
def test_mistakes_end_in_one_error_that_helps(
    arguments: list[str], says: str, rig_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word.replace("RIG", str(rig_folder)).replace("OUT", str(tmp_path / "out.jsonl")) for word in arguments]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code in (1, 2)
    said = capsys.readouterr().err
    assert says in said
    assert "Traceback" not in said
    assert not (tmp_path / "out.jsonl").exists()


@pytest.mark.parametrize(
    "words", [("report", "a.jsonl", "--out"), ("export", "a.jsonl", "--nwb"), ("export", "a.jsonl", "--foxglove")]
)
@pytest.mark.parametrize("name", ["a.jsonl", "link.jsonl"])
def test_no_command_writes_over_what_it_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.jsonl").write_text("recorded\n")
    Path("link.jsonl").hardlink_to("a.jsonl")
    done = CliRunner().invoke(main, [*words, name])
    assert done.exit_code == 2
    assert f"{words[-1]} {name} is the file that it reads; choose another name" in done.output
    assert Path("a.jsonl").read_text() == "recorded\n"


def test_two_options_do_not_write_one_file(tmp_path: Path) -> None:
    words = ["export", "a.mcap", "--bvh", str(tmp_path / "a"), "--gltf", f"{tmp_path}/./a"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2
    assert "--bvh and --gltf both name" in done.output


@pytest.mark.parametrize("words", ["report a --out LONG", "process LONG --out x", "init LONG", "process / --out x"])
def test_what_the_system_refuses_is_one_error(words: str) -> None:
    done = rhot(*words.replace("LONG", 300 * "a").split())
    assert done.returncode in (1, 2)
    assert "rhot: error: " in done.stderr
    assert "Traceback" not in done.stderr


def test_an_output_that_is_closed_takes_anything() -> None:
    words = ["sh", "-c", f"{sys.executable} -m rhot --version >&-"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_init_makes_a_rig_that_doctor_understands(tmp_path: Path) -> None:
    assert rhot("init", str(tmp_path / "desk")).returncode == 0
    done = rhot("doctor", "--rig", str(tmp_path / "desk"), "--connect", NOBODY)
    assert done.returncode == 1, "without colours nothing can be found, which is BAD"
    assert "colors.json is missing" in done.stdout
    assert "rhot calibrate cameras" in done.stdout


@pytest.mark.parametrize("name", ['the "good" one', "a\\b", "two\nlines", "Übung", "\udcff"])
def test_init_takes_any_name_that_a_folder_may_have(tmp_path: Path, name: str) -> None:
    done = rhot("init", str(tmp_path / name))
    assert done.returncode == 0, done.stderr
    assert load_config(tmp_path / name).name == printable(name)


def test_output_in_an_encoding_that_lacks_a_character_shows_a_question_mark() -> None:
    code = (
        "import click\nfrom rhot.cli.group import MainGroup\n"
        "group = MainGroup(lazy={}, commands={'x': click.Command('x', callback=lambda: print('\\xb1 ms'))})\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", f"{code}group.main(['x'])"],
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[:2] == [b"?", b"ms"]


def test_no_figure_is_cut_off_in_a_narrow_terminal() -> None:
    table = figures_table("service", "out /s", "late", "p50 ms", "p99 ms")
    table.add_row("capture/left", "119.9", "12345", "11.74", "123.31")
    stream = io.StringIO()
    Console(file=stream, width=24).print(table)
    assert "…" not in stream.getvalue()
    digits = [character for character in stream.getvalue() if character.isdigit()]
    assert sorted(digits) == sorted("50991199123451174" + "12331")


def every_command(group: click.Group, name: str = "rhot") -> Iterator[tuple[str, click.Command]]:
    context = click.Context(group)
    for part in group.list_commands(context):
        command = group.get_command(context, part)
        assert command is not None
        yield f"{name} {part}", command
        if isinstance(command, click.Group):
            yield from every_command(command, f"{name} {part}")


def test_no_option_takes_what_is_not_a_number_for_one() -> None:
    for name, command in every_command(main):
        for option in command.params:
            if isinstance(option.type, click.types.FloatParamType):
                for text in ("nan", "inf", "-inf"):
                    with pytest.raises(click.BadParameter):
                        option.type(text, option, None)
                        pytest.fail(f"{name} {option.opts[0]} {text} is taken")


def test_no_help_states_a_range_without_bounds() -> None:
    texts = {name: command.get_help(click.Context(command)) for name, command in every_command(main)}
    assert [name for name, text in texts.items() if "<=None" in text.replace(" ", "")] == []


def test_a_service_whose_packages_are_missing_says_what_to_install() -> None:
    code = "import sys; sys.modules['cv2'] = None\nfrom rhot.cli import main\nmain(['capture', '--help'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "pip install 'rhot[capture]'" in done.stderr


@pytest.mark.parametrize("role", ["ik", "objects", "bridge", "viewer"])
def test_roles_that_are_installed_without_opencv_load_without_it(role: str) -> None:
    code = f"import sys; sys.modules['cv2'] = None; import rhot_{role}.command"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_version_names_the_commit() -> None:
    done = rhot("--version")
    assert done.returncode == 0
    assert re.fullmatch(r"rhot \d+\.\d+\.\d+( \([0-9a-f]{7,}(-dirty)?\))?\n", done.stdout), done.stdout


def test_a_reader_that_goes_away_is_no_error_worth_a_traceback() -> None:
    done = subprocess.run(
        f"{sys.executable} -m rhot --help | true", shell=True, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stderr == ""


def test_an_interrupt_while_modules_load_shows_no_traceback() -> None:
    code = (
        "import sys\nfrom rhot.__main__ import run\n"
        "class Interrupted:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'click':\n            raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupted())\nrun()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_assignments_are_json_or_text() -> None:
    assert parse_assignments(("a=1", "b.c=true", "b.d=slow")) == {"a": 1, "b": {"c": True, "d": "slow"}}
    with pytest.raises(ConfigError, match="FIELD=VALUE"):
        parse_assignments(("a",))
    with pytest.raises(ConfigError, match="a has a value of its own already"):
        parse_assignments(("a=1", "a.b=2"))


def test_values_of_any_encoding_can_be_shown() -> None:
    assert plain_value(b'{"a":1}', "application/json") == {"a": 1}
    assert plain_value(b"\x81\xa1a\x01", "application/msgpack;X") == {"a": 1}
    assert plain_value(b"\xff\xd8", "image/jpeg") == {"encoding": "image/jpeg", "bytes": 2}
    assert "invalid" in plain_value(b"\xc1", "application/msgpack")
    assert json.loads(json_text(plain_value(b"\x81\xa1a\xc4\x01x", "application/msgpack"))) == {"a": "b'x'"}


def test_what_json_cannot_hold_is_named_and_ends_no_command() -> None:
    key_of_bytes = plain_value(b"\x81\xc4\x01a\x01", "application/msgpack")
    for value in (key_of_bytes, plain_value(b"[" * 100_000, "application/json")):
        assert "invalid" in json.loads(json_text(value))
    # How deep JSON may nest depends on Python's version.
    nested = plain_value(b"\x91" * 1000 + b"\x01", "application/msgpack")
    whole = json_text(nested) == "[" * 1000 + "1" + "]" * 1000
    assert "invalid" in json.loads(json_text(nested)) or (whole and sys.version_info >= (3, 12))


def test_tools_reach_the_router_of_the_rig(rig_folder: Path) -> None:
    bus = tool_bus(rig_folder, (), None)
    assert (bus.connect, bus.listen) == (("tcp/127.0.0.1:7447",), ()), "listening is the router's"
    assert tool_bus(rig_folder, ("tcp/10.0.0.1:7447,tcp/10.0.0.2:7447",), "desk").connect == (
        "tcp/10.0.0.1:7447",
        "tcp/10.0.0.2:7447",
    )
    text = (rig_folder / "rig.toml").read_text().replace('mode = "client"', 'mode = "router"')
    (rig_folder / "rig.toml").write_text(text)
    assert tool_bus(rig_folder, (), None).mode == "client"
