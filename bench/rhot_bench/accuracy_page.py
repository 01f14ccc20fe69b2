"""`rhot evaluate page`: generate the accuracy page and the README's headline figures from result files."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import click
from pydantic import BaseModel, ConfigDict

from rhot.errors import ConfigError
from rhot.rig.folder import read_json_model, write_text_atomic
from rhot_tools.measures.rows import Row, check_output

# Files of figures, as the measuring commands leave them with `--json`.


class _Model(BaseModel):
    """Part of a file; commands may say more than is read here."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Machine(_Model):
    """What the figures were measured on; see `rhot_tools.measures.provenance`."""

    cpu: str
    cores: int
    system: str
    load: float | None = None


class Run(_Model):
    """Where the figures come from; see `rhot_tools.measures.provenance`."""

    command_line: str
    date: str
    machine: Machine
    versions: dict[str, str | None]
    commit: str | None = None


class Figure(_Model):
    """One figure; see `rhot_tools.measures.rows.Row`. None = could not be measured."""

    name: str
    value: float | None
    unit: str = ""
    most: float | None = None
    least: float | None = None
    peer: str = ""
    note: str = ""

    @property
    def row(self) -> Row:
        """The figure as it is shown."""
        value = math.nan if self.value is None else self.value
        return Row(self.name, value, self.unit, self.most, self.least, self.peer, self.note)


class Table(_Model):
    """Figures that belong together."""

    title: str
    rows: tuple[Figure, ...]


class Results(_Model):
    """Everything one run of a command measured."""

    version: Literal[1]
    command: str
    run: Run
    sections: tuple[Table, ...]


def load_results(folder: Path) -> dict[str, Results]:
    """Return every file of figures in a folder by its name without `.json`, in order of names.

    Raises:
        ConfigError: there is none, or one is not what the measuring commands write.
    """
    files = sorted(folder.glob("*.json")) if folder.is_dir() else []
    if not files:
        raise ConfigError(f"{folder}: holds no *.json; make some with `rhot bench --json {folder}/bench.json`")
    return {file.stem: read_json_model(file, Results, ConfigError) for file in files}


_BEGIN: Final = "<!-- headlines: written by `rhot evaluate page`, do not edit -->"
_END: Final = "<!-- end of headlines -->"
_INTRODUCTION: Final = """\
# Accuracy and speed

What holds today, the strictest measurement first. Generated from the files in `docs/results`, which hold every
other figure too; do not edit it by hand:

```
{command}
```

To measure on your own machine, run the command of a section with `--json FILE`; `rhot evaluate rig` measures your own
rig. *For comparison* gives the same figure for the thesis of 2018 or 2021, for another tracker, or for a plain filter
on the same input. Missed targets are marked. *Load* above the number of cores means that other programs ran too.
[tested.md](tested.md) says what no test has met yet.
"""


@dataclass(frozen=True, slots=True)
class Part:
    """One section of the page.

    Attributes:
        file: name of the results file, without `.json`.
        about: what was measured.
        figures: first words of a table's title, what the page calls it, and the names of its figures.
    """

    file: str
    about: str
    figures: tuple[tuple[str, str, tuple[str, ...]], ...]


