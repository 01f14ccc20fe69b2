from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import click
import pytest

from rhot.errors import ConfigError
from rhot_bench.accuracy_page import HEADLINES, Part, accuracy_page, load_results, page, with_headlines
from rhot_tools.measures.output import show
from rhot_tools.measures.rows import Row, Section

Invoke = Callable[..., str]

ROWS = (
    Row("error | all", 1.234, "mm", most=1.0, peer="thesis: 5 mm", note="of 7 points"),
    Row("    worst", float("nan"), "mm", most=2.0),
)
README = "# R\n<!-- headlines: written by `rhot evaluate page`, do not edit -->\nold\n<!-- end of headlines -->\nend\n"


@click.command()
@click.option("--count", default=1)
@click.option("--quick", is_flag=True)
@click.argument("words", nargs=-1)
@click.option("--json", "json_path", type=click.Path(path_type=Path))
def measure(count: int, quick: bool, words: tuple[str, ...], json_path: Path) -> None:
    """Stand in for a measuring command."""
    show("evaluate anything", [Section("Points", ROWS)], json_path, quick=quick)


@pytest.fixture
def results(invoke: Invoke, tmp_path: Path) -> Path:
    invoke(measure, "--quick", "a b", "--json", tmp_path / "anything.json")
    return tmp_path


def test_every_file_of_figures_says_where_it_comes_from(results: Path) -> None:
    run = json.loads((results / "anything.json").read_text())["run"]
    assert run["command_line"] == "measure --quick 'a b'"
    assert run["machine"]["cores"] >= 1
    assert run["machine"]["cpu"]
    assert run["versions"]["numpy"]
    assert run["date"].startswith("20")


ABOUT = Part("anything", "What it is about.", (("Points", "both", ("error | all", "worst")),))


def test_page_holds_its_figures_with_command_day_and_machine(results: Path) -> None:
    text = accuracy_page(load_results(results), [ABOUT])
    run = load_results(results)["anything"].run
    for expected in (
        "## rhot evaluate anything",
        "measure --quick 'a b'",
        run.date[:10],
        run.machine.cpu,
        "What it is about.",
        "| both: error \\| all | 1.23 mm | ≤ 1 **missed** | thesis: 5 mm |",
        "| both: worst | – | ≤ 2 |  |",
    ):
        assert expected in text


def test_a_figure_that_is_not_there_is_named(results: Path) -> None:
    with pytest.raises(ConfigError, match="hold no figure 'gone' under 'Points'"):
        accuracy_page(load_results(results), [Part("anything", "", (("Points", "both", ("gone",)),))])


def test_page_takes_files_of_commands_that_it_does_not_know(results: Path) -> None:
    file = results / "anything.json"
    document = json.loads(file.read_text())
    document["sections"][0]["plot"] = [1, 2]
    file.write_text(json.dumps(document | {"command": "evaluate pictures", "sequences": ["G1"]}))
    assert "## rhot evaluate pictures" in accuracy_page(load_results(results), [ABOUT])


def test_wrong_folders_and_files_are_refused(invoke: Invoke, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"holds no \*\.json"):
        invoke(page, tmp_path, "--out", tmp_path / "page.md")
    (tmp_path / "a.json").write_text('{"version": 1, "command": "bench", "sections": []}')
    with pytest.raises(ConfigError, match=r"a\.json: .*run"):
        invoke(page, tmp_path, "--out", tmp_path / "page.md")


def test_headlines_that_are_not_there_are_named(results: Path) -> None:
    with pytest.raises(ConfigError, match="do not edit"):
        with_headlines("# no comments", load_results(results), "docs/accuracy.md")
    with pytest.raises(ConfigError, match=f"{HEADLINES[0].file}.json is missing"):
        with_headlines(README, load_results(results), "docs/accuracy.md")
