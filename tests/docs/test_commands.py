"""What the documents tell people to type is there."""

from __future__ import annotations

import re
from pathlib import Path

import click
import pytest

from rhot.cli.main import main

ROOT = Path(__file__).parents[2]
PAGES = ["README.md", "CONTRIBUTING.md", *sorted(str(file.relative_to(ROOT)) for file in (ROOT / "docs").rglob("*.md"))]


def commands(text: str) -> list[str]:
    """Return every `rhot …` that stands in a code block or between backticks, without what a comment says of it."""
    blocks = re.findall(r"```\w*\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    inline = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    found = [re.sub(r"^(\$ )?(sudo )?(/\S*/|docker compose .* exec \w+ )?", "", part) for part in lines + inline]
    return [re.split(r" #|  +| > ", part)[0] for part in found if part.startswith("rhot ")]


@pytest.mark.parametrize("page", PAGES)
def test_every_command_and_option_exists(page: str) -> None:
    for line in commands((ROOT / page).read_text(encoding="utf-8")):
        command: click.Command = main
        context = click.Context(main)
        words = line.split()[1:]
        while isinstance(command, click.Group) and words and re.fullmatch(r"[a-z][a-z-]*(\|[a-z][a-z-]*)*", words[0]):
            found = [command.get_command(context, name) for name in words[0].split("|")]
            assert all(found), line
            command, words = found[-1] or main, words[1:]
        known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        asked = {word.partition("=")[0] for word in words if word.startswith("--")}
        assert asked <= known | {"--help", "--version"}, f"{line}: {command.name} has no {asked - known}"
