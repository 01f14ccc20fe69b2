"""A played rig of real processes, and how many rounds the long tests take."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from played_rig import PlayedRig, played_rig

SUPPORT = Path(__file__).resolve().parents[1] / "support"


@pytest.fixture(scope="session")
def rounds() -> int:
    """How often the long tests do each thing: RHOT_FAULTS_ROUNDS, by default 100."""
    return int(os.environ.get("RHOT_FAULTS_ROUNDS", "100"))


@pytest.fixture
async def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[PlayedRig]:
    """A rig that tracks; its cameras' clocks are off and drift."""
    monkeypatch.setenv("PYTHONPATH", str(SUPPORT), prepend=os.pathsep)
    rate_hz = float(os.environ.get("RHOT_FAULTS_RATE_HZ", "60"))
    async with played_rig(tmp_path, {"left": (-3.0, 30.0), "right": (1000.0, -20.0)}, rate_hz) as running:
        yield running
