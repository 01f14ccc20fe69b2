"""`rhot explain`: a page with detection, filter and hand at one moment of a recording."""

from __future__ import annotations

import base64
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from simulated_take import simulated_rig, write_take

from rhot.errors import ConfigError
from rhot.recording import PictureTrack, load_recording
from rhot_tools.explain.command import explain
from rhot_tools.recordings.beside import between, newest, time_span

LENGTH_S = 1.2


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `take.mcap`, its pictures in `take` and the rig in `rig`."""
    folder = tmp_path_factory.mktemp("explain")
    write_take(simulated_rig(folder / "rig"), folder / "take.mcap", 8.6, 8.6 + LENGTH_S, pictures=True)
    return folder


def page_of(out: Path, *arguments: str) -> str:
    result = CliRunner().invoke(explain, [*arguments, "--out", str(out)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert result.output.startswith(f"{out}: "), "its name as it is, whatever brackets mean to a terminal's markup"
    return out.read_text()


def rows_of(page: str, title: str) -> list[list[str]]:
    """The cells of a table."""
    table = page.partition(f"<h2>{title}")[2].partition("</table>")[0]
    return [re.findall(r"<td>(.*?)</td>", row) for row in table.split("<tr")[2:]]


def test_a_moment_of_a_live_recording(take: Path, tmp_path: Path) -> None:
    page = page_of(tmp_path / "[bold]page.html", str(take / "take.mcap"), "--at", "1.0")
    pictures = re.findall(r"data:image/jpeg;base64,([^']+)'", page)
    assert len(pictures) == 2
    image = cv2.imdecode(np.frombuffer(base64.b64decode(pictures[0]), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (480, 640, 3)
    assert not re.search(r"(src|href)='https?:", page), "nothing is loaded from elsewhere"
    assert [row[0] for row in rows_of(page, "Summary")] == ["thumb", "index", "middle", "ring", "little", "base"]
    recomputed = {row[0]: float(row[2]) for row in rows_of(page, "Published messages")}
    assert set(recomputed) == {"rhot/hand/right", "rhot/points"}
    assert max(recomputed.values()) < 0.001, "the same stages on the same markers give the same result, mm"
    gates = rows_of(page, "Gates")
    assert {row[0] for row in gates} == {"left", "right"}
    assert all(float(row[6]) <= 5.0 for row in gates if row[-1] == "accepted"), "standard deviations"
    assert all(float(row[6]) >= 5.0 for row in gates if row[-1] == "rejected")
    assert len(rows_of(page, "Filter")) == 6
    assert len(rows_of(page, "Hand right: angles")) == 20
    assert page.count("<polyline") >= 8


def test_a_short_lead_changes_the_result(take: Path, tmp_path: Path) -> None:
    page = page_of(tmp_path / "page.html", str(take / "take.mcap"), "--at", "1.0", "--lead", "0.1")
    assert any(
        row[2] == "not computed for that time" or float(row[2]) > 0.1 for row in rows_of(page, "Published messages")
    )


def test_pictures_alone_and_a_time_on_the_rig_clock(take: Path, tmp_path: Path) -> None:
    first_ns, _ = time_span(load_recording(take / "take"))
    rig = ["--rig", str(take / "rig")]
    page = page_of(tmp_path / "a.html", str(take / "take"), "--at", "1.0", *rig)
    assert "Published messages" not in page
    assert len(rows_of(page, "Candidates in left")) >= 6
    same = page_of(tmp_path / "b.html", str(take / "take"), "--at", str(first_ns + 10**9), *rig)
    assert same == page


def test_a_time_of_pictures_whose_clock_does_not_count_from_1970(take: Path, tmp_path: Path) -> None:
    first_ns, _ = time_span(load_recording(take / "take"))
    shutil.copytree(take / "take", tmp_path / "take")
    for file in (tmp_path / "take").glob("*/timestamps.csv"):
        head, *rows = file.read_text().splitlines()
        shifted = [f"{frame},{int(t_ns) - first_ns + 210 * 10**9}" for frame, t_ns in (row.split(",") for row in rows)]
        file.write_text("\n".join((head, *shifted)) + "\n")
    page = page_of(tmp_path / "a.html", str(tmp_path / "take"), "--at", "211000000000", "--rig", str(take / "rig"))
    assert len(rows_of(page, "Candidates in left")) >= 6


def test_markers_are_drawn_without_pictures(take: Path, tmp_path: Path) -> None:
    shutil.copy(take / "take.mcap", tmp_path / "alone.mcap")
    page = page_of(tmp_path / "page.html", str(tmp_path / "alone.mcap"), "--at", "1.0")
    assert "data:image" not in page
    assert "No picture was recorded" in page
    assert "<path d=" in page


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["take.mcap", "--at", "99"], "no marker frame within a second before --at 99"),
        (["take", "--at", "99", "--rig", "rig"], "outside the recording"),
        (["none.mcap", "--at", "1"], "no such recording"),
        (["rig/rig.toml", "--at", "1"], "not an MCAP file"),
    ],
)
def test_what_cannot_be_explained_is_an_error(
    take: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    monkeypatch.chdir(take)
    with pytest.raises(ConfigError, match=message):
        CliRunner().invoke(explain, arguments, catch_exceptions=False)


@pytest.mark.parametrize("at", ["soon", "nan", "-1"])
def test_a_time_must_be_one(take: Path, at: str) -> None:
    result = CliRunner().invoke(explain, [str(take / "take.mcap"), f"--at={at}"])
    assert result.exit_code == 2
    assert "not a time" in result.output


def test_a_span_of_a_recording(take: Path) -> None:
    recording = load_recording(take / "take")
    first_ns, last_ns = time_span(recording)
    part = between(recording, first_ns + 500_000_000, first_ns + 600_000_000)
    assert [len(track.t_ns) for track in part.cameras.values()] == [6, 6]
    for name, track in part.cameras.items():
        assert set(track.t_ns) <= set(recording.cameras[name].t_ns)
        assert isinstance(track, PictureTrack)
        last = newest(track, 2)
        assert isinstance(last, PictureTrack)
        assert last.files == track.files[-2:]
    with pytest.raises(ConfigError, match="it runs from"):
        between(recording, last_ns + 1, last_ns + 10**9)