PARTS: Final = (
    Part(
        "motion",
        "Recorded hands before 30 random rigs that were never used to choose anything: other cameras, paints, patches, "
        "hands, calibration errors; fingers and objects hide the paint. No picture is searched: tracks are ideal.",
        (
            (
                "Points live: 60",
                "60 fps, live",
                (
                    "tips in two views, after 0.5 s, median",
                    "tips in two views, after 0.5 s, p95",
                    "within two stated sigma",
                    "rigs with a swap",
                    "rigs with a point 50 mm off",
                ),
            ),
            (
                "Points smoothed: 60",
                "60 fps, smoothed",
                ("tips in two views, median", "tips in two views, p95"),
            ),
            (
                "Hand: 60",
                "60 fps, hand",
                (
                    "live, tips in one view, median",
                    "live, tips hidden longer, in a grasp, median",
                    "live, 26 joints, all tips in two views, mean",
                    "live, 26 joints, two to five hidden in a grasp, mean",
                    "smooth, 26 joints, at any time, mean",
                ),
            ),
            (
                "Points live: 30",
                "30 fps, live",
                ("tips in two views, after 0.5 s, median", "tips in two views, after 0.5 s, p95", "coverage"),
            ),
        ),
    ),
    Part(
        "pictures",
        "Photo-real pictures of another rig and hand, calibrated by our own commands from their chessboards, colours "
        "and two ruler measures.",
        tuple(
            (
                title,
                name,
                (
                    "live, nothing removed, median",
                    "live, nothing removed, p95",
                    "live, joints, mean",
                    "live, coverage",
                    "smooth, nothing removed, p95",
                ),
            )
            for title, name in (("G1", "gestures, 60 fps"), ("G2", "grasp, 30 fps"))
        ),
    ),
    Part(
        "hands",
        "Joints between wrist and fingertips of recorded hands, from exact wrist and tips.",
        (
            ("MSRA14", "MSRA14", ("PIP and DIP, palm given, mean", "PIP and DIP, from wrist and tips alone, mean")),
            ("NYU", "NYU", ("PIP, mean",)),
            ("FPHA", "FPHA, three people", ("person 1, MCP, PIP and DIP, mean", "person 2, MCP, PIP and DIP, mean")),
        ),
    ),
    Part(
        "streams",
        "The marker streams that the original rig recorded in 2018: whole pixels, glitches, lost frames, a mount that "
        "had turned. There is no truth, so jitter, delay and coverage are measured.",
        (
            (
                "hand_as_sent",
                "as sent",
                (
                    "noise at rest, in depth, median",
                    "points that are measured",
                    "glitches published as measured",
                ),
            ),
        ),
    ),
    Part(
        "steps",
        "Real foot sensors (dead reckoning against motion capture).",
        (
            (
                "Dead reckoning, 200 Hz, force and rate",
                "200 Hz",
                (
                    "off on average, 7 trials",
                    "its worst trial",
                    "published: the best detector, tuned to each trial",
                    "SHOE, one threshold for all",
                ),
            ),
            ("Dead reckoning, 100 Hz, as a BNO080 sends it", "100 Hz", ("off on average, 7 trials", "its worst trial")),
        ),
    ),
    Part(
        "feet",
        "A simulated walker, with the tests of the 2021 thesis.",
        (
            (
                "The 2021 thesis's tests",
                "tests",
                (
                    "standing still, average",
                    "marker moving, average",
                    "sudden move, average",
                ),
            ),
            ("Time", "time", ("latency, p99",)),
        ),
    ),
    Part(
        "tracking",
        "Our own simulator: the easiest of these worlds, since it knows what the tracker assumes.",
        (
            ("Points, slow", "slow", ("fingertip position, median", "fingertip position, p95")),
            ("Trust", "slow", ("identity swaps", "false points")),
            ("Static jitter", "still", ("sideways, worst marker", "in depth, worst marker")),
            ("Points, the same motion", "3 times as fast", ("lag at 1 m/s", "false points")),
        ),
    ),
    Part(
        "bench",
        "Cost and latency, the thesis's algorithms in the same run. No part has been timed on a Raspberry Pi.",
        (
            (
                "Capture: one",
                "capture",
                ("tracked, ours / thesis, medians", "searched, ours / thesis, medians"),
            ),
            ("Fusion: six", "fusion", ("one camera frame, filter, median",)),
            ("Inverse", "ik", ("whole hand from a point set, median",)),
            (
                "Live: 2 cameras",
                "live, 2 cameras",
                (
                    "picture in memory to hand at the reader, p50",
                    "picture in memory to hand at the reader, p99",
                ),
            ),
            ("Bridges", "bridges", ("from the bus to the wire, vmc alone, p99", "processor time of all four together")),
        ),
    ),
)


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
    Headline(
        "30 unseen rigs, live: fingertip, median", "motion", "Points live: 60", "tips in two views, after 0.5 s, median"
    ),
    Headline(
        "30 unseen rigs, live: fingertip, p95", "motion", "Points live: 60", "tips in two views, after 0.5 s, p95"
    ),
    Headline(
        "30 unseen rigs, live: 26 joints, mean", "motion", "Hand: 60", "live, 26 joints, all tips in two views, mean"
    ),
    Headline("photo-real grasp: fingertips, median", "pictures", "G2", "live, nothing removed, median"),
    Headline("photo-real gestures: 21 joints, mean", "pictures", "G1", "live, joints, mean"),
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

    RESULTS is a folder of such files.

    \b
    rhot evaluate hands DATA --json docs/results/hands.json
    rhot evaluate page docs/results --out docs/accuracy.md --readme README.md
    """
    check_output("--out", out_path)
    results = load_results(results_path)
    write_text_atomic(out_path, accuracy_page(results))
    click.echo(f"{out_path}: {len(results)} files of figures")
    if readme_path is not None:
        link = os.path.relpath(out_path.resolve(), readme_path.resolve().parent)
        write_text_atomic(readme_path, with_headlines(readme_path.read_text(encoding="utf-8"), results, link))
        click.echo(f"{readme_path}: {len(HEADLINES)} headline figures")


def accuracy_page(results: Mapping[str, Results], parts: Sequence[Part] = PARTS) -> str:
    """Return the page as Markdown, of the results files by name.

    Raises:
        ConfigError: a figure of the parts is missing from the results that are there.
    """
    command = "rhot evaluate page docs/results --out docs/accuracy.md --readme README.md"
    sections = [
        f"## {_heading(result)}\n\n{part.about}\n\n{_origin(result)}\n\n{_table(part, result)}"
        for part in parts
        if (result := results.get(part.file)) is not None
    ]
    return "\n".join([_INTRODUCTION.format(command=command), *sections])


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
    if result is None:
        raise ConfigError(f"{headline.file}.json is missing: it holds {headline.row!r}")
    row = _row(result, headline.section, headline.row)
    target = f"{row.target} ({row.verdict})" if row.verdict == "missed" else row.target
    return headline.label, row.text, target, row.peer, f"[`{_heading(result)}`]({link}#{_anchor(_heading(result))})"


def _row(result: Results, title: str, name: str) -> Row:
    """Return a figure by the first words of its table's title and its own name."""
    for section in result.sections:
        for figure in section.rows:
            if section.title.startswith(title) and figure.name.strip() == name:
                return figure.row
    raise ConfigError(f"the results of `{result.command}` hold no figure {name!r} under {title!r}")


