"""Capture on a Raspberry Pi's instruction set: what it finds, and how many instructions a picture costs.

The wheels that a Pi would install run under QEMU's emulation of user programs, on the rendered pictures.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.stacks

HERE = Path(__file__).parent / "arm64"
REPOSITORY = Path(__file__).parents[2]
ROOT = Path(os.environ.get("RHOT_STACKS", REPOSITORY / ".stacks")) / "arm64"
SERVICES = ("common", *(f"services/{name}" for name in ("capture", "fusion", "ik", "objects", "feet")))
FRAMES = 20
LIMITS = HERE / "instructions.json"
"""Instructions a picture as they were when this file was last written; more than 5 % above is a failure."""


@dataclass(frozen=True)
class Run:
    """What a run of detect.py found, and what it cost."""

    frames: list[dict[str, Any]]
    instructions: int


def emulated(rig: Path, recording: Path, rounds: int, out: Path) -> Run:
    python = next(ROOT.glob("usr/bin/python3.*"))
    paths = ":".join([str(ROOT / "opt/rhot"), *(str(REPOSITORY / part) for part in SERVICES)])
    variables = {
        **{"PYTHONPATH": paths, "PYTHONHASHSEED": "0", "PYTHONPYCACHEPREFIX": str(ROOT / "pycache")},
        **{"OPENBLAS_NUM_THREADS": "1", "PATH": os.environ["PATH"]},
    }
    done = subprocess.run(
        [
            *("qemu-aarch64", "-plugin", str(ROOT / "count.so"), "-L", str(ROOT), str(python)),
            *(str(HERE / "detect.py"), str(rig), str(recording), "left", str(FRAMES), str(rounds), str(out)),
        ],
        env=variables,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    counted = re.search(r"instructions: (\d+)", done.stderr)
    assert counted is not None, done.stderr[-2000:]
    return Run(json.loads(out.read_text()), int(counted[1]))


@pytest.fixture(scope="module")
def runs(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Run, list[dict[str, Any]]]:
    """One round and three on ARM, and one here."""
    if not (ROOT / "count.so").exists():
        pytest.skip("no ARM root: `make stacks` makes it")
    folder = tmp_path_factory.mktemp("arm64")
    recording = shared_data / "rendered" / "G1"
    kept = Path(os.environ["RHOT_KEPT"]) if "RHOT_KEPT" in os.environ else folder / "kept"
    if not (kept / "rig").exists():
        command = ["evaluate", "pictures", str(shared_data / "rendered"), "--keep", str(kept)]
        subprocess.run([sys.executable, "-m", "rhot", *command], check=True, capture_output=True)
    rig = kept / "rig"
    here = folder / "here.json"
    command = [str(HERE / "detect.py"), str(rig), str(recording), "left", str(FRAMES), "1", str(here)]
    subprocess.run([sys.executable, *command], check=True)
    # The first run also compiles Python's modules.
    emulated(rig, recording, 1, folder / "warm.json")
    once, thrice = (emulated(rig, recording, rounds, folder / f"{rounds}.json") for rounds in (1, 3))
    return once, thrice, json.loads(here.read_text())


def test_a_pi_finds_what_this_machine_finds(runs: tuple[Run, Run, list[dict[str, Any]]]) -> None:
    once, _, here = runs
    assert len(once.frames) == len(here) == FRAMES
    off_px = []
    for arm, own in zip(once.frames, here, strict=True):
        assert arm["markers"].keys() == own["markers"].keys()
        off_px += [
            np.hypot(marker["u"] - own["markers"][name]["u"], marker["v"] - own["markers"][name]["v"])
            for name, marker in arm["markers"].items()
        ]
    assert len(off_px) > 5 * FRAMES
    # Within rounding: a thousandth of what a marker's place is known to.
    assert max(off_px) < 1e-4


def test_a_picture_costs_no_more_instructions_than_before(
    runs: tuple[Run, Run, list[dict[str, Any]]], record_property: Callable[[str, object], None]
) -> None:
    once, thrice, _ = runs
    cost = (thrice.instructions - once.instructions) / (2 * FRAMES)
    record_property("million instructions a picture", f"{cost / 1e6:.2f}")
    limit = json.loads(LIMITS.read_text())["a_picture"]
    assert cost <= 1.05 * limit, f"{cost / 1e6:.2f} million, {limit / 1e6:.2f} before; see {LIMITS.name}"
