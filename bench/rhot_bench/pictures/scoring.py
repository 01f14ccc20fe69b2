"""What the scorer beside the rendered pictures says of points and hands."""

from __future__ import annotations

import importlib.util
import json
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rhot.errors import ConfigError
from rhot.messages import HandPose, Message, PointSet
from rhot_tools.measures.points import MEASURED, Estimates


@dataclass(frozen=True, slots=True)
class Score:
    """Figures of one sequence, of points that are told as measured, at instants when both cameras see the marker.

    Attributes:
        median_mm, p95_mm: distance from the truth after one constant offset per marker (along its bone and along the
            viewing ray), as the scorer fits it.
        raw_median_mm, raw_p95_mm: distance from the truth, nothing removed.
        joints_mm: mean distance of the joints; NaN where no hand was given.
        coverage: percent of the left frames' markers, seen by both cameras, with a report within 20 ms.
        swaps: reports nearer to another marker, and more than 10 mm off.
        hallucinations: reports of markers hidden in both views, more than 30 mm off.
        one_view_median_mm, one_view_p95_mm: points told as measured while one camera alone sees the marker.
        lone_median_mm, lone_p95_mm: points of state `one_view` while one camera alone sees the marker; NaN without any.
    """

    median_mm: float
    p95_mm: float
    raw_median_mm: float
    raw_p95_mm: float
    joints_mm: float
    coverage: float
    swaps: int
    hallucinations: int
    one_view_median_mm: float
    one_view_p95_mm: float
    lone_median_mm: float = float("nan")
    lone_p95_mm: float = float("nan")


def score_messages(data: Path, sequence: str, messages: Iterable[tuple[str, Message]]) -> Score:
    """Score what `rhot process` would write."""
    lines, lone = [], []
    for key, message in messages:
        if isinstance(message, PointSet):
            # The scorer judges what is told as measured.
            points = {
                name: point.model_copy(update={"state": "measured"})
                for name, point in message.points.items()
                if point.state == "one_view"
            }
            lone.append(_line(key, message.model_copy(update={"points": points})))
        if isinstance(message, PointSet | HandPose):
            lines.append(_line(key, message))
    figures = _figures(data, lone).get(sequence)
    median, p95, *_ = figures["err_visible_in_one_mm"] if figures else (float("nan"), float("nan"))
    return replace(_score(data, sequence, lines), lone_median_mm=float(median), lone_p95_mm=float(p95))


def score_estimates(data: Path, sequence: str, estimates: Estimates, names: Sequence[str]) -> Score:
    """Score the points of a reference, all those told as measured."""
    lines = []
    told = estimates.of(estimates.state == MEASURED)
    for t_ns in np.unique(told.t_ns):
        now = told.of(told.t_ns == t_ns)
        markers = {names[m]: (1e3 * p).tolist() for m, p in zip(now.marker, now.position, strict=True)}
        lines.append(json.dumps({"t_ns": int(t_ns), "markers": markers}))
    return _score(data, sequence, lines)


def _line(key: str, message: Message) -> str:
    return f'{{"key": {json.dumps(key)}, "value": {message.model_dump_json(exclude_none=True)}}}'


def _figures(data: Path, lines: Sequence[str]) -> dict[str, Any]:
    """Return the scorer's figures by sequence."""
    with tempfile.TemporaryDirectory(prefix="rhot-pictures-") as folder:
        file = Path(folder) / "found.jsonl"
        file.write_text("\n".join(lines) + "\n", encoding="utf-8")
        found: dict[str, Any] = _scorer(data).score3d(str(file), str(data), quiet=True, want_shift=False)
    return found


def _score(data: Path, sequence: str, lines: Sequence[str]) -> Score:
    found = _figures(data, lines)
    if sequence not in found:
        raise ConfigError(f"{data}: no point was found in {sequence}; are colours and cameras calibrated?")
    figures = found[sequence]
    return Score(
        median_mm=float(figures["err_after_offset_fit_mm"][0]),
        p95_mm=float(figures["err_after_offset_fit_mm"][1]),
        raw_median_mm=float(figures["err_mm"][0]),
        raw_p95_mm=float(figures["err_mm"][1]),
        joints_mm=float(figures.get("joint_mean_mm", float("nan"))),
        coverage=float(figures["coverage_pct"]),
        swaps=int(figures["wrong_identity"]),
        hallucinations=int(figures["hallucinations"]),
        one_view_median_mm=float(figures["err_visible_in_one_mm"][0]),
        one_view_p95_mm=float(figures["err_visible_in_one_mm"][1]),
    )


def _scorer(data: Path) -> Any:
    """Return the data's own scorer as a module; it is the judge, so it is used as it lies there."""
    spec = importlib.util.spec_from_file_location("rendered_score", data / "score.py")
    if spec is None or spec.loader is None:
        raise ConfigError(f"{data / 'score.py'}: cannot be loaded as a Python module")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
