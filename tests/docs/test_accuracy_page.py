"""Nobody types a figure by hand: the page and the README's table are what the command writes from the results."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rhot_bench.accuracy_page import HEADLINES, accuracy_page, load_results, with_headlines

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
RENEW = "run rhot evaluate page docs/results --out docs/accuracy.md --readme README.md"


def test_the_page_is_what_the_results_give() -> None:
    page = accuracy_page(load_results(RESULTS))
    assert (ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8") == page, RENEW
    assert len(page.split()) <= 1500


def test_the_headlines_are_what_the_results_give() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert with_headlines(readme, load_results(RESULTS), "docs/accuracy.md") == readme, RENEW
    assert len(HEADLINES) == 8


def test_a_stranger_finishes_the_readme() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 1300


def test_results_stay_small() -> None:
    assert all(file.stat().st_size < 40_000 for file in RESULTS.iterdir())


@pytest.mark.parametrize(
    "page", ["README.md", "CONTRIBUTING.md", *sorted(f"docs/{p.name}" for p in (ROOT / "docs").glob("*.md"))]
)
def test_links_lead_somewhere(page: str) -> None:
    file = ROOT / page
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", file.read_text(encoding="utf-8"))
    missing = [link for link in links if not link.startswith("http") and not (file.parent / link).exists()]
    assert missing == []


def test_the_map_of_the_code_names_what_is_there() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    paths = re.findall(r"`((?:common|services|calibration|simulation|bench)/[\w./]*)`", text)
    assert len(paths) > 10
    assert [path for path in paths if not (ROOT / path).exists()] == []
