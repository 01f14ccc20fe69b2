"""`rhot process` over a recorded walk: what the live core makes of it, against the truth and against the live run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from headset_feet.walked import record_walk

from rhot.errors import ConfigError
from rhot.rig import Rig
from rhot.rig.template import rig_template
from rhot_bench.feet.heads import START_NS
from rhot_bench.feet.runs import Run, play
from rhot_sim.walker.folder import write_walker_rig
from rhot_sim.walker.world import WalkerWorld
from rhot_tools.recordings.export import export
from rhot_tools.recordings.process import process
from rhot_tools.trial.report import report, trial_of

SECONDS = 3.0
RATE_HZ = 15.0
pytestmark = pytest.mark.xdist_group("walked")


def lines_of(rig: Path, recording: Path, out: Path) -> list[dict[str, Any]]:
    result = CliRunner().invoke(process, [str(recording), "--rig", str(rig), "--out", str(out)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return read(out)


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, Path, Path]:
    """A walker's rig, a recording of the walk, and what `rhot process` makes of it."""
    folder = tmp_path_factory.mktemp("walked")
    rig = write_walker_rig(folder / "rig", endpoint="tcp/127.0.0.1:7", program="step", seed=3, rate_hz=RATE_HZ)
    record_walk(rig, folder / "walk", SECONDS)
    lines_of(rig.path, folder / "walk", folder / "out.jsonl")
    return rig, folder / "walk", folder / "out.jsonl"


def read(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in out.read_text().splitlines()]


def errors_m(rig: Rig, lines: list[dict[str, Any]], from_s: float = 0.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    world = WalkerWorld.from_rig(rig)
    return np.array(
        [
            np.linalg.norm(np.array(line["value"]["position"]) - world.feet(np.array([t_s]))[side][0, :3, 3])
            for line in lines
            if line["key"].startswith("rhot/foot/")
            for side in [line["value"]["side"]]
            for t_s in [1e-9 * (line["value"]["t_ns"] - START_NS)]
            if t_s >= from_s
        ]
    )


def test_recorded_feet_are_as_near_the_truth_as_live_ones(walked: tuple[Rig, Path, Path]) -> None:
    rig, _, out = walked
    lines = read(out)
    keys = {line["key"] for line in lines}
    assert keys == {"rhot/head", "rhot/foot/left", "rhot/foot/right", "rhot/body"}
    offline = errors_m(rig, lines, from_s=0.5)
    live = play(Run("step", "step"), rig, rig.config.sim.seed, SECONDS)
    known = np.concatenate([track.error_m[live.t_s >= 0.5] for track in live.ours.values()])
    known = known[np.isfinite(known)]
    # The pictures were coded, everything came in order: neither more than a little worse, nor seen less often.
    assert len(offline) > 0.95 * len(known)
    for share in (50, 95):
        assert np.percentile(offline, share) < 1.1 * np.percentile(known, share) + 1e-3
    assert np.median(offline) < 0.005


def test_tables_and_animations_of_recorded_feet(walked: tuple[Rig, Path, Path], tmp_path: Path) -> None:
    rig, _, out = walked
    lines = read(out)
    bodies = [line for line in lines if line["key"] == "rhot/body"]
    assert len(bodies) > 50 * (SECONDS - 1.0)
    arguments = [str(out), "--csv", str(tmp_path / "tables"), "--bvh", str(tmp_path / "b.bvh"), "--bvh-of", "body"]
    result = CliRunner().invoke(export, [*arguments, "--rig", str(rig.path)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    for name in ("foot_left", "foot_right", "body"):
        rows = (tmp_path / "tables" / f"{name}.csv").read_text().splitlines()
        of_name = [line for line in lines if line["key"].removeprefix("rhot/").replace("/", "_") == name]
        assert len(rows) == 1 + len({line["value"]["t_ns"] for line in of_name})
    assert "hips" in (tmp_path / "b.bvh").read_text()


def test_a_page_about_recorded_feet(walked: tuple[Rig, Path, Path], tmp_path: Path) -> None:
    _, _, out = walked
    page = tmp_path / "report.html"
    done = CliRunner().invoke(report, [str(out), "--out", str(page)], standalone_mode=False)
    assert done.exit_code == 0, done.output
    text = page.read_text()
    poses = [line["value"] for line in read(out) if line["key"] == "rhot/foot/left"]
    by_marker = 100.0 * sum(pose["stage"] == "marker" for pose in poses) / len(poses)
    assert f"<td class='number'>left</td><td class='number'>{by_marker:.1f} %</td>" in text
    assert "Feet were tracked by a head-worn depth camera" in text
    assert "Painted markers" not in text
    verdict = trial_of(out, None).verdict
    assert (verdict.judged, verdict.level) == (True, "good"), verdict
    lost = tmp_path / "lost.jsonl"
    lines = [
        line if line["key"] != "rhot/foot/left" else line | {"value": line["value"] | {"stage": "lost"}}
        for line in read(out)
    ]
    lost.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert [finding.level for finding in trial_of(lost, None).verdict.findings] == ["not usable"]


def test_a_walk_that_was_cut_off_opens(walked: tuple[Rig, Path, Path], tmp_path: Path) -> None:
    rig, recording, _ = walked
    cut = tmp_path / "cut"
    (cut / "feet").mkdir(parents=True)
    for name in ("color", "depth", "intrinsics.json", "left.csv", "right.csv"):
        (cut / "feet" / name).symlink_to(recording / "feet" / name)
    (cut / "recording.toml").write_text("version = 1\ncomplete = false\n")
    rows = (recording / "feet" / "timestamps.csv").read_text().splitlines()
    (cut / "feet" / "timestamps.csv").write_text("\n".join(rows[:16]) + "\n" + rows[16][:9])
    head = (recording / "feet" / "head.csv").read_text()
    (cut / "feet" / "head.csv").write_text(head[: len(head) // 2])
    lines = lines_of(rig.path, cut, tmp_path / "out.jsonl")
    last_ns = int(rows[15].split(",")[1])
    stamps = [line["value"]["t_ns"] for line in lines if line["key"].startswith("rhot/foot")]
    assert 0.5e9 < max(stamps) - START_NS <= last_ns - START_NS


def test_what_is_missing_is_named(walked: tuple[Rig, Path, Path], tmp_path: Path) -> None:
    rig, recording, _ = walked
    bare = tmp_path / "bare"
    (bare / "feet").mkdir(parents=True)
    for name in ("color", "depth", "intrinsics.json", "timestamps.csv"):
        (bare / "feet" / name).symlink_to(recording / "feet" / name)
    with pytest.raises(ConfigError, match=r"head\.csv is not there: .*rhot objects"):
        lines_of(rig.path, bare, tmp_path / "out.jsonl")
    handless = tmp_path / "rig"
    handless.mkdir()
    (handless / "rig.toml").write_text(rig_template(folder="rig", name="test"))
    with pytest.raises(ConfigError, match=r"names no feet; add \[feet\.left\]"):
        lines_of(handless, bare, tmp_path / "out.jsonl")
    (bare / "feet" / "head.csv").write_text("t_ns,x,y,z,qx,qy,qz,qw\n5,0,0,0,0,0,0,1\n4,0,0,0,0,0,0,1\n")
    with pytest.raises(ConfigError, match=r"head\.csv, line 3: t_ns 4 is not later than 5"):
        lines_of(rig.path, bare, tmp_path / "out.jsonl")
