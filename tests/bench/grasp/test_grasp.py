"""A hand of known path that takes a cylinder, carries it and lets go: every figure against what was played."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.cli.main import main
from rhot.errors import ConfigError
from rhot.messages import CylinderShape, HandPose, Joint, Message, ObjectPose
from rhot.messages.base import wire_position
from rhot_tools.grasp.figures import grasp_figures
from rhot_tools.grasp.pickups import find_pickups, gaps_m
from rhot_tools.grasp.session import TIPS, GraspSession, grasp_session

RATE_HZ = 60.0
RADIUS_M, HEIGHT_M, FLESH_M = 0.03, 0.09, 0.008
CUP = CylinderShape(radius=RADIUS_M, height=HEIGHT_M)
REACHED_S, CLOSED_S, LIFTED_S, DOWN_S, OPENED_S, END_S = 1.5, 2.5, 3.0, 5.0, 5.5, 7.0


def played(gap_m: float = 0.0, carry_m: float = 0.2, drift_m: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times (N,), the cup's middle (N, 3) and the tips (N, 5, 3): thumb on one side, fingers on the other."""
    t = np.arange(0.0, END_S, 1.0 / RATE_HZ)
    carried = np.interp(t, [LIFTED_S, DOWN_S], [0.0, carry_m])
    middle = np.stack([carried, np.zeros_like(t), np.full_like(t, 0.8)], axis=1)
    far = np.interp(t, [0.5, REACHED_S, CLOSED_S, DOWN_S, OPENED_S, 6.5], [0.2, 0.03, gap_m, gap_m, 0.05, 0.2])
    off = RADIUS_M + FLESH_M + far
    slipped = np.interp(t, [LIFTED_S, DOWN_S], [0.0, drift_m])
    tips = np.repeat(middle[:, None], 5, axis=1)
    tips[:, 0, 1] -= off
    tips[:, 1:, 1] += off[:, None]
    tips[..., 2] += slipped[:, None]
    return t, middle, tips


def messages(
    t: FloatArray, middle: FloatArray, tips: FloatArray, shape: CylinderShape | None = CUP
) -> list[tuple[str, Message]]:
    sent: list[tuple[str, Message]] = []
    for row, t_s in enumerate(t.tolist()):
        t_ns = 1_000_000_000 + round(1e9 * t_s)
        palm = tips[row].mean(axis=0) + np.array([0.0, 0.0, -0.1])
        joints = {
            name: Joint(position=wire_position(palm), orientation=(0.0, 0.0, 0.0, 1.0), radius=FLESH_M)
            for name in JOINTS
        }
        for finger, tip in zip(FINGERS, tips[row], strict=True):
            joints[f"{finger}_tip"] = joints["palm"].model_copy(update={"position": wire_position(tip)})
        hidden = LIFTED_S < t_s < DOWN_S
        hand = HandPose(
            t_ns=t_ns, side="right", frame="rig", joints=joints, angles={}, residual={}, state="measured",
            fingers={finger: "predicted" if hidden and finger == "little" else "measured" for finger in FINGERS},
        )  # fmt: skip
        cup = ObjectPose(
            t_ns=t_ns, frame="rig", position=wire_position(middle[row]), orientation=(0.0, 0.0, 0.0, 1.0),
            state="measured", shape=shape,
        )  # fmt: skip
        sent += [("rhot/hand/right", hand), ("rhot/object/cup", cup)]
    return sent


def session(gap_m: float = 0.0, carry_m: float = 0.2, drift_m: float = 0.0) -> GraspSession:
    return grasp_session(messages(*played(gap_m, carry_m, drift_m)))


def test_the_phases_are_where_they_were_played() -> None:
    one = session()
    (pickup,) = find_pickups(one, gaps_m(one))
    t_s = one.t_s
    assert t_s[pickup.carry.start] == pytest.approx(LIFTED_S, abs=0.1)
    assert t_s[pickup.carry.stop - 1] == pytest.approx(DOWN_S, abs=0.1)
    # Near is 4 cm; the hand comes from 20 cm to 3 cm between 0.5 and 1.5 s.
    assert t_s[pickup.close.start] == pytest.approx(1.44, abs=0.05)
    assert t_s[pickup.reach.start] == pytest.approx(0.44, abs=0.05)
    assert t_s[pickup.release.stop - 1] == pytest.approx(5.4, abs=0.1)


