"""`rhot evaluate hands`: joints that nobody measured, on recordings of real hands, beside plain FABRIK."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

import click
import numpy as np
from rich.console import Console

from rhot.anatomy.hand import HandModel
from rhot.errors import ConfigError
from rhot_bench.hands.recorded_hands import fit_person, fit_rest_frames, fit_spread, plain_fingers
from rhot_bench.hands.recorded_joints import (
    Recorded,
    error_mm,
    fit_open_hand,
    joined,
    on_its_palm,
    plain,
    read_joints,
    solved,
    whole_chains,
)
from rhot_ik.hand.closed_form import AnalyticFingers, FingerGeometry
from rhot_tools.measures.output import counted, json_option, quick_option, show
from rhot_tools.measures.rows import Row, Section, check_output

_MIDDLE: Final = slice(1, 3)
_INNER: Final = slice(0, 3)
_ALL: Final = slice(None)
_LONG: Final = slice(1, 5)
_PERSONS: Final = (1, 2, 3)
_MSRA, _NYU, _FPHA = "msra14_dev.csv", "nyu_dev.csv", "fpha"
_EITHER_WAY: Final = "the person fitted on one half of the frames, judged on the other, both ways"
_FROM_WRIST: Final = "given are both sides of the wrist and the tips; " + _EITHER_WAY

Advance = Callable[[], None]


@click.command()
@click.argument("data_path", metavar="DATA", type=click.Path(path_type=Path))
@quick_option("Use fewer frames; rougher figures.")
@json_option
def hands(data_path: Path, quick: bool, json_path: Path | None) -> None:
    """Predict the inner joints of recorded hands from wrist and tips, and compare with the recording.

    DATA is a folder with any of msra14_dev.csv, nyu_dev.csv and fpha/S1_*.csv: columns JOINT_x, JOINT_y, JOINT_z in
    millimetres. Bone lengths come from other frames of the same person. For comparison, plain FABRIK runs on the same
    frames: with our bone lengths and knuckles, without limits and coupling, from a slightly bent start.
    """
    check_output("--json", json_path)
    if data_path.is_dir() and (data_path / "hand_motion").is_dir():
        data_path = data_path / "hand_motion"
    parts = [
        (name, make) for name, make in ((_MSRA, _msra), (_NYU, _nyu), (_FPHA, _fpha)) if (data_path / name).exists()
    ]
    if not parts:
        raise ConfigError(f"{data_path}: holds none of {_MSRA}, {_NYU} and {_FPHA}/; name the folder that does")
    sections = []
    with counted(Console(stderr=True)) as progress:
        task = progress.add_task("", total=2 * len(parts) + (len(_PERSONS) - 2) * any(n == _FPHA for n, _ in parts))
        for name, make in parts:
            progress.update(task, description=f"solving {name}")
            sections.append(make(data_path / name, quick, lambda: progress.advance(task)))
    show("evaluate hands", sections, json_path, quick=quick)


def _halves(recorded: Recorded) -> list[tuple[Recorded, Recorded]]:
    middle = len(recorded.wrists) // 2
    first, second = recorded.part(slice(middle)), recorded.part(slice(middle, None))
    return [(first, second), (second, first)]


def _msra(path: Path, quick: bool, advance: Advance) -> Section:
    recorded = read_joints(path, ["wrist"], whole_chains())
    given: list[tuple[float, float]] = []
    alone: list[tuple[float, float]] = []
    for fit, judged in _halves(recorded):
        person = fit_person(fit.wrists, fit.chains, "right")
        local, truth = on_its_palm(person, fit), on_its_palm(person, judged)
        person = fit_spread(fit_rest_frames(person, local), local)
        angles = AnalyticFingers(FingerGeometry.of(person, {})).solve(truth[:, :, 3]).angles
        closed, chains = person.finger_chains(angles)[0], plain_fingers(person, truth[:, :, 3])
        given.append((error_mm(closed, truth, _ALL, _MIDDLE), error_mm(chains, truth, _ALL, _MIDDLE)))
        some = judged.part(slice(0, 25 if quick else None))
        alone.append(_beside_plain(person, some, _ALL, _MIDDLE, 1))
        advance()
    (ours, plain_given), (free, plain_alone) = np.mean(given, axis=0).tolist(), np.mean(alone, axis=0).tolist()
    rows = (
        Row("PIP and DIP, palm given, mean", ours, "mm", most=2.5, note=_EITHER_WAY),
        Row("the same, plain FABRIK", plain_given, "mm"),
        Row("PIP and DIP, from wrist and tips alone, mean", free, "mm", most=8.0, note=_EITHER_WAY),
        Row("the same, plain FABRIK", plain_alone, "mm"),
    )
    return Section("MSRA14, fast gestures", rows)


def _nyu(path: Path, quick: bool, advance: Advance) -> Section:
    chains = [["", "T_mcp", "T_ip", "T_tip"], *(["", f"{f}_pip", "", f"{f}_tip"] for f in "IMRP")]
    recorded = read_joints(path, ["W_thumb_side", "W_pinky_side"], chains, "palm")
    errors = []
    for fit, judged in _halves(recorded):
        person = fit_open_hand(fit)
        some = judged.part(slice(0, 60 if quick else None))
        errors.append(_beside_plain(person, some, _LONG, slice(1, 2), 5))
        advance()
    ours, others = np.mean(errors, axis=0).tolist()
    return Section(
        "NYU, one continuous sequence: PIP of the four long fingers", _ratio_rows("PIP", ours, others, _FROM_WRIST)
    )


def _fpha(path: Path, quick: bool, advance: Advance) -> Section:
    rows: list[Row] = []
    for person in _PERSONS:
        files = sorted(path.glob(f"S{person}_*.csv"))
        if len(files) < 2:
            raise ConfigError(f"{path}: holds {len(files)} files S{person}_*.csv; two or more are needed")
        recordings = [read_joints(file, ["W"], whole_chains()) for file in files]
        fit = joined(one.part(slice(None, None, 5)) for one in recordings[::2])
        model = fit_person(fit.wrists, fit.chains, "right")
        judged = recordings[1::2][: 1 if quick else None]
        errors = [_beside_plain(model, one.part(slice(0, 30 if quick else 100)), _ALL, _INNER, 5) for one in judged]
        ours, others = np.mean(errors, axis=0).tolist()
        rows += _ratio_rows(f"person {person}, MCP, PIP and DIP", ours, others)
        advance()
    return Section("FPHA, daily actions: joints of another solver's", tuple(rows))


def _beside_plain(model: HandModel, judged: Recorded, fingers: slice, joints: slice, every: int) -> tuple[float, float]:
    """Return mean errors, millimetres, of our solver and of plain FABRIK on every n-th frame.

    Ours sees all frames, as it would live; a frame in which it finds no hand counts with its wrist for every joint.
    """
    found = solved(model, judged)[::every]
    some = judged.part(slice(None, None, every))
    found = np.where(np.isfinite(found), found, some.wrists[:, None, None])
    ours = error_mm(found, some.chains, fingers, joints)
    return ours, error_mm(plain(model, some), some.chains, fingers, joints)


def _ratio_rows(name: str, ours: float, others: float, note: str = "") -> tuple[Row, ...]:
    return (
        Row(f"{name}, mean", ours, "mm", note=note),
        Row("the same, plain FABRIK", others, "mm"),
        Row(f"{name}: plain FABRIK / ours", others / ours, "×", least=1.5),
    )
