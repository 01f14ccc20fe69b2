from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from rhot.errors import ConfigError
from rhot_tools.measures.output import html_report
from rhot_tools.measures.rows import Row, Section, as_json, check_output, missed, section_table

NAN = float("nan")
ROWS = (
    Row("error [median]", 1.234, "mm", most=1.5, peer="thesis: 5 mm", note="of 7 points"),
    Row("ratio", 1.2, "×", least=1.5),
    Row("lag", NAN, "ms", most=4.0),
    Row("count", 1234.0),
    Row("swaps", 0, most=0),
)


def test_verdicts() -> None:
    assert [row.verdict for row in ROWS] == ["met", "missed", "not measured", "", "met"]
    assert [row.target for row in ROWS] == ["≤ 1.5", "≥ 1.5", "≤ 4", "", "≤ 0"]
    assert [row.text for row in ROWS] == ["1.23 mm", "1.2 ×", "–", "1234", "0"]
    assert missed([Section("all", ROWS)]) == 1


def test_table_shows_every_row_verdict_and_note() -> None:
    out = io.StringIO()
    Console(width=120, file=out).print(section_table(Section("Points", ROWS)))
    text = out.getvalue()
    for word in ("Points", "error [median] [1]", "1.23 mm", "met", "missed", "not measured", "thesis: 5 mm"):
        assert word in text
    assert "[1] of 7 points" in text


def test_json_holds_null_for_what_was_not_measured() -> None:
    document = json.loads(as_json("bench", [Section("Points", ROWS)], quick=True))
    assert document["command"] == "bench"
    assert document["quick"] is True
    rows = document["sections"][0]["rows"]
    assert [row["value"] for row in rows] == [1.234, 1.2, None, 1234.0, 0]
    assert rows[1]["verdict"] == "missed"


def test_html_escapes() -> None:
    text = html_report("a < b", "c & d", [Section("<script>", ROWS)], ["<svg/>"])
    assert "<script>" not in text
    assert "a &lt; b" in text
    assert text.count("<tr>") == len(ROWS) + 1


def test_output_into_no_folder_is_refused(tmp_path: Path) -> None:
    check_output("--json", tmp_path / "a.json")
    check_output("--json", None)
    with pytest.raises(ConfigError, match=r"--json .*does not exist"):
        check_output("--json", tmp_path / "nowhere" / "a.json")
