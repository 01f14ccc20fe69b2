"""What `rhot replay` refuses before it asks for a router."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner
from hand_messages import marker_frame, point_set

from rhot.errors import ConfigError
from rhot.messages import encode, encoding_of
from rhot.recording.mcap.writer import McapWriter
from rhot_tools.recordings.replay import replay


@pytest.fixture
def file(tmp_path: Path) -> Path:
    file = tmp_path / "take.mcap"
    with McapWriter(file, now_ns=0) as writer:
        for key, message in (("rhot/markers/left", marker_frame("left", 5)), ("rhot/points", point_set(5))):
            writer.write(key, encoding_of(type(message)), encode(message), 5, 0, 5)
    return file


def test_a_kind_that_is_not_there_is_told(file: Path) -> None:
    with pytest.raises(ConfigError, match=r"--only hand: nothing of that; it holds rhot/markers/left, rhot/points"):
        CliRunner().invoke(replay, [str(file), "--only", "markers", "--only", "hand"], catch_exceptions=False)
    with pytest.raises(ConfigError, match="--only points"):
        CliRunner().invoke(replay, [str(file), "--keys", "rhot/markers/*", "--only", "points"], catch_exceptions=False)


@pytest.mark.parametrize("options", [["--step", "--now"], ["--step", "--loop"], ["--from", "2", "--to", "1"]])
def test_options_that_contradict_each_other(file: Path, options: list[str]) -> None:
    result = CliRunner().invoke(replay, [str(file), *options])
    assert result.exit_code == 2
    assert "Usage" in result.output
