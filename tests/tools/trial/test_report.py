"""`rhot report`: what the page says of trials that are good, doubtful or of no use, and that it needs nothing else."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

import rhot
from rhot.messages import Event, encode, encoding_of
from rhot.offline import track
from rhot.recording.mcap.writer import McapWriter, rig_files
from rhot.recording.messages import RecordedMessages
from rhot_bench.motion.tracks import make_tracks
from rhot_tools.trial.report import finger_figures, report, trial_of

EXAMPLES = Path(__file__).parents[3] / "examples"
EXAMPLE = EXAMPLES / "analysis.py"
pytestmark = pytest.mark.xdist_group("reports")


@pytest.fixture(scope="module")
def trial(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded hand before a simulated rig, four seconds."""
    folder = tmp_path_factory.mktemp("trial")
    tracks = make_tracks(0, shared_data / "hand_motion", folder / "rig", seconds=4.0)
    file = folder / "good.mcap"
    with McapWriter(file, now_ns=0, attachments=rig_files(folder / "rig")) as mcap:
        for key, message in track(tracks.rig, iter(tracks.frames)):
            mcap.write(key, encoding_of(type(message)), encode(message), message.t_ns, message.seq, message.t_ns)
        event = Event(t_ns=tracks.frames[0].t_ns, label="go <b>", source="mark")
        mcap.write("rhot/event", encoding_of(Event), encode(event), event.t_ns, 0, event.t_ns)
    return file


def run(*arguments: str) -> Result:
    return CliRunner().invoke(report, list(arguments), standalone_mode=False)


def test_a_page_says_what_the_arrays_hold(trial: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    done = run(str(trial), "--out", str(out))
    page = out.read_text()
    assert done.exit_code == 0, done.output
    take = rhot.load(trial)
    side, hand = next(iter(take.hands.items()))
    assert f"{side} hand" in page
    figures = finger_figures(take, hand, trial_of(trial, None).rig)
    index = figures[1]
    states = take.points[next(name for name in take.points if "index" in name)].state
    assert index.measured == pytest.approx(np.mean(states == "measured"))
    assert f"<td class='number'>{100 * index.measured:.1f} %</td>" in page
    assert 0.0 < index.sigma_m[0] < 0.02
    assert index.knuckle_rad > 0.0
    assert "go &lt;b&gt;" in page
    assert "For the methods section" in page
    assert f"version {rhot.__version__}" in page


def test_a_page_needs_no_network(trial: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    run(str(trial), "--out", str(out))
    page = out.read_text()
    assert not re.search(r"""(src|href)=['"](?!data:|#)""", page)
    assert "<script" not in page


def test_several_trials_begin_with_a_table_and_a_bad_one_ends_with_1(trial: Path, tmp_path: Path) -> None:
    blind = tmp_path / "blind.mcap"
    cameras = sorted({key for key, _ in RecordedMessages(trial) if key.startswith("rhot/markers/")})
    with McapWriter(blind, now_ns=0, attachments=RecordedMessages(trial).attachments) as mcap:
        for key, message in RecordedMessages(trial):
            if key not in cameras[1:]:
                mcap.write(key, encoding_of(type(message)), encode(message), message.t_ns, message.seq, message.t_ns)
    out = tmp_path / "trials.html"
    done = run(str(trial), str(blind), "--out", str(out))
    page = out.read_text()
    assert done.return_value == 1
    assert "<a href='#trial1'>blind.mcap</a>" in page
    assert "id='trial1'" in page
    assert "not usable: no two cameras saw the same marker" in page


def test_pictures_of_the_least_certain_moments_are_in_it(trial: Path, tmp_path: Path) -> None:
    copy = tmp_path / "take.mcap"
    shutil.copy(trial, copy)
    take = rhot.load(copy)
    folder = tmp_path / "take" / "cam"
    folder.mkdir(parents=True)
    hand = next(iter(take.hands.values()))
    rows = ["frame,t_ns"]
    import cv2

    for number, t_ns in enumerate(hand.t_ns[:: max(1, len(hand) // 20)].tolist()):
        cv2.imwrite(str(folder / f"{number:06d}.jpg"), np.full((48, 64, 3), number, np.uint8))
        rows.append(f"{number},{t_ns}")
    (folder / "timestamps.csv").write_text("\n".join(rows) + "\n")
    out = tmp_path / "report.html"
    assert run(str(copy), "--out", str(out)).exit_code == 0
    assert out.read_text().count("data:image/jpeg;base64,") == 3


def test_a_trial_that_lost_a_part_is_doubtful(trial: Path, tmp_path: Path) -> None:
    copy, out = tmp_path / "a.mcap", tmp_path / "report.html"
    content = trial.read_bytes()
    half = len(content) // 2
    copy.write_bytes(content[:half] + bytes(300) + content[half:])
    assert run(str(copy), "--out", str(out)).exit_code == 0
    verdict = trial_of(copy, None).verdict
    assert verdict.level == "doubtful"
    assert "a.mcap: damaged at byte" in verdict.findings[0].text
    assert "a.mcap: damaged at byte" in out.read_text()


def test_what_was_not_tracked_says_so(tmp_path: Path) -> None:
    file = tmp_path / "empty.jsonl"
    file.write_text("")
    done = run(str(file), "--out", str(tmp_path / "x.html"))
    assert "holds nothing that was tracked" in str(done.exception)
    assert not (tmp_path / "x.html").exists()


def test_the_example_runs_as_it_stands(trial: Path, tmp_path: Path) -> None:
    # Its list of fonts takes seconds to make.
    matplotlib = pytest.importorskip("matplotlib")
    pytest.importorskip("pynwb")
    text = EXAMPLE.read_text()
    code = text.rpartition('"""')[2]
    assert len([line for line in code.splitlines() if line.strip()]) <= 30
    side = next(iter(rhot.load(trial).hands))
    script = tmp_path / "analysis.py"
    script.write_text(text.replace('hands["right"]', f'hands["{side}"]'))
    path = f"{Path(sys.executable).parent}:/usr/bin:/bin"
    command = [sys.executable, str(script), str(trial)]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env={"PATH": path, "HOME": str(tmp_path), "MPLCONFIGDIR": matplotlib.get_cachedir()},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    assert {"analysis.png", "analysis.nwb", "dataset", "report.html"} <= {each.name for each in tmp_path.iterdir()}


def test_the_notebook_runs_as_it_stands(trial: Path, tmp_path: Path) -> None:
    """Its cells one after another, in one process."""
    # Its list of fonts takes seconds to make.
    matplotlib = pytest.importorskip("matplotlib")
    pytest.importorskip("xarray")
    cells = json.loads((EXAMPLES / "grasp.ipynb").read_text())["cells"]
    assert not any(cell.get("outputs") for cell in cells), "the notebook is kept without outputs"
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    side = next(iter(rhot.load(trial).hands))
    text = "\n".join(code).replace('"grasp.mcap", "right"', f'"grasp.mcap", "{side}"')
    script = tmp_path / "cells.py"
    script.write_text(f"{text}\nfigure.savefig('figure.png')\n")
    shutil.copy(trial, tmp_path / "grasp.mcap")
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env={
            "PATH": "/usr/bin:/bin",
            "HOME": str(tmp_path),
            "MPLBACKEND": "Agg",
            "MPLCONFIGDIR": matplotlib.get_cachedir(),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    live_mm, smooth_mm = re.findall(r"(?:live|smoothed) ([0-9.]+)", done.stdout)
    assert 0.0 < float(smooth_mm) < float(live_mm)
    assert (tmp_path / "figure.png").exists()
