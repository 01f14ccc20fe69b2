"""What the page Grasp computes, tested by node without a browser: skin, contact, grasp, proxy, motion, pace."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from rhot.rig import Rig
from rhot.rig.calibration import HandFile
from rhot_viewer.grasp.hello import rest_hand

WEB = Path(__file__).parents[3] / "web"
TESTS = sorted((WEB / "test").glob("*.test.js"))
LIMIT_S = 120.0


@pytest.fixture(scope="module")
def hands(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rest poses of an average hand, as the server sends them."""
    rig = cast(Rig, SimpleNamespace(hand=HandFile()))
    file = tmp_path_factory.mktemp("hands") / "hands.json"
    file.write_text(json.dumps({"left": rest_hand(rig, "left"), "right": rest_hand(rig, "right")}))
    return file


def test_there_are_tests_to_run() -> None:
    assert len(TESTS) >= 3


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node: apt install nodejs npm")
@pytest.mark.parametrize("file", TESTS, ids=lambda file: file.name)
def test_by_node(file: Path, hands: Path) -> None:
    done = subprocess.run(
        ["node", "--test", str(file)],
        env={**os.environ, "RHOT_REST_HANDS": str(hands)},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
        stdin=subprocess.DEVNULL,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    assert "# fail 0" in done.stdout
    assert "# pass 0" not in done.stdout
