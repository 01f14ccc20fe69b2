"""`rhot evaluate motion` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from rhot.errors import ConfigError
from rhot_bench.motion.command import motion


def test_one_rig_gives_every_table_and_is_repeatable(shared_data: Path, tmp_path: Path) -> None:
    documents = []
    for name in ("a.json", "b.json"):
        arguments = [
            str(shared_data),
            "--rigs",
            "1",
            "--seconds",
            "1",
            "--stratum",
            "30",
            "--json",
            str(tmp_path / name),
        ]
        result = CliRunner().invoke(motion, arguments, catch_exceptions=False)
        assert result.exit_code == 0
        documents.append(json.loads((tmp_path / name).read_text()))
    assert documents[0]["sections"] == documents[1]["sections"]
    titles = [section["title"].split(":")[0] for section in documents[0]["sections"]]
    assert titles == ["Points live", "Points smoothed", "Hand"]


def test_a_wrong_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no recorded hands"):
        CliRunner().invoke(motion, [str(tmp_path)], catch_exceptions=False)