def test_gaps_are_those_of_the_flesh() -> None:
    one = session(gap_m=0.006)
    gaps = gaps_m(one)
    held = (one.t_s > LIFTED_S) & (one.t_s < DOWN_S)
    assert gaps[held][:, list(TIPS)] == pytest.approx(0.006, abs=1e-6)


def test_figures_of_a_firm_grasp() -> None:
    one = session()
    found = grasp_figures(one)
    assert found.success.tolist() == [1.0]
    assert found.held[0] == 1.0
    assert found.drift_m[0] < 1e-6
    assert found.recover_s[0] == 0.0
    (pickup,) = found.pickups
    share = one.measured[pickup.carry].mean()
    assert share == pytest.approx(0.8, abs=0.02), "the little finger is hidden while it is carried"


def test_an_object_that_slips_drifts() -> None:
    # The palm stays behind by 10 mm, evenly: about the middle 95 % of it lie within 5 mm less what the ends leave out.
    found = grasp_figures(session(drift_m=0.010))
    assert found.drift_m[0] == pytest.approx(0.0044, abs=0.0006)


def test_a_hand_that_hovers_beside_it_holds_nothing() -> None:
    found = grasp_figures(session(gap_m=0.025))
    assert len(found.pickups) == 1
    assert found.success.tolist() == [0.0]


def test_what_is_only_pushed_was_not_carried() -> None:
    assert grasp_figures(session(carry_m=0.02)).pickups == []


def test_an_object_that_moves_by_itself_was_not_picked_up() -> None:
    t, middle, tips = played()
    away = grasp_session(messages(t, middle, tips + np.array([0.0, 0.0, -0.5])))
    assert grasp_figures(away).pickups == []


def test_a_finger_that_stays_hidden_recovers_late() -> None:
    one = session()
    measured = one.measured.copy()
    measured[one.t_s < 6.2, 4] = False
    late = grasp_figures(dataclasses.replace(one, measured=measured))
    assert late.recover_s[0] == pytest.approx(6.2 - 5.4, abs=0.1)


def test_what_is_missing_is_named() -> None:
    with pytest.raises(ConfigError, match="--shape"):
        grasp_session(messages(*played(), shape=None))
    with pytest.raises(ConfigError, match="holds no object"):
        grasp_session([each for each in messages(*played()) if "hand" in each[0]])
    both = [(key.replace("cup", "box"), message) for key, message in messages(*played()) if "object" in key]
    with pytest.raises(ConfigError, match="--object"):
        grasp_session([*messages(*played()), *both])


def test_the_command_reads_a_recording(tmp_path: Path) -> None:
    file = tmp_path / "grasp.jsonl"
    lines = [
        f'{{"key": "{key}", "value": {message.model_dump_json(exclude_none=True)}}}'
        for key, message in messages(*played(), shape=None)
    ]
    file.write_text("\n".join(lines) + "\n")
    asked = ["evaluate", "grasp", str(file)]
    refused = CliRunner().invoke(main, asked)
    assert refused.exit_code == 2
    assert "--shape" in refused.output
    page, figures = tmp_path / "grasp.html", tmp_path / "grasp.json"
    done = CliRunner().invoke(
        main, [*asked, "--shape", "cylinder:30,90", "--report", str(page), "--json", str(figures)]
    )
    assert done.exit_code == 0, done.output
    rows = {row["name"]: row for row in json.loads(figures.read_text())["sections"][0]["rows"]}
    assert rows["pick-ups"]["value"] == 1
    assert rows["held while carried"]["verdict"] == "met"
    assert page.read_text().count("<svg") == 2
    wrong = CliRunner().invoke(main, [*asked, "--shape", "cone:3"])
    assert wrong.exit_code == 2
    assert "cylinder:RADIUS,HEIGHT" in wrong.output
