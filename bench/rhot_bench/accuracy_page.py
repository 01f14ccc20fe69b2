"""`rhot evaluate page`: generate the accuracy page and the README's headline figures from result files."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click

from rhot.errors import ConfigError
from rhot.rig.folder import write_text_atomic
from rhot_bench.measures.rows import check_output
from rhot_bench.results import Results, Table, load_results

_BEGIN: Final = "<!-- headlines: written by `rhot evaluate page`, do not edit -->"
_END: Final = "<!-- end of headlines -->"
_INTRODUCTION: Final = """\
# Accuracy and speed

This page is generated from the files in [results](results); do not edit it by hand:

```
{command}
```

Each section gives the command, date and machine of its measurement. To measure on your own machine, run
`pip install 'rhot[bench]'` and the same command with `--json FILE`.

*Load* is the load average over the last minute, including the measurement itself. If it exceeds the number of cores,
other programs were running too, and times are longer than on an idle machine. *For comparison* gives the same figure
for the 2018 or 2021 thesis or for another tracker. Missed targets are marked. [tested.md](tested.md) lists figures that
tests assert, and older ones that were measured by hand.
"""


@dataclass(frozen=True, slots=True)
class Headline:
    """A figure shown in the README.

    Attributes:
        label: its name in the README.
        file: name of the results file, without `.json`.
        section: first words of the table's title.
        row: name of the figure.
    """

    label: str
    file: str
    section: str
    row: str


HEADLINES: Final = (
    Headline("simulated: fingertip, median", "tracking", "Points, slow", "fingertip position, median"),
    Headline("simulated: fingertip, p95", "tracking", "Points, slow", "fingertip position, p95"),
    Headline("photo-real grasp: fingertips, median", "pictures", "G2", "live, nothing removed, median"),
    Headline("photo-real gestures: 21 joints, mean", "pictures", "G1", "live, joints, mean"),
    Headline("simulated: false points, fast hand, 15 s", "tracking", "Points, the same motion", "false points"),
    Headline("real hands: PIP and DIP joints", "hands", "MSRA14", "PIP and DIP, from wrist and tips alone, mean"),
    Headline("real foot sensors: dead reckoning", "steps", "Dead reckoning, 200", "off on average, 7 trials"),
    Headline("cost per camera frame, relative to the thesis", "bench", "Capture", "tracked, ours / thesis, medians"),
)


@click.command()
@click.argument("results_path", metavar="RESULTS", type=click.Path(path_type=Path, file_okay=False))
@click.option(
    "--out",
    "out_path",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    help="Page to write, as Markdown.",
)
@click.option(
    "--readme",
    "readme_path",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="README whose table of headline figures to update.",
)
def page(results_path: Path, out_path: Path, readme_path: Path | None) -> None:
    """Generate a page from the results that `rhot evaluate …` and `rhot bench` wrote with --json.

    RESULTS is a folder of such files. If there is a NAME.md beside NAME.json, it introduces that section.

    \b
    rhot evaluate hands DATA --json docs/results/hands.json
    rhot evaluate page docs/results --out docs/accuracy.md --readme README.md
    """  # noqa: D301 (click reads \b as "keep these lines")
    check_output("--out", out_path)
    results = load_results(results_path)
    write_text_atomic(out_path, accuracy_page(results, introductions(results_path, results)))
    click.echo(f"{out_path}: {len(results)} files of figures")
    if readme_path is not None:
        link = os.path.relpath(out_path.resolve(), readme_path.resolve().parent)
        write_text_atomic(readme_path, with_headlines(readme_path.read_text(encoding="utf-8"), results, link))
        click.echo(f"{readme_path}: {len(HEADLINES)} headline figures")


def introductions(folder: Path, results: Mapping[str, Results]) -> dict[str, str]:
    """Return the contents of NAME.md for each results file NAME.json that has one."""
    files = {name: folder / f"{name}.md" for name in results}
    return {name: file.read_text(encoding="utf-8").strip() for name, file in files.items() if file.exists()}


def accuracy_page(results: Mapping[str, Results], texts: Mapping[str, str]) -> str:
    """Return the page as Markdown.

    Args:
        results: results files by name.
        texts: introductions by the same names; may be incomplete.
    """
    command = "rhot evaluate page docs/results --out docs/accuracy.md --readme README.md"
    parts = [_INTRODUCTION.format(command=command), _overview(results)]
    for name, result in results.items():
        parts.append(f"## {_heading(result)}\n\n{_origin(result)}\n")
        if name in texts:
            parts.append(f"{texts[name]}\n")
        parts += [_table(section) for section in result.sections]
    return "\n".join(parts)


def with_headlines(readme: str, results: Mapping[str, Results], link: str) -> str:
    """Return the README with an updated table of headline figures.

    Args:
        readme: its text, with the two comments that enclose the table.
        results: results files by name.
        link: relative link from the README to the accuracy page.

    Raises:
        ConfigError: a comment or a headline figure is missing.
    """
    begin, end = readme.find(_BEGIN), readme.find(_END)
    if not 0 <= begin < end:
        raise ConfigError(f"the README must contain {_BEGIN} followed by {_END}")
    table = _lines(
        ("figure", "value", "target", "for comparison", "measured by"),
        [_headline(headline, results, link) for headline in HEADLINES],
    )
    return f"{readme[: begin + len(_BEGIN)]}\n{table}{readme[end:]}"


def _headline(headline: Headline, results: Mapping[str, Results], link: str) -> Sequence[str]:
    result = results.get(headline.file)
    rows = [
        figure.row
        for section in (result.sections if result else ())
        for figure in section.rows
        if section.title.startswith(headline.section) and figure.name == headline.row
    ]
    if result is None or not rows:
        raise ConfigError(f"{headline.file}.json holds no figure {headline.row!r} under {headline.section!r}")
    row = rows[0]
    target = f"{row.target} ({row.verdict})" if row.verdict == "missed" else row.target
    return headline.label, row.text, target, row.peer, f"[`{_heading(result)}`]({link}#{_anchor(_heading(result))})"


def _overview(results: Mapping[str, Results]) -> str:
    rows = []
    for result in results.values():
        verdicts = [figure.row.verdict for section in result.sections for figure in section.rows]
        targets = sum(bool(verdict) for verdict in verdicts)
        missed = f"{verdicts.count('missed')} of {targets}" if targets else "no targets"
        heading = _heading(result)
        rows.append((f"[{heading}](#{_anchor(heading)})", _day(result), _machine(result), missed))
    return _lines(("command", "date", "machine", "targets missed"), rows)


def _heading(result: Results) -> str:
    return f"rhot {result.command.removeprefix('rhot ')}"


def _origin(result: Results) -> str:
    run = result.run
    versions = ", ".join(f"{name} {version}" for name, version in run.versions.items() if version)
    return (
        f"```\n{run.command_line}\n```\n\n"
        f"{_day(result)}; {_machine(result)}, {run.machine.system}; {versions}; commit {run.commit or 'unknown'}."
    )


def _day(result: Results) -> str:
    return result.run.date.partition("T")[0]


def _machine(result: Results) -> str:
    machine = result.run.machine
    busy = "" if machine.load is None else f", load {machine.load:.1f}"
    return f"{machine.cpu}, {machine.cores} cores{busy}"


def _table(section: Table) -> str:
    rows = [figure.row for figure in section.rows]
    notes = list(dict.fromkeys(row.note for row in rows if row.note))
    columns = ["figure", "value", "target", ""]
    columns += ["for comparison"] if any(row.peer for row in rows) else []
    lines = [
        (
            f"{_indented(row.name)}{f' [{notes.index(row.note) + 1}]' if row.note else ''}",
            row.text,
            row.target,
            f"**{row.verdict}**" if row.verdict == "missed" else row.verdict,
            row.peer,
        )[: len(columns)]
        for row in rows
    ]
    below = "".join(f"\n[{number}] {_cell(note)}  " for number, note in enumerate(notes, start=1))
    return f"### {section.title}\n\n{_lines(columns, lines)}{below}\n".rstrip() + "\n"


def _indented(name: str) -> str:
    """Replace leading spaces, which Markdown drops, with a dash."""
    return f"– {name.strip()}" if name.startswith(" ") else name


def _lines(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    head = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    return "\n".join([*head, *(f"| {' | '.join(map(_cell, row))} |" for row in rows)]) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def _anchor(heading: str) -> str:
    """Return GitHub's anchor for a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