def _heading(result: Results) -> str:
    return f"rhot {result.command.removeprefix('rhot ')}"


def _origin(result: Results) -> str:
    run = result.run
    return f"```\n{run.command_line}\n```\n\n{_day(result)}; {_machine(result)}; commit {run.commit or 'unknown'}."


def _day(result: Results) -> str:
    return result.run.date.partition("T")[0]


def _machine(result: Results) -> str:
    machine = result.run.machine
    busy = "" if machine.load is None else f", load {machine.load:.1f}"
    return f"{machine.cpu}, {machine.cores} cores{busy}"


def _table(part: Part, result: Results) -> str:
    found = [(called, [_row(result, title, name) for name in names]) for title, called, names in part.figures]
    columns = ["figure", "value", "target", "for comparison"]
    columns = columns if any(row.peer for _, rows in found for row in rows) else columns[:-1]
    lines = []
    for called, rows in found:
        for row in rows:
            verdict = f"{row.target} **missed**" if row.verdict == "missed" else row.target
            cells = f"{called}: {row.name.strip()}", row.text, verdict, row.peer
            lines.append(cells[: len(columns)])
    return _lines(columns, lines)


def _lines(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    head = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    return "\n".join([*head, *(f"| {' | '.join(map(_cell, row))} |" for row in rows)]) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;")


def _anchor(heading: str) -> str:
    """Return GitHub's anchor for a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
