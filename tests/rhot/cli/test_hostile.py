"""A stranger's names and texts end no command and reach no terminal unescaped."""

from __future__ import annotations

import asyncio
import sys

import pytest
from bus_watch import PATIENCE_S, settled

from rhot.bus import Answer, Bus, Request, message_answer
from rhot.errors import ConfigError
from rhot.messages import ServiceStatus
from rhot.rig import BusConfig

HOSTILE = "\x1b[2J\x1b]0;owned\x07\nroot: all is well \x9b31m"
KEYS = ("rhot/alive/x/[/red]", f"rhot/alive/x/{HOSTILE}")


def refuse(request: Request) -> Answer:
    raise ConfigError(f"[/red] {HOSTILE}")


def status(request: Request) -> Answer:
    text = f"[/red] [bold] {HOSTILE}"
    honest = ServiceStatus(t_ns=1, service="x", instance="y", state="running")
    return message_answer(honest.model_copy(update={"problem": text, "last_error": text, "session": HOSTILE}), request)


async def rhot(*arguments: str) -> tuple[int | None, str]:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "rhot",
        *arguments,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env={"TERM": "xterm-256color", "COLUMNS": "200", "PATH": "/nonexistent"},
    )
    output, _ = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    return process.returncode, output.decode()


@pytest.mark.parametrize(
    ("command", "code"),
    [
        (("status",), 0),
        (("status", "--json"), 0),
        (("get", "rhot/**"), 0),
        (("get", "rhot/config/x/y"), 1),
        (("stop",), 1),  # who claims to be there did not take it
        (("doctor", "--rig", "/nonexistent"), 1),
    ],
)
async def test_no_command_ends_by_a_strangers_words_or_shows_them_raw(
    router: BusConfig, command: tuple[str, ...], code: int
) -> None:
    async with await Bus.open(router) as stranger:
        for key in KEYS:
            stranger.alive(key)
            stranger.queryable(key.replace("alive", "status"), status)
        stranger.queryable("rhot/status/x/y", status)
        stranger.queryable("rhot/config/x/y", refuse)
        await settled(stranger)
        ended, output = await rhot(*command, "--connect", router.connect[0])
    assert "Traceback" not in output
    assert "MarkupError" not in output
    assert ended == code, output
    assert not set(output) & {"\x1b", "\x07", "\x9b"}, output
    assert not any(line.startswith("root:") for line in output.splitlines())


@pytest.mark.parametrize("key", ["", "/rhot", "rhot//x"])
async def test_a_key_that_cannot_be_is_quoted_as_it_was_typed(router: BusConfig, key: str) -> None:
    ended, output = await rhot("get", key, "--connect", router.connect[0])
    assert ended == 1
    assert output.startswith(f"rhot: error: {key}: ")
    assert "format=json" not in output
