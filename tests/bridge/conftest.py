"""Programs of npm's that receive what bridges send."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from exported.npm_packages import npm_packages

WEB = Path(__file__).parent / "web"


@pytest.fixture(scope="session")
def web(pytestconfig: pytest.Config) -> Path:
    """A folder with the receivers and what they need; skipped where node, npm or its registry are missing."""
    folder = npm_packages(pytestconfig, "@pixiv/three-vrm@3", "three@0.180", "osc-min@2", "ws@8")
    for file in WEB.iterdir():
        shutil.copy(file, folder)
    return folder
