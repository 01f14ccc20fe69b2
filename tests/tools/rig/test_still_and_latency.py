"""Jitter and latency of messages whose jitter and times are known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rhot.cli.main import main
from rhot.messages import MarkerFrame, Message, Point, PointSet, ServiceStatus, Truth, encode, encoding_of
from rhot.recording.mcap.writer import McapWriter
from rhot.report.svg import Bar, bar_plot
from rhot_tools.rig.heard import Heard
from rhot_tools.rig.jitter import jitter_plots, jitter_sections, still_jitter
from rhot_tools.rig.latency import latencies_of, latency_sections, thread_section

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 16_666_667
COUNT = 600


def still(
    sigma_px: float = 0.3, sigma_m: tuple[float, float, float] = (1e-4, 1e-4, 2e-3), clock_s: float = 0.0
) -> Heard:
    """Two cameras that see one marker with white noise, and points of it; the parts of latency take 8, 3 and 2 ms."""
    rng = np.random.default_rng(2)
    heard = Heard()
    for number in range(COUNT):
        t_ns = START_NS + number * PERIOD_NS
        for camera in ("left", "right"):
            u, v = rng.normal((320.0, 240.0), sigma_px)
            age, detect, sending = rng.normal((0.008, 0.003, 0.002), (4e-4, 3e-4, 5e-4))
            frame = MarkerFrame.model_validate(
                {
                    "t_ns": t_ns,
                    "camera": camera,
                    "width": 640,
                    "height": 480,
                    "markers": {"index": {"u": u, "v": v, "area": 90.0, "score": 1.0}},
                    "timing": {"age": age, "detect": detect},
                    "frame": number,
                }
            )
            heard.note(f"rhot/markers/{camera}", frame, t_ns + round(1e9 * (age + detect + sending)))
        x, y, z = rng.normal((0.0, 0.0, 0.8), sigma_m)
        point = Point(position=(x, y, z), sigma=0.002, views=2, state="measured")
        messages: list[Message] = [
            PointSet(t_ns=t_ns, frame="rig", points={"index": point}),
            Truth(t_ns=t_ns, frame="rig", points={"index": (0.001, 0.0, 0.8)}, hands={}, objects={}),
        ]
        for message in messages:
            heard.note("", message)
    for who in ("left", "right"):
        status = ServiceStatus(
            t_ns=START_NS, service="capture", instance=who, state="running", clock_uncertainty_s=clock_s
        )
        heard.note("", status)
    return heard


def test_jitter_is_what_was_put_in() -> None:
    jitter = still_jitter(still())
    for camera in ("left", "right"):
        assert jitter.pixels[camera]["index"].holds(0.3 * np.sqrt(2.0))
    assert jitter.sideways["index"].holds(1e-4 * np.sqrt(2.0))
    assert jitter.depth["index"].holds(2e-3)
    assert jitter.depth["index"].half_width < 2.5e-4
    beside = jitter_sections(jitter)[-1]
    assert "truth" in beside.title
    assert [row.value for row in beside.rows] == [1.0, 1.0]


@pytest.mark.parametrize("speed_px_s", [0.0, 1.0, 4.0])
def test_motion_is_no_jitter(speed_px_s: float) -> None:
    """A hand that sways, and pauses every other second, has the jitter of one that is still."""
    heard = still(sigma_px=0.1)
    for number, frame in enumerate(heard.frames):
        t_s = 1e-9 * (frame.t_ns - START_NS)
        shift = speed_px_s * (t_s % 2.0 if t_s % 2.0 < 1.0 else 2.0 - t_s % 2.0) + 0.2 * speed_px_s * np.sin(9.0 * t_s)
        marker = frame.markers["index"]
        markers = {"index": marker.model_copy(update={"u": marker.u + shift})}
        heard.frames[number] = frame.model_copy(update={"markers": markers})
    jitter = still_jitter(heard)
    for camera in ("left", "right"):
        found = jitter.pixels.get(camera, {}).get("index")
        assert found is None or np.isnan(found.low) or found.value == pytest.approx(0.1 * np.sqrt(2.0), rel=0.08), found


def test_a_hand_that_never_rests_has_no_jitter() -> None:
    heard = still(sigma_px=0.1)
    for number, frame in enumerate(heard.frames):
        marker = frame.markers["index"]
        markers = {"index": marker.model_copy(update={"u": 320.0 + 0.8 * np.sin(6.0e-9 * (frame.t_ns - START_NS))})}
        heard.frames[number] = frame.model_copy(update={"markers": markers})
    jitter = still_jitter(heard)
    (section,) = jitter_sections(jitter)
    assert jitter.pixels == {}
    assert jitter.sideways == {}
    assert jitter_plots(jitter) == []
    assert [row.value for row in section.rows] == [0.0, 0.0]
    assert all("rest the hand on something" in row.note for row in section.rows)


def test_latencies_are_told_with_mean_and_deviation() -> None:
    times = latencies_of(still())
    sections = {section.title: section for section in latency_sections(still(), times)}
    rows = {row.name: row for row in sections["Latency of camera left"].rows}
    expected = {"retrieval": (8.0, 0.4), "detection": (3.0, 0.3), "sending": (2.0, 0.5), "in all": (13.0, 0.71)}
    for part, (middle, spread) in expected.items():
        assert rows[f"{part}, mean"].value == pytest.approx(middle, abs=0.1)
        assert rows[f"{part}, deviation"].value == pytest.approx(spread, rel=0.12)
    assert "95 %" in rows["sending, mean"].note


def test_what_a_clock_may_be_off_widens_what_spans_two_machines() -> None:
    row = next(
        row
        for row in latency_sections(still(), latencies_of(still(clock_s=0.001)))[0].rows
        if row.name == "sending, mean"
    )
    low, high = (float(part) for part in row.note.split("95 %: ")[1].split(" ms")[0].split(" to "))
    assert low < 1.1
    assert high > 2.9


def test_frames_without_timing_tell_no_latency() -> None:
    heard = Heard.of([("", frame.model_copy(update={"timing": {}})) for frame in still().frames])
    assert latencies_of(heard) == {}


def test_threads_are_compared_on_the_same_pictures() -> None:
    class Detector:
        def detect(self, image: object) -> dict[str, object]:
            return {}

    pictures = {"left": [np.zeros((4, 4, 3), np.uint8)] * 12}
    section = thread_section(pictures, {"left": Detector()}, (1, 2))  # type: ignore[dict-item]
    assert [row.name for row in section.rows] == ["left, 1 thread, mean", "left, 2 threads, mean"]
    assert all(row.value > 0.0 for row in section.rows)


def test_bars_have_whiskers_and_a_legend() -> None:
    drawn = bar_plot("jitter", "px", {"index": {"left": Bar(1.0, 0.5, 1.5), "right": Bar(2.0)}, "<thumb>": {}})
    assert drawn.count("<rect") == 4
    assert drawn.count("<path") == 3
    assert "&lt;thumb&gt;" in drawn
    assert "no data" in bar_plot("empty", "px", {})
    assert len(jitter_plots(still_jitter(still()))) == 2


def test_a_recording_of_marker_tracks_gives_a_report(rig_folder: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    for camera, shift in (("left", 0.0), ("right", -50.0)):
        folder = tmp_path / "take" / camera
        folder.mkdir(parents=True)
        lines = ["frame,t_ns,marker,u,v"]
        for number in range(120):
            u, v = rng.normal((320.0 + shift, 240.0), 0.1)
            lines.append(f"{number},{START_NS + number * PERIOD_NS},index,{u:.3f},{v:.3f}")
        (folder / "markers.csv").write_text("\n".join(lines) + "\n")
    report, figures = tmp_path / "rig.html", tmp_path / "rig.json"
    arguments = ["evaluate", "rig", str(tmp_path / "take"), "--rig", str(rig_folder)]
    result = CliRunner().invoke(main, [*arguments, "--report", str(report), "--json", str(figures)])
    assert result.exit_code == 0, result.output
    assert "Jitter of each marker in the pictures" in report.read_text()
    assert "http" not in report.read_text().replace("http://www.w3.org", "")
    titles = [section["title"] for section in json.loads(figures.read_text())["sections"]]
    assert titles == [
        "Jitter in the pictures of camera left",
        "Jitter in the pictures of camera right",
        "At rest",
        "Jitter in space",
    ]


def test_a_recording_of_rhot_record_gives_jitter_and_latency(rig_folder: Path, tmp_path: Path) -> None:
    heard, take, figures = still(), tmp_path / "take.mcap", tmp_path / "rig.json"
    sent: list[tuple[str, Message]] = [(f"rhot/markers/{frame.camera}", frame) for frame in heard.frames]
    sent += [("rhot/points", points) for points in heard.points]
    with McapWriter(take, now_ns=START_NS) as writer:
        for seq, (key, message) in enumerate(sorted(sent, key=lambda each: each[1].t_ns)):
            writer.write(key, encoding_of(type(message)), encode(message), message.t_ns, seq, message.t_ns + 20_000_000)
    result = CliRunner().invoke(
        main, ["evaluate", "rig", str(take), "--rig", str(rig_folder), "--json", str(figures)], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    sections = {
        section["title"]: {row["name"]: row["value"] for row in section["rows"]}
        for section in json.loads(figures.read_text())["sections"]
    }
    assert sections["Jitter in the pictures of camera left"]["index"] == pytest.approx(0.3 * np.sqrt(2.0), rel=0.1)
    assert sections["Jitter in space"]["index, in depth"] == pytest.approx(2.0, rel=0.2)
    assert sections["Latency of camera right"]["detection, mean"] == pytest.approx(3.0, abs=0.1)
    assert "sending, mean" not in sections["Latency of camera right"], "nobody timed the arrival by the rig's clock"


def test_what_to_measure_must_be_said(rig_folder: Path) -> None:
    for arguments in ([], ["--live", "still", "--distances", "4,5"], ["--live", "still", "--marker", "toe"]):
        result = CliRunner().invoke(main, ["evaluate", "rig", "--rig", str(rig_folder), *arguments])
        assert result.exit_code != 0
