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

from rhot_bench.speed.pi_budget import INSTRUCTIONS

pytestmark = pytest.mark.stacks

HERE = Path(__file__).parent / "arm64"
REPOSITORY = Path(__file__).parents[2]
ROOT = Path(os.environ.get("RHOT_STACKS", REPOSITORY / ".stacks")) / "arm64"
SERVICES = ("common", *(f"services/{name}" for name in ("capture", "fusion", "ik", "objects", "feet")))
FRAMES = 20


@dataclass(frozen=True)
class Run:
    """What a run of detect.py found, and what it cost."""

    frames: list[dict[str, Any]]
    instructions: int


@dataclass(frozen=True)
class Pictures:
    """What detect.py looks at.

    Attributes:
        rig: calibrated, with colours.
        recording: of rendered pictures.
        folder: for what it finds.
    """

    rig: Path
    recording: Path
    folder: Path

    def command(self, how: str, rounds: int, name: str) -> tuple[list[str], Path]:
        """Return the arguments of a run, and where it writes."""
        out = self.folder / f"{name}.json"
        script = str(HERE / "detect.py")
        return [script, str(self.rig), str(self.recording), "left", str(FRAMES), how, str(rounds), str(out)], out


def emulated(pictures: Pictures, how: str, rounds: int) -> Run:
    """Run detect.py on ARM and count its instructions."""
    arguments, out = pictures.command(how, rounds, f"{how}{rounds}")
    python = next(ROOT.glob("usr/bin/python3.*"))
    paths = ":".join([str(ROOT / "opt/rhot"), *(str(REPOSITORY / part) for part in SERVICES)])
    variables = {
        **{"PYTHONPATH": paths, "PYTHONHASHSEED": "0", "PYTHONPYCACHEPREFIX": str(ROOT / "pycache")},
        **{"OPENBLAS_NUM_THREADS": "1", "PATH": os.environ["PATH"]},
    }
    done = subprocess.run(
        ["qemu-aarch64", "-plugin", str(ROOT / "count.so"), "-L", str(ROOT), str(python), *arguments],
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
def pictures(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Pictures:
    """Rendered pictures of a grasp, and the rig that was calibrated from pictures of the same world."""
    if not (ROOT / "count.so").exists():
        pytest.skip("no ARM root: `make stacks` makes it")
    kept = ROOT.parent / "kept"
    if not (kept / "rig").exists():
        command = ["evaluate", "pictures", str(shared_data), "--keep", str(kept)]
        subprocess.run([sys.executable, "-m", "rhot", *command], check=True, capture_output=True)
    made = Pictures(kept / "rig", shared_data / "rendered" / "G1", tmp_path_factory.mktemp("arm64"))
    # The first run also compiles Python's modules.
    emulated(made, "tracked", 1)
    return made


@pytest.fixture(scope="module")
def once(pictures: Pictures) -> Run:
    """One round of tracking on ARM."""
    return emulated(pictures, "tracked", 1)


def test_a_pi_finds_what_this_machine_finds(pictures: Pictures, once: Run) -> None:
    arguments, out = pictures.command("tracked", 1, "here")
    subprocess.run([sys.executable, *arguments], check=True)
    here = json.loads(out.read_text())
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


@pytest.mark.parametrize("how", ["tracked", "searched"])
def test_a_picture_costs_no_more_instructions_than_before(
    pictures: Pictures, once: Run, how: str, record_property: Callable[[str, object], None]
) -> None:
    first = once if how == "tracked" else emulated(pictures, how, 1)
    cost = (emulated(pictures, how, 3).instructions - first.instructions) / (2 * FRAMES)
    record_property(f"million instructions a picture, {how}", f"{cost / 1e6:.2f}")
    before = INSTRUCTIONS[how]
    assert cost <= 1.05 * before, f"{cost / 1e6:.2f} million, {before / 1e6:.2f} before (rhot_bench.speed.pi_budget)"
